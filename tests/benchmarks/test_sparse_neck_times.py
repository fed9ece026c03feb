"""Both necks are exported from one configuration and see the same scans; the host path is timed with its tables."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from asca_deploy import Detector, default_bundle_path
from asca_deploy.bundle import PillarBundle
from asca_deploy.manifest import load_pillar_bundle
from benchmarks.host_path import camera_view, host_path, report
from benchmarks.sparse_neck import compare_views, export_both
from tests.helpers.scenes import make_scene

CONFIG = """
name: tiny
model:
  spec: {grid: {zones: 1, v_max_m: 0.32, x_range_m: [0, 20.48], y_range_m: [-10.24, 10.24]}}
  network: {pillar_channels: 8, block_channels: [8, 8, 8], upsample_channels: 8, neck: sparse}
"""


def test_both_necks_are_exported_once(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(CONFIG)
    export = partial(export_both, str(tmp_path / "tiny.yaml"), tmp_path / "bundles", int8=False)
    remarks: list[str] = []
    folders = export(progress=remarks.append)
    bundles = {neck: Detector(folder).bundle for neck, folder in folders.items()}
    for neck in ("dense", "sparse"):
        bundle = bundles[neck]
        assert isinstance(bundle, PillarBundle) and bundle.pillar.neck == neck and bundle.precision == "float32"
    assert bundles["sparse"].backbone_gmac < bundles["dense"].backbone_gmac
    count = len(remarks)
    assert export(progress=remarks.append) == folders and len(remarks) == count > 0


def test_detectors_see_the_same_views_in_turn() -> None:
    scans = [make_scene(seed)[0] for seed in range(3)]
    cut = [len(scan[camera_view(scan)]) for scan in scans]
    assert all(0 < part < len(scan) for part, scan in zip(cut, scans, strict=True))
    seen: dict[str, list[int]] = {"dense": [], "sparse": []}
    runs = {neck: lambda points, sizes=sizes: sizes.append(len(points)) for neck, sizes in seen.items()}
    found = compare_views(runs, scans, rounds=2)
    assert list(found) == ["camera view", "whole scans"]
    whole = [len(scan) for scan in scans]
    # Each turn begins with a frame that is not timed.
    assert seen["dense"] == seen["sparse"] == [cut[0], *cut] * 2 + [whole[0], *whole] * 2


def test_the_camera_sees_ahead() -> None:
    points = np.array([[10, 0, 0, 0], [10, 9, 0, 0], [10, 0, 3, 0], [-10, 0, 0, 0]], np.float32)
    assert camera_view(points).tolist() == [True, False, False, False]


def test_the_host_path_is_timed_with_its_tables(capsys: pytest.CaptureFixture[str]) -> None:
    report(host_path(make_scene(0)[0], load_pillar_bundle(default_bundle_path())), rounds=1)
    rows = [row for row in capsys.readouterr().out.splitlines() if row.startswith("|")][2:]
    assert [row.split("|")[1].strip() for row in rows] == ["input", "pillarize", "decode", "tables", "all"]
