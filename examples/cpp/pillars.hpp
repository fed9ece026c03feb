// Points -> pillars (asca_pillars/pillars/pillarize.py, docs/BUNDLE.md).
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "grid.hpp"
#include "numpy_random.hpp"

struct Pillars {
    std::vector<float> features;                      // (M, 9)
    std::vector<int64_t> pillar_index, point_counts;  // (M,), (P,)
    std::vector<int64_t> cells;                       // (P,) ascending
};

// Points (N, 4): x, y, z in m, reflectance 0..1.
inline Pillars pillarize(const std::vector<float>& points, const Grid& grid, int64_t max_pillars, int64_t max_points) {
    std::vector<std::vector<int64_t>> members(grid.nx * grid.ny);
    for (size_t i = 0; i < points.size() / 4; ++i)
        if (const int64_t cell = grid.cell(&points[4 * i]); cell >= 0) members[cell].push_back(static_cast<int64_t>(i));
    std::vector<int64_t> cells;
    bool crowded = false;
    for (size_t cell = 0; cell < members.size(); ++cell) {
        if (members[cell].empty()) continue;
        cells.push_back(static_cast<int64_t>(cell));
        crowded |= static_cast<int64_t>(members[cell].size()) > max_points;
    }

    if (crowded || static_cast<int64_t>(cells.size()) > max_pillars) {  // a random subset, the same for the same scan
        Generator random(crc32(points.data(), points.size() * sizeof(float)));
        const auto order = random.permutation(static_cast<int64_t>(cells.size()));
        for (size_t i = max_pillars; i < order.size(); ++i) members[cells[order[i]]].clear();
        std::vector<std::array<int64_t, 2>> crowd;  // cell, place within it
        for (const int64_t cell : cells)
            if (const auto size = static_cast<int64_t>(members[cell].size()); size > max_points)
                for (int64_t place = 0; place < size; ++place) crowd.push_back({cell, place});
        std::vector<int64_t> taken(members.size());
        for (const int64_t i : random.permutation(static_cast<int64_t>(crowd.size())))
            if (taken[crowd[i][0]]++ >= max_points) members[crowd[i][0]][crowd[i][1]] = -1;
    }

    Pillars found;
    for (const int64_t cell : cells) {
        std::array<double, 3> sums{};
        int64_t count = 0;
        for (const int64_t point : members[cell]) {
            if (point < 0) continue;
            for (int axis = 0; axis < 3; ++axis) sums[axis] += points[4 * point + axis];
            ++count;
        }
        if (count == 0) continue;
        const std::array<float, 2> center{grid.column_centers[cell % grid.nx], grid.row_centers[cell / grid.nx]};
        for (const int64_t point : members[cell]) {
            if (point < 0) continue;
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
