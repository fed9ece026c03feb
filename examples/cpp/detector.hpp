// A bundle in ONNX Runtime: points in, boxes out (asca_deploy/pillar/pipeline.py).
#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>
#include <onnxruntime_cxx_api.h>

#include "boxes.hpp"
#include "grid.hpp"
#include "pillars.hpp"
#include "rulebooks.hpp"

namespace detail {

using nlohmann::json;
using Values = std::map<std::string, Ort::Value>;

inline Ort::Session open(const Ort::Env& env, const std::string& folder, const json& manifest, const char* graph,
                         int threads) {
    Ort::SessionOptions options;
    // docs/BUNDLE.md: the PFN layer needs one thread; the optimizer would quantize layers that are kept in floating
    // point.
    options.SetIntraOpNumThreads(threads);
    options.AddConfigEntry("optimization.disable_specified_optimizers", "WeightBiasQuantization");
    const std::string path = folder + "/" + manifest.at("graphs").at(graph).at("file").get<std::string>();
    return Ort::Session(env, path.c_str(), options);
}

// A view: the values have to stay where they are until the graph has run. It does not write to them.
template <typename T>
Ort::Value tensor(const std::vector<T>& values, const std::vector<int64_t>& shape) {
    static const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const auto data = const_cast<T*>(values.data());
    return Ort::Value::CreateTensor<T>(memory, data, values.size(), shape.data(), shape.size());
}

// Run a graph on those of the values that it declares.
inline std::vector<Ort::Value> run(Ort::Session& graph, Values given, const std::vector<const char*>& wanted) {
    std::vector<std::string> names;
    std::vector<const char*> pointers;
    std::vector<Ort::Value> values;
    Ort::AllocatorWithDefaultOptions allocator;
    for (size_t i = 0; i < graph.GetInputCount(); ++i) names.push_back(graph.GetInputNameAllocated(i, allocator).get());
    for (const auto& name : names) {
        pointers.push_back(name.c_str());
        values.push_back(std::move(given.at(name)));
    }
    return graph.Run({}, pointers.data(), values.data(), values.size(), wanted.data(), wanted.size());
}

inline Values rulebook_inputs(const NeckRulebooks& rulebooks) {
    Values given;
    for (size_t number = 0; number < rulebooks.levels.size(); ++number) {
        const NeckRulebooks::Level& level = rulebooks.levels[number];
        const std::string suffix = "_" + std::to_string(number);
        const auto taps = [](const std::vector<int32_t>& rulebook) {
            return tensor(rulebook, {static_cast<int64_t>(rulebook.size()) / 9, 9});
        };
        given.emplace("strided" + suffix, taps(level.strided));
        given.emplace("first" + suffix, taps(level.first));
        given.emplace("same" + suffix, taps(level.same));
        given.emplace("places" + suffix, tensor(level.places, {static_cast<int64_t>(level.places.size())}));
    }
    return given;
}

}  // namespace detail

// ONNX Runtime's environment. Version 1.32 and later report to their maker unless the variable says otherwise before the
// environment is made; what the user has set stays.
inline Ort::Env make_env(const char* name) {
#ifdef _WIN32
    if (std::getenv("ORT_DISABLE_TELEMETRY") == nullptr) _putenv_s("ORT_DISABLE_TELEMETRY", "1");
#else
    setenv("ORT_DISABLE_TELEMETRY", "1", 0);
#endif
    Ort::Env env(ORT_LOGGING_LEVEL_ERROR, name);
    if (std::string(std::getenv("ORT_DISABLE_TELEMETRY")) == "1") env.DisableTelemetryEvents();
    return env;
}

// bundle.json of a bundle that this program can run.
inline nlohmann::json read_manifest(const std::string& folder) {
    std::ifstream file(folder + "/bundle.json");
    if (!file) throw std::runtime_error(folder + "/bundle.json: cannot be read");
    const auto manifest = nlohmann::json::parse(file);
    const auto &spec = manifest.at("spec"), &grid = spec.at("grid");
    if (manifest.at("schema_version") != 3 || manifest.at("kind") != "pillar" ||
        (grid.value("map", "warped") == "pooled" && grid.at("zones") > 1))
        throw std::runtime_error(folder + ": needs schema 3, kind pillar and a warped map");
    if (spec.value("anchor_places", "cells") != "cells" || spec.value("anchor_scores", "own") != "own")
        throw std::runtime_error(folder + ": needs anchors at cell centers with one score for each");
    const std::string version = Ort::GetVersionString();
    int major = 0, minor = 0;
    std::sscanf(version.c_str(), "%d.%d", &major, &minor);
    if (manifest.at("precision") == "int8" && major == 1 && minor < 25)
        throw std::runtime_error(folder + ": ONNX Runtime " + version + " gets 8 bits wrong on CPUs with AMX; take 1.25 or "
                                 "later, or a bundle in float32");
    return manifest;
}

