// Cells of pillars -> the rulebooks that a sparse neck reads (asca_pillars/ops/pillar/neck_rulebooks.py, docs/BUNDLE.md).
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

// Which cells of a map seen from above are active; its memory is kept from scan to scan.
class CellMap {
public:
    CellMap(int32_t ny, int32_t nx) : ny_(ny), nx_(nx), rows_((ny + 2) * (nx + 2), -1) {}

    const std::vector<int32_t>& cells() const { return cells_; }  // flat index y * nx + x, ascending
    int32_t size() const { return static_cast<int32_t>(cells_.size()); }

    // Row of a cell of -1..ny and -1..nx among the active ones, their number where it is none of them. As an unsigned
    // number -1 is the largest: no branch, because which cells are active is hard to predict.
    int32_t row(int32_t y, int32_t x) const {
        return static_cast<int32_t>(std::min<uint32_t>(rows_[place(y, x)], size()));
    }

    void enter(const std::vector<int64_t>& cells) {
        clear();
        cells_.assign(cells.begin(), cells.end());
        visit([this](size_t i, int32_t y, int32_t x) { rows_[place(y, x)] = static_cast<int32_t>(i); });
    }

    void clear() {
        visit([this](size_t, int32_t y, int32_t x) { rows_[place(y, x)] = -1; });
        cells_.clear();
    }

    // Of -1..ny and -1..nx: marks on the border around the map do not count.
    void mark(int32_t y, int32_t x) { rows_[place(y, x)] = 0; }

    // Make active what was marked since `clear`.
    void number() {
        for (const int32_t y : {-1, ny_}) std::fill_n(rows_.begin() + place(y, -1), nx_ + 2, -1);
        cells_.resize(static_cast<size_t>(ny_) * nx_);
        int32_t count = 0;
        for (int32_t y = 0; y < ny_; ++y) {
            rows_[place(y, -1)] = rows_[place(y, nx_)] = -1;
            for (int32_t x = 0; x < nx_; ++x) {
                int32_t& row = rows_[place(y, x)];
                const bool marked = row >= 0;
                cells_[count] = y * nx_ + x;
                row = marked ? count : -1;
                count += marked;
            }
        }
        cells_.resize(count);
    }

    // Call at(i, y, x) for the i-th active cell, in ascending order.
    template <typename At>
    void visit(At at) const {
        int32_t y = 0;
        for (size_t i = 0; i < cells_.size(); ++i) {
            while (cells_[i] >= (y + 1) * nx_) ++y;
            at(i, y, cells_[i] - y * nx_);
        }
    }

private:
    size_t place(int32_t y, int32_t x) const { return static_cast<size_t>((y + 1) * (nx_ + 2) + x + 1); }

    int32_t ny_, nx_;
    std::vector<int32_t> cells_, rows_;  // rows_ (ny + 2, nx + 2): -1 where nothing is active, and on the border
};

// Int32 and row by row, as backbone.onnx takes them.
struct NeckRulebooks {
    struct Level {
        std::vector<int32_t> strided, first, same;  // (M, 9), (N, 9), (N, 9)
        std::vector<int32_t> places;                // (head cells,)
    };
    std::array<Level, 3> levels;  // from the finest to the coarsest
    std::vector<int32_t> head_cells;
};

// Builds the rulebooks of scan after scan. Rows and columns of the map are multiples of 8; `fine` is the rule
// (pillar.active_cells) by which the finest level grows, or else `sub`.
class NeckRulebookBuilder {
public:
    NeckRulebookBuilder(int64_t ny, int64_t nx, bool fine)
        : fine_(fine), pillars_(ny, nx), strided_{level(ny, nx, 1), level(ny, nx, 2), level(ny, nx, 3)},
          grown_(level(ny, nx, 1)), head_(level(ny, nx, 1)) {}

    // Of pillars at these cells, ascending; valid until the next scan.
    const NeckRulebooks& build(const std::vector<int64_t>& cells) {
        activate(cells);
        const CellMap* before = &pillars_;
        for (int number = 0; number < 3; ++number) {
            NeckRulebooks::Level& found = rulebooks_.levels[number];
            const CellMap& output = outputs(number);
            gather(strided_[number], *before, 2, found.strided);
            gather(output, output, 1, found.same);
            if (number == 0 && fine_) gather(output, strided_[0], 1, found.first);
            locate(output, number, found.places);
            before = &output;
        }
        rulebooks_.head_cells = head_.cells();
        return rulebooks_;
    }

private:
    static CellMap level(int64_t ny, int64_t nx, int halvings) { return CellMap(ny >> halvings, nx >> halvings); }

    const CellMap& outputs(int number) const { return number == 0 && fine_ ? grown_ : strided_[number]; }

    void activate(const std::vector<int64_t>& cells) {
        pillars_.enter(cells);
        const CellMap* before = &pillars_;
        for (CellMap& level : strided_) {  // the coarser levels do not see the growth
            level.clear();
            // A kernel of 3 with stride 2 and padding 1 has one output over an even place, two over an odd one.
            before->visit([&level](size_t, int32_t y, int32_t x) {
                for (const int32_t row : {y / 2, (y + 1) / 2})
                    for (const int32_t column : {x / 2, (x + 1) / 2}) level.mark(row, column);
            });
            level.number();
            before = &level;
        }
        grown_.clear();
        if (fine_) {
            strided_[0].visit([this](size_t, int32_t y, int32_t x) {
                for (int32_t row = y - 1; row <= y + 1; ++row)
                    for (int32_t column = x - 1; column <= x + 1; ++column) grown_.mark(row, column);
            });
            grown_.number();
        }
        head_.clear();
        for (int number = 0; number < 3; ++number) {
            outputs(number).visit([this, number](size_t, int32_t y, int32_t x) {
                for (int32_t row = y << number; row < (y + 1) << number; ++row)
                    for (int32_t column = x << number; column < (x + 1) << number; ++column) head_.mark(row, column);
            });
        }
        head_.number();
    }

    // The rows of `source` that a kernel of 3 with padding 1 reads for each of the outputs.
    static void gather(const CellMap& outputs, const CellMap& source, int32_t stride, std::vector<int32_t>& rulebook) {
        rulebook.resize(9 * static_cast<size_t>(outputs.size()));
        outputs.visit([&](size_t i, int32_t y, int32_t x) {
            int32_t* entry = &rulebook[9 * i];
            for (int32_t row = stride * y - 1; row <= stride * y + 1; ++row)
                for (int32_t column = stride * x - 1; column <= stride * x + 1; ++column)
                    *entry++ = source.row(row, column);
        });
    }

    // Row of each head cell among the outputs of an upsampling, 4^halvings for each of the level's cells.
    void locate(const CellMap& level, int halvings, std::vector<int32_t>& places) const {
        places.resize(head_.size());
        const int32_t within = (1 << halvings) - 1;
        head_.visit([&](size_t i, int32_t y, int32_t x) {
            const int32_t parent = level.row(y >> halvings, x >> halvings);
            const int32_t child = (y & within) << halvings | (x & within);
            places[i] = (parent << 2 * halvings) + (parent < level.size() ? child : 0);
        });
    }

    bool fine_;
    CellMap pillars_;
    std::array<CellMap, 3> strided_;
    CellMap grown_, head_;
    NeckRulebooks rulebooks_;
};
