// detect BUNDLE SCAN.bin: the boxes of one scan, a line each: class score x y z length width height yaw.
//
// A bundle of asca-pillars, kind pillar with a dense neck on a warped map, in ONNX Runtime's C++ interface.

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>
#include <onnxruntime_cxx_api.h>

#include "boxes.hpp"
#include "grid.hpp"
#include "pillars.hpp"

namespace {

using nlohmann::json;

const auto kMemory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

// KITTI's .bin: x, y, z, reflectance in little-endian float32. Points that are not finite are left out.
std::vector<float> read_points(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + ": cannot be read");
    const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
    if (bytes.size() % 16) throw std::runtime_error(path + ": no whole number of points of 16 bytes");
    std::vector<float> values(bytes.size() / 4), points;
    std::memcpy(values.data(), bytes.data(), bytes.size());
    for (size_t i = 0; i < values.size(); i += 4) {
        if (!std::all_of(&values[i], &values[i] + 4, [](float value) { return std::isfinite(value); })) continue;
        points.insert(points.end(), &values[i], &values[i] + 3);
        points.push_back(std::clamp(values[i + 3], 0.0f, 1.0f));
    }
    return points;
}

json read_manifest(const std::string& folder) {
    std::ifstream file(folder + "/bundle.json");
    if (!file) throw std::runtime_error(folder + "/bundle.json: cannot be read");
    const json manifest = json::parse(file);
    const json &pillar = manifest.at("pillar"), &spec = manifest.at("spec"), &grid = spec.at("grid");
    if (manifest.at("schema_version") != 3 || manifest.at("kind") != "pillar" ||
        pillar.value("neck", "dense") != "dense" || (grid.value("map", "warped") == "pooled" && grid.at("zones") > 1))
        throw std::runtime_error(folder + ": needs schema 3, kind pillar, a dense neck and a warped map");
    if (spec.value("anchor_places", "cells") != "cells" || spec.value("anchor_scores", "own") != "own")
        throw std::runtime_error(folder + ": needs anchors at cell centers with one score for each");
    return manifest;
}

Ort::Session open(const Ort::Env& env, const std::string& folder, const json& manifest, const char* graph) {
    Ort::SessionOptions options;
    // See docs/BUNDLE.md: the encoder needs one thread; the optimizer would quantize layers that are kept in floating point.
    options.SetIntraOpNumThreads(1);
    options.AddConfigEntry("optimization.disable_specified_optimizers", "WeightBiasQuantization");
    const std::string path = folder + "/" + manifest.at("graphs").at(graph).at("file").get<std::string>();
    return Ort::Session(env, path.c_str(), options);
}

template <typename T>
Ort::Value tensor(std::vector<T>& values, const std::vector<int64_t>& shape) {
    return Ort::Value::CreateTensor<T>(kMemory, values.data(), values.size(), shape.data(), shape.size());
}

// Pillar features (P, C); the graph may not declare all three inputs.
Ort::Value encode(Ort::Session& encoder, Pillars& pillars) {
    const auto rows = static_cast<int64_t>(pillars.pillar_index.size());
    const auto count = static_cast<int64_t>(pillars.point_counts.size());
    std::vector<std::string> names;
    std::vector<const char*> pointers;
    std::vector<Ort::Value> values;
    Ort::AllocatorWithDefaultOptions allocator;
    for (size_t i = 0; i < encoder.GetInputCount(); ++i) names.push_back(encoder.GetInputNameAllocated(i, allocator).get());
    for (const auto& name : names) {
        pointers.push_back(name.c_str());
        if (name == "features") values.push_back(tensor(pillars.features, {rows, 9}));
        if (name == "pillar_index") values.push_back(tensor(pillars.pillar_index, {rows}));
        if (name == "point_counts") values.push_back(tensor(pillars.point_counts, {count}));
    }
    const char* output = "pillar_features";
    return std::move(encoder.Run({}, pointers.data(), values.data(), values.size(), &output, 1)[0]);
}

// The pseudo-image (ny + 1, nx + 1, C). Row 0 and column 0 are the first convolution's padding.
template <typename T>
std::vector<T> scatter(const T* features, const std::vector<int64_t>& cells, const Grid& grid, const json& pillar) {
    const size_t channels = pillar.at("channels");
    std::vector<T> empty = pillar.at("canvas").at("empty");
    empty.resize(channels);
    std::vector<T> canvas;
    canvas.reserve((grid.ny + 1) * (grid.nx + 1) * channels);
    for (int64_t cell = 0; cell < (grid.ny + 1) * (grid.nx + 1); ++cell)
        canvas.insert(canvas.end(), empty.begin(), empty.end());
    for (size_t i = 0; i < cells.size(); ++i) {
        const int64_t row = (1 + cells[i] / grid.nx) * (grid.nx + 1) + 1 + cells[i] % grid.nx;
        std::copy_n(features + i * channels, channels, canvas.begin() + row * static_cast<int64_t>(channels));
    }
    return canvas;
}

template <typename T>
std::vector<Box> detect(Ort::Session& encoder, Ort::Session& backbone, const json& manifest, std::vector<float> points) {
    const json &spec = manifest.at("spec"), &pillar = manifest.at("pillar"), &limits = spec.at("limits");
    const Grid grid(spec.at("grid"));
    Pillars pillars = pillarize(points, grid, limits.at("max_pillars"), limits.at("max_points"));
    std::vector<T> canvas;
    if (pillars.cells.empty()) {
        canvas = scatter<T>(nullptr, {}, grid, pillar);
    } else {
        const Ort::Value features = encode(encoder, pillars);
        canvas = scatter(features.GetTensorData<T>(), pillars.cells, grid, pillar);
    }
    const Ort::Value input = tensor(canvas, {1, grid.ny + 1, grid.nx + 1, pillar.at("channels").get<int64_t>()});
    const char *given = "canvas", *wanted[] = {"scores", "boxes", "directions"};
    const auto maps = backbone.Run({}, &given, &input, 1, wanted, 3);
    return detections(maps[0].GetTensorData<float>(), maps[1].GetTensorData<float>(), maps[2].GetTensorData<float>(),
                      grid, spec, pillar.at("layout").at("anchor_yaws_rad").get<std::vector<float>>());
}

}  // namespace

int main(int count, char** arguments) try {
    if (count != 3) throw std::runtime_error("usage: detect BUNDLE SCAN.bin");
    const std::string folder = arguments[1];
    const json manifest = read_manifest(folder);
    const std::vector<float> points = read_points(arguments[2]);
    const Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "asca");
    Ort::Session encoder = open(env, folder, manifest, "encoder"), backbone = open(env, folder, manifest, "backbone");
    const bool bytes = manifest.at("pillar").at("canvas").at("type") == "uint8";
    for (const Box& box : (bytes ? detect<uint8_t> : detect<float>)(encoder, backbone, manifest, points)) {
        std::printf("%s %.6f", manifest.at("spec").at("classes")[box.label].at("name").get<std::string>().c_str(), box.score);
        for (const float value : box.values) std::printf(" %.6f", value);
        std::printf("\n");
    }
} catch (const std::exception& error) {
    std::cerr << "detect: " << error.what() << "\n";
    return 2;
}
