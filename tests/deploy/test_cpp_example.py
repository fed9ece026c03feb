"""The C++ example, compiled: rulebooks and boxes of the golden vectors, and refusals of what it cannot run."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from asca_deploy import sample_scan_path, shipped_bundles
from asca_deploy.golden import write_golden
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebookBuilder, rulebook_inputs
from asca_pillars.scans.scan_reader import write_scan
from tests.deploy import conftest as tiny
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8

EXAMPLE = Path(__file__).parents[2] / "examples" / "cpp"
COMPILER = shutil.which("g++") or shutil.which("clang++")
LIBRARIES = sorted((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*"))
"""Of the Python package; its C interface is that of the C++ one, and older headers go with it."""


def include_flags() -> list[str] | None:
    """Where the headers are: below ASCA_ORT_INCLUDE (several folders, divided by `:`), or what pkg-config says."""
    if stated := os.environ.get("ASCA_ORT_INCLUDE"):
        return [f"-I{folder}" for folder in stated.split(os.pathsep)]
    if shutil.which("pkg-config") is None:
        return None
    found = subprocess.run(
        ["pkg-config", "--cflags", "libonnxruntime", "nlohmann_json"], capture_output=True, text=True
    )
    return found.stdout.split() if found.returncode == 0 else None


@pytest.fixture(scope="module")
def detect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, beside the library that it was linked with."""
    flags = include_flags()
    if COMPILER is None or flags is None or not LIBRARIES:
        pytest.skip("needs a C++ compiler and the headers of onnxruntime and nlohmann-json (ASCA_ORT_INCLUDE)")
    folder = tmp_path_factory.mktemp("cpp")
    (folder / "libonnxruntime.so.1").symlink_to(LIBRARIES[-1])
    return build(EXAMPLE / "detect.cpp", folder / "detect", *flags, str(LIBRARIES[-1]), f"-Wl,-rpath,{folder}")


