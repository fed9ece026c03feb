"""The C++ example, compiled: it finds the boxes of the golden vectors, and refuses what it cannot run."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from asca_deploy import sample_scan_path, shipped_bundles
from asca_deploy.golden import write_golden
from asca_pillars.data.scans.scan_reader import write_scan
from tests.deploy import conftest as tiny

SOURCE = Path(__file__).parents[2] / "examples" / "cpp" / "detect.cpp"
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
    command = [
        *(COMPILER, "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", *flags, str(SOURCE)),
        *(str(LIBRARIES[-1]), f"-Wl,-rpath,{folder}", "-o", str(folder / "detect")),
    ]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return folder / "detect"


def assert_golden(detect: Path, bundle: Path, scan: Path, golden: Path) -> None:
    stages = write_golden(golden, bundle, scan)
    lines = subprocess.run([detect, bundle, scan], check=True, capture_output=True, text=True).stdout.splitlines()
    found = np.array([line.split()[1:] for line in lines], float)
    expected = stages["suppress"]
    assert len(expected["boxes"]) > 2
    np.testing.assert_allclose(found[:, 1:], expected["boxes"], atol=1e-3)
    np.testing.assert_allclose(found[:, 0], expected["scores"], atol=1e-3)
    names = ("Car", "Pedestrian", "Cyclist")
    assert [line.split()[0] for line in lines] == [names[label] for label in expected["labels"]]


def test_it_finds_the_boxes_of_the_models_that_ship(detect: Path, tmp_path: Path) -> None:
    for name in ("asca_small_sim", "asca_small_sim_int8"):  # the example has no tables of a sparse neck
        assert_golden(detect, shipped_bundles()[name], sample_scan_path(), tmp_path / name)


def test_a_grid_of_three_zones_beyond_both_limits(detect: Path, tiny_bundle: Path, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", tiny.make_scan(3, 6000))
    assert_golden(detect, tiny_bundle, tmp_path / "scan.bin", tmp_path / "golden")


def test_mistakes_are_one_line(detect: Path, tiny_bundle: Path, tmp_path: Path) -> None:
    (tmp_path / "torn.bin").write_bytes(b"torn")
    for arguments, said in (
        ([tmp_path, sample_scan_path()], "bundle.json: cannot be read"),
        ([tiny_bundle, tmp_path / "torn.bin"], "torn.bin: no whole number of points"),
        ([], "usage: detect BUNDLE SCAN.bin"),
    ):
        result = subprocess.run([detect, *arguments], capture_output=True, text=True)
        assert result.returncode == 2
        assert said in result.stderr and result.stderr.count("\n") == 1
