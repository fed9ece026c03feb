// Head maps -> boxes: threshold, decode, rotated non-maximum suppression, votes (asca_pillars/detection/decode.py).
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <tuple>
#include <vector>

#include <nlohmann/json.hpp>

#include "grid.hpp"

struct Box {
    std::array<float, 7> values;  // x, y, z of the center, length, width, height in m, yaw in rad
    double score;
    int label;
};

namespace detail {

constexpr double kPi = 3.14159265358979323846;
constexpr double kVoteScore = 0.1;  // from which on a box votes, reported or not
using Point = std::array<double, 2>;

inline double modulo(double value, double divisor) { return value - divisor * std::floor(value / divisor); }

inline Box decode(const float* residual, const float* direction, const std::array<float, 7>& anchor,
                  double direction_offset) {
    const double diagonal = std::hypot(double{anchor[3]}, double{anchor[4]});
    const auto grow = [](float ratio) {
        const double most = std::log(100.0);
        return std::exp(std::clamp(double{ratio}, -most, most));
    };
    const double bin = direction[1] > direction[0] ? kPi : 0;
    const double yaw = direction_offset + bin + modulo(double{residual[6]} + anchor[6] - direction_offset, kPi);
    Box box{};
    for (int axis = 0; axis < 2; ++axis)
        box.values[axis] = static_cast<float>(anchor[axis] + residual[axis] * diagonal);
    box.values[2] = static_cast<float>(anchor[2] + double{residual[2]} * anchor[5]);
    for (int axis = 3; axis < 6; ++axis) box.values[axis] = static_cast<float>(anchor[axis] * grow(residual[axis]));
    box.values[6] = static_cast<float>(modulo(yaw + kPi, 2 * kPi) - kPi);
    return box;
}

inline std::vector<Point> footprint(const Box& box) {
    const double cos = std::cos(box.values[6]), sin = std::sin(box.values[6]);
    std::vector<Point> corners;
    for (const auto& [along, across] : {Point{1, 1}, Point{-1, 1}, Point{-1, -1}, Point{1, -1}}) {
        const double x = along * box.values[3] / 2, y = across * box.values[4] / 2;
        corners.push_back({box.values[0] + cos * x - sin * y, box.values[1] + sin * x + cos * y});
    }
    return corners;
}

// The area of one convex polygon within another (Sutherland and Hodgman), both counter-clockwise.
inline double shared_area(std::vector<Point> polygon, const std::vector<Point>& window) {
    for (size_t i = 0; i < window.size(); ++i) {
        const auto [x0, y0] = window[i];
        const auto [x1, y1] = window[(i + 1) % window.size()];
        const auto side = [=](const Point& p) { return (x1 - x0) * (p[1] - y0) - (y1 - y0) * (p[0] - x0); };
        std::vector<Point> kept;
        for (size_t k = 0; k < polygon.size(); ++k) {
            const Point start = polygon[(k + polygon.size() - 1) % polygon.size()], end = polygon[k];
            const double before = side(start), after = side(end);
            if ((before >= 0) != (after >= 0)) {
                const double share = before / (before - after);
                kept.push_back({start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])});
            }
            if (after >= 0) kept.push_back(end);
        }
        polygon = kept;
    }
    double twice = 0;
    for (size_t k = 0; k < polygon.size(); ++k) {
        const auto [x0, y0] = polygon[k];
        const auto [x1, y1] = polygon[(k + 1) % polygon.size()];
        twice += x0 * y1 - x1 * y0;
    }
    return std::max(twice / 2, 0.0);
}

inline double bev_iou(const Box& a, const Box& b) {
    const double shared = shared_area(footprint(a), footprint(b));
    const double sum = double{a.values[3]} * a.values[4] + double{b.values[3]} * b.values[4] - shared;
    return sum > 0 ? shared / sum : 0;
}

