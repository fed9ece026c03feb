// Points -> pillars (asca_pillars/ops/pillar/prepare.py, docs/BUNDLE.md).
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <utility>
#include <vector>

#include "grid.hpp"

struct Pillars {
    std::vector<float> features;                      // (M, 9)
    std::vector<int64_t> pillar_index, point_counts;  // (M,), (P,)
    std::vector<int64_t> cells;                       // (P,) ascending
};

// Sorts the points of scan after scan into pillars; its memory is kept.
class Pillarizer {
public:
    Pillarizer(Grid grid, int64_t max_pillars, int64_t max_points)
        : grid_(std::move(grid)), max_pillars_(max_pillars), max_points_(max_points), next_(grid_.nx * grid_.ny) {}

    // Points (N, 4): x, y, z in m, reflectance 0..1. What it gives is valid until the next scan.
    const Pillars& pillarize(const std::vector<float>& points) {
        sort(points);
        found_.features.resize(9 * order_.size());
        found_.pillar_index.resize(order_.size());
        found_.point_counts.clear();
        found_.cells.clear();
        size_t row = 0;
        const auto occupied = static_cast<int64_t>(runs_.size());
        for (int64_t number = 0; number < occupied; ++number)
            if (stays(number, occupied, max_pillars_)) row = fill(points, runs_[number], row);
        found_.features.resize(9 * row);
        found_.pillar_index.resize(row);
        return found_;
    }

private:
    struct Run {  // a cell's points, side by side in `order_`
        int64_t cell, start, count;
    };

    // Whether the k-th of `count` stays if `most` may: at even steps along the row.
    static bool stays(int64_t k, int64_t count, int64_t most) {
        return most >= count || (k + 1) * most / count > k * most / count;
    }

    // Indices of the points inside, sorted by cell and as they come within it.
    void sort(const std::vector<float>& points) {
        cell_of_point_.resize(points.size() / 4);
        for (size_t i = 0; i < cell_of_point_.size(); ++i)
            if ((cell_of_point_[i] = grid_.cell(&points[4 * i])) >= 0) ++next_[cell_of_point_[i]];
        runs_.clear();
        int64_t start = 0;
        for (size_t cell = 0; cell < next_.size(); ++cell) {
            const int64_t count = next_[cell];
            if (count == 0) continue;
            runs_.push_back({static_cast<int64_t>(cell), start, count});
            next_[cell] = start;
            start += count;
        }
        order_.resize(start);
        for (size_t i = 0; i < cell_of_point_.size(); ++i)
            if (const int64_t cell = cell_of_point_[i]; cell >= 0) order_[next_[cell]++] = static_cast<int64_t>(i);
        for (const Run& run : runs_) next_[run.cell] = 0;
    }

    // Write the pillar of a cell from this row on; the row after it.
    size_t fill(const std::vector<float>& points, const Run& run, size_t row) {
        const std::array<float, 2> center{grid_.column_centers[run.cell % grid_.nx],
                                          grid_.row_centers[run.cell / grid_.nx]};
        const auto pillar = static_cast<int64_t>(found_.cells.size());
        const size_t first = row;
        std::array<double, 3> sums{};
        for (int64_t k = 0; k < run.count; ++k) {
            if (!stays(k, run.count, max_points_)) continue;
            const float* point = &points[4 * order_[run.start + k]];
            std::copy_n(point, 4, &found_.features[9 * row]);
            for (int axis = 0; axis < 3; ++axis) sums[axis] += point[axis];
            found_.pillar_index[row++] = pillar;
        }
        const auto count = static_cast<int64_t>(row - first);
        for (size_t i = first; i < row; ++i) {
            float* at = &found_.features[9 * i];
            for (int axis = 0; axis < 3; ++axis)
                at[4 + axis] = at[axis] - static_cast<float>(sums[axis] / static_cast<double>(count));
            for (int axis = 0; axis < 2; ++axis) at[7 + axis] = at[axis] - center[axis];
        }
        found_.point_counts.push_back(count);
        found_.cells.push_back(run.cell);
        return row;
    }

    Grid grid_;
    int64_t max_pillars_, max_points_;
    std::vector<int64_t> next_;  // (cells,) zeros between two scans
    std::vector<int64_t> cell_of_point_, order_;
    std::vector<Run> runs_;  // ascending by cell
    Pillars found_;
};