// Runs scan after scan, for one thread at a time. T is the type of the pillar features: uint8_t of 8 bits, or float.
template <typename T>
class Detector {
public:
    // Threads are the backbone's; 0 takes ONNX Runtime's choice, the physical cores.
    Detector(const Ort::Env& env, const std::string& folder, const nlohmann::json& manifest, int threads = 0)
        : spec_(manifest.at("spec")), grid_(spec_.at("grid")), encoder_(detail::open(env, folder, manifest, "encoder", 1)),
          backbone_(detail::open(env, folder, manifest, "backbone", threads)),
          pillarizer_(grid_, spec_.at("limits").at("max_pillars"), spec_.at("limits").at("max_points")) {
        if (manifest.at("graphs").contains("pfn")) pfn_.emplace(detail::open(env, folder, manifest, "pfn", 1));
        const auto& pillar = manifest.at("pillar");
        yaws_ = pillar.at("layout").at("anchor_yaws_rad").get<std::vector<float>>();
        empty_ = pillar.at("canvas").at("empty").get<std::vector<T>>();
        empty_.resize(pillar.at("channels"));
        if (pillar.value("neck", "dense") == "sparse")
            rulebooks_.emplace(grid_.ny, grid_.nx, pillar.at("active_cells") == "fine");
    }

    // The boxes of finite points (N, 4), x, y, z in m, reflectance 0..1; best first.
    std::vector<Box> detect(const std::vector<float>& points) {
        laps_ms.clear();
        lap_start_ = std::chrono::steady_clock::now();
        const Pillars& pillars = pillarizer_.pillarize(points);
        lap("pillarize");
        if (rulebooks_ && pillars.cells.empty()) return {};
        Ort::Value features{nullptr};
        if (!pillars.cells.empty()) features = encode(pillars);
        lap("encode");
        detail::Values given;
        std::vector<T> canvas;
        const std::vector<int32_t>* head_cells = nullptr;
        if (rulebooks_) {
            const NeckRulebooks& rulebooks = rulebooks_->build(pillars.cells);
            head_cells = &rulebooks.head_cells;
            given = detail::rulebook_inputs(rulebooks);
            given.emplace("pillar_features", std::move(features));
            lap("rulebooks");
        } else {
            canvas = scatter(features ? features.GetTensorData<T>() : nullptr, pillars.cells);
            const auto channels = static_cast<int64_t>(empty_.size());
            given.emplace("canvas", detail::tensor(canvas, {1, grid_.ny + 1, grid_.nx + 1, channels}));
            lap("scatter");
        }
        const auto maps = detail::run(backbone_, std::move(given), {"scores", "boxes", "directions"});
        lap("neck+head");
        auto boxes = detections(maps[0].GetTensorData<float>(), maps[1].GetTensorData<float>(),
                                maps[2].GetTensorData<float>(), head_cells, grid_, spec_, yaws_);
        lap("decode");
        return boxes;
    }

    std::vector<std::pair<const char*, double>> laps_ms;  // of the last scan, stage by stage

private:
    void lap(const char* stage) {
        const auto now = std::chrono::steady_clock::now();
        laps_ms.emplace_back(stage, std::chrono::duration<double, std::milli>(now - lap_start_).count());
        lap_start_ = now;
    }

    // Pillar features (P, C).
    Ort::Value encode(const Pillars& pillars) {
        const auto rows = static_cast<int64_t>(pillars.pillar_index.size());
        const auto count = static_cast<int64_t>(pillars.point_counts.size());
        detail::Values given;
        given.emplace("features", detail::tensor(pillars.features, {rows, 9}));
        given.emplace("pillar_index", detail::tensor(pillars.pillar_index, {rows}));
        given.emplace("point_counts", detail::tensor(pillars.point_counts, {count}));
        if (pfn_) {
            auto maxima = std::move(detail::run(*pfn_, std::move(given), {"pillar_maxima"})[0]);
            given.clear();
            given.emplace("pillar_maxima", std::move(maxima));
        }
        return std::move(detail::run(encoder_, std::move(given), {"pillar_features"})[0]);
    }

    // The pseudo-image (ny + 1, nx + 1, C). Row 0 and column 0 are the first convolution's padding.
    std::vector<T> scatter(const T* features, const std::vector<int64_t>& cells) const {
        const size_t channels = empty_.size();
        std::vector<T> canvas;
        canvas.reserve((grid_.ny + 1) * (grid_.nx + 1) * channels);
        for (int64_t cell = 0; cell < (grid_.ny + 1) * (grid_.nx + 1); ++cell)
            canvas.insert(canvas.end(), empty_.begin(), empty_.end());
        for (size_t i = 0; i < cells.size(); ++i) {
            const int64_t row = (1 + cells[i] / grid_.nx) * (grid_.nx + 1) + 1 + cells[i] % grid_.nx;
            std::copy_n(features + i * channels, channels, canvas.begin() + row * static_cast<int64_t>(channels));
        }
        return canvas;
    }

    nlohmann::json spec_;
    Grid grid_;
    Ort::Session encoder_, backbone_;
    std::optional<Ort::Session> pfn_;  // where encoder.onnx does not take the points
    Pillarizer pillarizer_;
    std::vector<float> yaws_;
    std::vector<T> empty_;                    // (C,) of a cell without a pillar
    std::optional<NeckRulebookBuilder> rulebooks_;  // of a sparse neck
    std::chrono::steady_clock::time_point lap_start_;
};