@pytest.fixture(scope="module")
def build_rulebooks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program that writes the rulebooks of the scans that it is given."""
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    return build(
        Path(__file__).parent / "cpp" / "build_rulebooks.cpp", tmp_path_factory.mktemp("cpp") / "build_rulebooks"
    )


def test_cmake_takes_an_unpacked_release(tmp_path: Path) -> None:
    """The folder as a release has it, made of the headers and the library that there are; it runs the default model."""
    flags, cmake = include_flags(), shutil.which("cmake")
    if COMPILER is None or flags is None or cmake is None or not LIBRARIES:
        pytest.skip("needs cmake, a C++ compiler and the headers of onnxruntime and nlohmann-json (ASCA_ORT_INCLUDE)")
    folders = [Path(flag.removeprefix("-I")) for flag in flags if flag.startswith("-I")] or [Path("/usr/include")]
    headers = next(path.parent for folder in folders for path in folder.rglob("onnxruntime_cxx_api.h"))
    json_folder = next(path.parents[1] for folder in folders for path in folder.rglob("nlohmann/json.hpp"))
    release = tmp_path / "onnxruntime-linux-x64"
    (release / "lib").mkdir(parents=True)
    (release / "include").symlink_to(headers)
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (release / "lib" / name).symlink_to(LIBRARIES[-1])
    stated = (f"-DONNXRUNTIME_ROOT={release}", f"-DNLOHMANN_JSON_INCLUDE={json_folder}")
    subprocess.run([cmake, "-S", EXAMPLE, "-B", tmp_path / "build", *stated], check=True, capture_output=True)
    subprocess.run([cmake, "--build", tmp_path / "build"], check=True, capture_output=True)
    command = [tmp_path / "build" / "detect", shipped_bundles()["default"], sample_scan_path()]
    found = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "Car" in found


def test_cmake_names_what_is_missing(tmp_path: Path) -> None:
    cmake = shutil.which("cmake")
    if COMPILER is None or cmake is None:
        pytest.skip("needs cmake and a C++ compiler")
    command: list[str | Path] = [cmake, "-S", EXAMPLE, "-B", tmp_path / "build", f"-DONNXRUNTIME_ROOT={tmp_path}"]
    command += ["-DCMAKE_DISABLE_FIND_PACKAGE_onnxruntime=ON", "-DONNXRUNTIME_LIBRARY=ONNXRUNTIME_LIBRARY-NOTFOUND"]
    done = subprocess.run([*command, "-DCMAKE_FIND_USE_CMAKE_SYSTEM_PATH=OFF"], capture_output=True, text=True)
    assert done.returncode != 0 and "give -DONNXRUNTIME_ROOT=FOLDER" in " ".join(done.stderr.split())


def build(source: Path, program: Path, *flags: str) -> Path:
    options = ("-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLE}")
    command = [str(COMPILER), *options, str(source), *flags, "-o", str(program)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return program


@pytest.mark.parametrize("rule", ["sub", "fine"])
def test_rulebooks_are_those_of_python(build_rulebooks: Path, rule: MaskRule) -> None:
    ny, nx = 24, 40
    rng = np.random.default_rng(6)
    # A full map before sparse ones, which must not inherit it; nothing, and the corners alone.
    scans = [np.flatnonzero(rng.random(ny * nx) < share) for share in (1.0, 0.05, 0.0, 0.3)]
    scans.append(np.array([0, nx - 1, (ny - 1) * nx, ny * nx - 1]))
    given = b"".join(np.array([len(cells), *cells], np.int32).tobytes() for cells in scans)
    answer = subprocess.run([build_rulebooks, str(ny), str(nx), rule], input=given, check=True, capture_output=True)
    values = np.frombuffer(answer.stdout, np.int32)
    for cells in scans:
        rulebooks = NeckRulebookBuilder(ny, nx, rule).build(cells)
        expected = {**rulebook_inputs(rulebooks), "head_cells": rulebooks.head_cells}
        for name, rulebook in expected.items():
            if name.startswith("first") and (rule, name) != ("fine", "first_0"):
                rulebook = rulebook[:0]  # where nothing grows a graph reads `same`
            found, values = values[1 : 1 + values[0]], values[1 + values[0] :]
            np.testing.assert_array_equal(found, rulebook.reshape(-1), err_msg=name)
    assert not len(values)


def assert_golden(detect: Path, bundle: Path, scan: Path, golden: Path, least: int = 3) -> None:
    stages = write_golden(golden, bundle, scan)
    lines = subprocess.run([detect, bundle, scan], check=True, capture_output=True, text=True).stdout.splitlines()
    found = np.array([line.split()[1:] for line in lines], float).reshape(-1, 8)
    expected = stages["suppress"]
    assert len(expected["boxes"]) >= least
    np.testing.assert_allclose(found[:, 1:], expected["boxes"], atol=1e-3)
    np.testing.assert_allclose(found[:, 0], expected["scores"], atol=1e-3)
    names = ("Car", "Pedestrian", "Cyclist")
    assert [line.split()[0] for line in lines] == [names[label] for label in expected["labels"]]


def test_it_finds_the_boxes_of_the_models_that_ship(detect: Path, tmp_path: Path) -> None:
    for folder in (DENSE_FLOAT32, DENSE_INT8, shipped_bundles()["default_float32"], shipped_bundles()["default"]):
        assert_golden(detect, folder, sample_scan_path(), tmp_path / folder.name)


def test_it_leaves_nothing_behind(detect: Path, tmp_path: Path) -> None:
    """onnxruntime writes an identifier to the home folder when it is going to report."""
    command = [detect, DENSE_FLOAT32, sample_scan_path()]
    subprocess.run(command, check=True, capture_output=True, env={"HOME": str(tmp_path)})
    assert list(tmp_path.iterdir()) == []


def test_a_grid_of_three_zones_beyond_both_limits_and_a_scan_without_pillars(
    detect: Path, any_bundle: Path, tmp_path: Path
) -> None:
    write_scan(tmp_path / "scan.bin", tiny.make_scan(3, 6000))
    write_scan(tmp_path / "far.bin", np.array([[-50, 0, 0, 0.5]], np.float32))
    assert_golden(detect, any_bundle, tmp_path / "scan.bin", tmp_path / "golden")
    assert_golden(detect, any_bundle, tmp_path / "far.bin", tmp_path / "golden of far", least=0)


@pytest.mark.parametrize("neck", ["dense", "sparse"])
def test_repeats_say_what_the_stages_take(
    detect: Path, neck: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    write_scan(tmp_path / "scan.bin", tiny.make_scan())
    bundle = request.getfixturevalue("tiny_bundle" if neck == "dense" else "sparse_bundle")
    result = subprocess.run([detect, bundle, tmp_path / "scan.bin", "3"], check=True, capture_output=True, text=True)
    stages = [line.split() for line in result.stderr.splitlines()]
    placed = "scatter" if neck == "dense" else "rulebooks"
    assert [stage for stage, _, _ in stages] == ["pillarize", "encode", placed, "neck+head", "decode"]
    assert all(float(time) >= 0 and unit == "ms" for _, time, unit in stages)
    assert len(result.stdout.splitlines()) > 2


def test_mistakes_are_one_line(detect: Path, tiny_bundle: Path, tmp_path: Path) -> None:
    (tmp_path / "torn.bin").write_bytes(b"torn")
    pooled, every = (tmp_path / name for name in ("pooled", "every"))
    for folder, key, value in ((pooled, "grid", {"map": "pooled"}), (every, "anchor_scores", "every")):
        shutil.copytree(tiny_bundle, folder)
        manifest = json.loads((folder / "bundle.json").read_text())
        spec = manifest["spec"]
        spec[key] = {**spec[key], **value} if isinstance(value, dict) else value
        (folder / "bundle.json").write_text(json.dumps(manifest))
    for arguments, message in (
        ([tmp_path, sample_scan_path()], "bundle.json: cannot be read"),
        ([pooled, sample_scan_path()], "pooled: needs schema 3, kind pillar and a warped map"),
        ([every, sample_scan_path()], "every: needs anchors at cell centers with one score for each"),
        ([tiny_bundle, tmp_path / "torn.bin"], "torn.bin: file size is not a multiple of 16"),
        ([], "usage: detect BUNDLE SCAN.bin [REPEATS]"),
    ):
        result = subprocess.run([detect, *arguments], capture_output=True, text=True)
        assert result.returncode == 2
        assert message in result.stderr and result.stderr.count("\n") == 1
