// detect BUNDLE SCAN.bin [REPEATS]: the boxes of one scan, a line each: class score x y z length width height yaw.
//
// A bundle of asca-pillars, kind pillar on a warped map, in ONNX Runtime's C++ interface. With repeats it also says, on
// the standard error stream, what each stage takes.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <vector>

#include "detector.hpp"

namespace {

// KITTI's .bin: x, y, z, reflectance in little-endian float32. Points that are not finite are left out.
std::vector<float> read_points(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + ": cannot be read");
    const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
    if (bytes.size() % 16) throw std::runtime_error(path + ": file size is not a multiple of 16 bytes per point");
    std::vector<float> values(bytes.size() / 4), points;
    std::memcpy(values.data(), bytes.data(), bytes.size());
    for (size_t i = 0; i < values.size(); i += 4) {
        if (!std::all_of(&values[i], &values[i] + 4, [](float value) { return std::isfinite(value); })) continue;
        points.insert(points.end(), &values[i], &values[i] + 3);
        points.push_back(std::clamp(values[i + 3], 0.0f, 1.0f));
    }
    return points;
}

// Print the boxes, and what the stages take: the median of the repeats.
template <typename T>
void run(const std::string& folder, const nlohmann::json& manifest, const std::vector<float>& points, int repeats) {
    const Ort::Env env = make_env("asca");
    Detector<T> detector(env, folder, manifest);
    for (const Box& box : detector.detect(points)) {
        const auto& name = manifest.at("spec").at("classes")[box.label].at("name").get_ref<const std::string&>();
        std::printf("%s %.6f", name.c_str(), box.score);
        for (const float value : box.values) std::printf(" %.6f", value);
        std::printf("\n");
    }
    std::vector<std::vector<double>> times(detector.laps_ms.size());
    for (int repeat = 0; repeat < repeats; ++repeat) {
        detector.detect(points);
        for (size_t i = 0; i < times.size(); ++i) times[i].push_back(detector.laps_ms[i].second);
    }
    for (size_t i = 0; repeats > 0 && i < times.size(); ++i) {
        const auto middle = times[i].begin() + repeats / 2;
        std::nth_element(times[i].begin(), middle, times[i].end());
        std::fprintf(stderr, "%s %.2f ms\n", detector.laps_ms[i].first, *middle);
    }
}

}  // namespace

int main(int count, char** arguments) try {
    if (count < 3 || count > 4) throw std::runtime_error("usage: detect BUNDLE SCAN.bin [REPEATS]");
    const std::string folder = arguments[1];
    const auto manifest = read_manifest(folder);
    const std::vector<float> points = read_points(arguments[2]);
    const bool bytes = manifest.at("pillar").at("canvas").at("type") == "uint8";
    (bytes ? run<uint8_t> : run<float>)(folder, manifest, points, count > 3 ? std::atoi(arguments[3]) : 0);
} catch (const std::exception& error) {
    std::cerr << "detect: " << error.what() << "\n";
    return 2;
}
