// The pillar grid that bundle.json describes (asca_pillars/ops/pillar/grid.py): cells of points, and where cells stand.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include <nlohmann/json.hpp>

struct Grid {
    int64_t nx = 0, ny = 0;
    std::array<std::array<float, 2>, 3> ranges;  // m, lower and upper end along x, y, z
    std::vector<float> slice_edges, row_edges;   // m, float32 as the points are
    std::vector<int64_t> column_of_slice;
    std::vector<float> column_centers, row_centers;            // m
    std::vector<float> head_column_centers, head_row_centers;  // m, of the head's map

    explicit Grid(const nlohmann::json& spec) {
        const auto x = spec.at("x_range_m").get<std::array<double, 2>>();
        const auto y = spec.at("y_range_m").get<std::array<double, 2>>();
        const auto z = spec.at("z_range_m").get<std::array<double, 2>>();
        const int zones = spec.at("zones");
        const auto axes = std::array{x, y, z};
        for (int axis = 0; axis < 3; ++axis)
            ranges[axis] = {static_cast<float>(axes[axis][0]), static_cast<float>(axes[axis][1])};

        // The x range in slices of the finest depth: every column's border is one of a slice.
        const int64_t first_columns = std::llround((x[1] - x[0]) / (zones * spec.at("v_max_m").get<double>()));
        const int64_t slices = zones * first_columns << (zones - 1);
        const auto slice_borders = linspace(x[0], x[1], slices);
        std::vector<double> x_edges;
        for (int zone = 0; zone < zones; ++zone) {
            const int64_t depth = int64_t{1} << (zones - 1 - zone);
            for (int64_t column = 0; column < first_columns << zone; ++column) {
                const auto slice = static_cast<int64_t>(column_of_slice.size());
                const auto number = static_cast<int64_t>(x_edges.size());
                x_edges.push_back(slice_borders[slice]);
                column_of_slice.insert(column_of_slice.end(), depth, number);
            }
        }
        x_edges.push_back(slice_borders.back());
        nx = static_cast<int64_t>(x_edges.size()) - 1;
        ny = std::llround((y[1] - y[0]) / spec.at("v_y_m").get<double>());
        const auto y_edges = linspace(y[0], y[1], ny);
        slice_edges.assign(slice_borders.begin(), slice_borders.end());
        row_edges.assign(y_edges.begin(), y_edges.end());
        column_centers = centers(x_edges, 1);
        row_centers = centers(y_edges, 1);
        head_column_centers = centers(x_edges, 2);
        head_row_centers = centers(y_edges, 2);
    }

    // Flat index row * nx + column, or -1 outside the ranges. Borders belong to the cell above them.
    int64_t cell(const float* point) const {
        for (int axis = 0; axis < 3; ++axis)
            if (!(point[axis] >= ranges[axis][0] && point[axis] < ranges[axis][1])) return -1;
        return interval(point[1], row_edges) * nx + column_of_slice[interval(point[0], slice_edges)];
    }

private:
    // Which of the intervals between evenly spaced edges a value within them lies in. Computed, then put right where it
    // was rounded: a search takes five times as long.
    static int64_t interval(float value, const std::vector<float>& edges) {
        const auto count = static_cast<int64_t>(edges.size()) - 1;
        const float share = (value - edges.front()) / (edges.back() - edges.front());
        int64_t found = std::min(static_cast<int64_t>(share * static_cast<float>(count)), count - 1);
        while (value < edges[found]) --found;
        while (value >= edges[found + 1]) ++found;
        return found;
    }

    // Rounded as numpy.linspace rounds.
    static std::vector<double> linspace(double low, double high, int64_t count) {
        std::vector<double> values(count + 1, high);
        const double step = (high - low) / static_cast<double>(count);
        for (int64_t i = 0; i < count; ++i) values[i] = static_cast<double>(i) * step + low;
        return values;
    }

    static std::vector<float> centers(const std::vector<double>& edges, int64_t stride) {
        std::vector<float> middles;
        for (size_t i = 0; i + stride < edges.size(); i += stride)
            middles.push_back(static_cast<float>((edges[i] + edges[i + stride]) / 2));
        return middles;
    }
};
