"""Golden vectors: complete, true to the detector, readable without us, and refused where they would say less."""

import json
from pathlib import Path

import numpy as np
import pytest

from asca_deploy import Detector
from asca_deploy.golden import write_golden
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import ConfigError, OutputError
from asca_pillars.scans.scan_reader import write_scan
from tests.deploy import conftest as tiny
from tests.helpers.in_process import invoke


@pytest.fixture
def scan_path(tmp_path: Path) -> Path:
    write_scan(tmp_path / "scans" / "a.bin", tiny.make_scan())
    return tmp_path / "scans" / "a.bin"


def read(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """The arrays as golden.json names them."""
    stages = json.loads((folder / "golden.json").read_text())["stages"]
    return {
        entry["stage"]: {name: np.load(folder / array["file"]) for name, array in entry["arrays"].items()}
        for entry in stages
    }


def test_each_stage_follows_from_the_one_before(tiny_bundle: Path, scan_path: Path, tmp_path: Path) -> None:
    write_golden(tmp_path / "golden", tiny_bundle, scan_path)
    stages = read(tmp_path / "golden")
    assert list(stages) == ["input", "pillarize", "encode", "scatter", "neck+head", "decode", "suppress"]
    points, pillars = stages["input"]["points"], stages["pillarize"]
    np.testing.assert_array_equal(points, tiny.make_scan())
    assert len(pillars["features"]) == pillars["point_counts"].sum() == len(pillars["pillar_index"])
    # docs/BUNDLE.md: canvas[0, 1 + cell // nx, 1 + cell % nx] = pillar_features[pillar]
    grid = tiny.SPEC.grid
    row, column = np.divmod(stages["scatter"]["rows"], grid.nx + 1)
    np.testing.assert_array_equal((row - 1) * grid.nx + column - 1, pillars["cells"])
    np.testing.assert_array_equal(stages["scatter"]["values"], stages["encode"]["pillar_features"])
    assert stages["neck+head"]["boxes"].shape == (*grid.head_shape, 7 * 6)
    assert set(map(tuple, stages["suppress"]["boxes"])) < set(map(tuple, stages["decode"]["boxes"]))
    expected = Detector(tiny_bundle, threads=1)(points)
    assert len(expected) > 2
    for name in ("boxes", "scores", "labels"):
        np.testing.assert_array_equal(stages["suppress"][name], getattr(expected, name))


def test_the_manifest_says_which_bundle_and_scan(tiny_bundle: Path, scan_path: Path, tmp_path: Path) -> None:
    output = invoke("export", tiny_bundle, "--golden", "-o", tmp_path / "golden", "--scans", scan_path.parent)
    assert "boxes of a.bin" in " ".join(output.split())
    contents = json.loads((tmp_path / "golden" / "golden.json").read_text())
    assert (contents["bundle"], contents["scan"], contents["precision"]) == ("tiny", "a.bin", "float32")
    assert contents["graphs"] == {name: graph.sha256 for name, graph in load_pillar_bundle(tiny_bundle).graphs.items()}
    for entry in contents["stages"]:
        for array in entry["arrays"].values():
            stored = np.load(tmp_path / "golden" / array["file"])
            assert (str(stored.dtype), list(stored.shape)) == (array["type"], array["shape"])
            assert stored.flags.c_contiguous


def test_a_scan_without_points(tiny_bundle: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "empty.npy", np.empty((0, 4), np.float32))
    stages = write_golden(tmp_path / "golden", tiny_bundle, tmp_path / "empty.npy")
    assert stages["encode"]["pillar_features"].shape == (0, tiny.CHANNELS)
    assert stages["scatter"]["rows"].shape == (0,)


def test_written_again_and_only_over_itself(tiny_bundle: Path, scan_path: Path, tmp_path: Path) -> None:
    write_golden(tmp_path / "golden", tiny_bundle, scan_path)
    write_golden(tmp_path / "golden", tiny_bundle, scan_path)
    (tmp_path / "golden" / "thesis.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"thesis\.txt"):
        write_golden(tmp_path / "golden", tiny_bundle, scan_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--golden", "--int8"], "--int8 is for a checkpoint"),
        (["--golden", "--with-weights"], "--with-weights is for a checkpoint"),
        (["--golden", "--score", "Car=0.3"], "--score is for a checkpoint"),
        (["--golden", "--browser"], "either --golden or --browser"),
        (["--ort-web", "x.tgz"], "--ort-web is for --browser"),
    ],
)
def test_options_that_do_not_go_together(tiny_bundle: Path, tmp_path: Path, options: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        invoke("export", tiny_bundle, "-o", tmp_path / "out", *options)
