// Points -> pillars (asca_pillars/pillars/pillarize.py, docs/BUNDLE.md).
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "grid.hpp"

struct Pillars {
    std::vector<float> features;                      // (M, 9)
    std::vector<int64_t> pillar_index, point_counts;  // (M,), (P,)
    std::vector<int64_t> cells;                       // (P,) ascending
};

// Those that stay if `most` may: at even steps along the row.
inline std::vector<int64_t> evenly(const std::vector<int64_t>& row, int64_t most) {
    const auto count = static_cast<int64_t>(row.size());
    const int64_t share = std::min(most, count);
    std::vector<int64_t> stay;
    for (int64_t k = 0; k < count; ++k)
        if ((k + 1) * share / count > k * share / count) stay.push_back(row[k]);
    return stay;
}

// Points (N, 4): x, y, z in m, reflectance 0..1.
inline Pillars pillarize(const std::vector<float>& points, const Grid& grid, int64_t max_pillars, int64_t max_points) {
    std::vector<std::vector<int64_t>> members(grid.nx * grid.ny);
    for (size_t i = 0; i < points.size() / 4; ++i)
        if (const int64_t cell = grid.cell(&points[4 * i]); cell >= 0) members[cell].push_back(static_cast<int64_t>(i));
    std::vector<int64_t> cells;
    for (size_t cell = 0; cell < members.size(); ++cell)
        if (!members[cell].empty()) cells.push_back(static_cast<int64_t>(cell));
    cells = evenly(cells, max_pillars);

    Pillars found;
    for (const int64_t cell : cells) {
        const auto inside = evenly(members[cell], max_points);
        const auto count = static_cast<int64_t>(inside.size());
        std::array<double, 3> sums{};
        for (const int64_t point : inside)
            for (int axis = 0; axis < 3; ++axis) sums[axis] += points[4 * point + axis];
        const std::array<float, 2> center{grid.column_centers[cell % grid.nx], grid.row_centers[cell / grid.nx]};
        for (const int64_t point : inside) {
            const float* at = &points[4 * point];
            found.features.insert(found.features.end(), at, at + 4);
            for (int axis = 0; axis < 3; ++axis)
                found.features.push_back(at[axis] - static_cast<float>(sums[axis] / static_cast<double>(count)));
            for (int axis = 0; axis < 2; ++axis) found.features.push_back(at[axis] - center[axis]);
            found.pillar_index.push_back(static_cast<int64_t>(found.cells.size()));
        }
        found.point_counts.push_back(count);
        found.cells.push_back(cell);
    }
    return found;
}