// The mean of the boxes of its class that overlap a kept one, weighted with score squared and overlap.
inline Box voted(const Box& own, const std::vector<Box>& candidates, double iou_threshold) {
    std::array<double, 7> sums{};
    double total = 0;
    for (const Box& other : candidates) {
        const double iou = bev_iou(own, other);
        if (iou < iou_threshold) continue;
        const double weight = other.score * other.score * iou;
        total += weight;
        for (int axis = 0; axis < 7; ++axis) {
            double step = double{other.values[axis]} - own.values[axis];
            // Half a turn does not change a footprint: the kept box alone says which end is the front.
            if (axis == 6) step -= kPi * std::floor(step / kPi + 0.5);
            sums[axis] += weight * step;
        }
    }
    Box box = own;
    if (total > 0)
        for (int axis = 0; axis < 7; ++axis) box.values[axis] = static_cast<float>(own.values[axis] + sums[axis] / total);
    box.values[6] = static_cast<float>(modulo(double{box.values[6]} + kPi, 2 * kPi) - kPi);
    return box;
}

}  // namespace detail

// The boxes of one scan, best first. Maps are channels last, or rows of the head cells that `cells` names, ascending;
// `spec` and `yaws` are of bundle.json.
inline std::vector<Box> detections(const float* scores, const float* residuals, const float* directions,
                                   const std::vector<int32_t>* cells, const Grid& grid, const nlohmann::json& spec,
                                   const std::vector<float>& yaws) {
    const auto& classes = spec.at("classes");
    const auto columns = static_cast<int64_t>(grid.head_column_centers.size());
    const auto map_cells = columns * static_cast<int64_t>(grid.head_row_centers.size());
    const auto rows = cells ? static_cast<int64_t>(cells->size()) : map_cells;
    const auto turns = static_cast<int64_t>(yaws.size());
    const int64_t anchors = static_cast<int64_t>(classes.size()) * turns;
    const auto& post = spec.at("post");
    const size_t candidates = post.at("candidates"), most = post.at("max_detections");
    const double nms_iou = post.at("nms_iou");
    const bool votes = post.contains("vote_iou") && !post.at("vote_iou").is_null();
    const double vote_iou = votes ? post.at("vote_iou").get<double>() : 0;
    const double direction_offset = spec.value("direction_offset_rad", detail::kPi / 4);
    std::vector<Box> all;
    for (size_t label = 0; label < classes.size(); ++label) {
        const auto& size = classes[label];
        const auto logit_of = [](double score) { return std::log(score / (1 - score)); };
        const double threshold = logit_of(size.at("score_threshold"));
        const double floor = votes ? std::min(threshold, logit_of(detail::kVoteScore)) : threshold;
        std::vector<std::tuple<float, int64_t, int64_t>> chosen;  // logit downwards, anchor, row
        for (int64_t anchor = label * turns; anchor < static_cast<int64_t>(label + 1) * turns; ++anchor)
            for (int64_t row = 0; row < rows; ++row)
                if (const float logit = scores[row * anchors + anchor]; logit >= floor)
                    chosen.emplace_back(-logit, anchor, row);
        std::sort(chosen.begin(), chosen.end());
        if (chosen.size() > candidates) chosen.resize(candidates);
        std::vector<Box> kept, entered;
        for (const auto& [negative, anchor, row] : chosen) {
            const int64_t cell = cells ? (*cells)[row] : row;
            const std::array<float, 7> box{grid.head_column_centers[cell % columns],
                                           grid.head_row_centers[cell / columns],
                                           size.at("z_m"),
                                           size.at("length_m"),
                                           size.at("width_m"),
                                           size.at("height_m"),
                                           yaws[anchor % turns]};
            const int64_t place = row * anchors + anchor;
            Box found = detail::decode(residuals + 7 * place, directions + 2 * place, box, direction_offset);
            found.score = 1 / (1 + std::exp(double{negative}));
            found.label = static_cast<int>(label);
            const bool finite = std::all_of(found.values.begin(), found.values.end(),
                                            [](float value) { return std::isfinite(value); });
            const auto clashes = [&](const Box& other) { return detail::bev_iou(other, found) > nms_iou; };
            if (finite) entered.push_back(found);
            const bool reported = -negative >= threshold;
            if (finite && reported && kept.size() < most && std::none_of(kept.begin(), kept.end(), clashes)) kept.push_back(found);
        }
        for (const Box& own : kept) all.push_back(votes ? detail::voted(own, entered, vote_iou) : own);
    }
    std::stable_sort(all.begin(), all.end(), [](const Box& a, const Box& b) { return a.score > b.score; });
    if (all.size() > most) all.resize(most);
    return all;
}
