"""The scores that a detector and a tracker are opened with, and where the detector looks."""

from pathlib import Path

import numpy as np
import pytest

from asca_deploy import find_bundle, sample_scan_path
from asca_deploy.manifest import load_bundle
from asca_deploy.open_model import RuntimeOptions, files_need_around, track_thresholds
from asca_deploy.tracker import WEAK_SHARE
from asca_pillars.base.errors import ConfigError
from asca_pillars.scans.scan_input import ScanInput
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.scans.scan_settings import ScanSettings


def test_tracks_begin_at_the_thresholds_and_go_on_below_the_lowest() -> None:
    own = {one.name: one.score_threshold for one in load_bundle(find_bundle(None)).spec.classes}
    births, least = track_thresholds(None)
    assert births == own and least == pytest.approx(WEAK_SHARE * min(own.values()))
    births, least = track_thresholds(None, {"Car": 0.1})
    assert births == own | {"Car": 0.1} and least == pytest.approx(WEAK_SHARE * 0.1)
    with pytest.raises(ConfigError, match="Tram"):
        track_thresholds(None, {"Tram": 0.5})


def test_scans_all_around_the_sensor_are_looked_at_in_every_direction(tmp_path: Path) -> None:
    """Also where x is not forward; a camera's part of a scan, and KITTI's frames, are looked at ahead."""
    revolution = read_scan(sample_scan_path()).points
    turned = np.column_stack([-revolution[:, 1], revolution[:, 0], revolution[:, 2:]])  # x right, y forward
    part = revolution[np.abs(np.arctan2(revolution[:, 1], revolution[:, 0])) < 0.7]
    for points, axes, expected in [
        (revolution, "x-forward", True),
        (turned, "y-forward", True),
        (part, "x-forward", False),
    ]:
        path = tmp_path / "scan.npy"
        np.save(path, points)
        scan_input = ScanInput(ScanSettings(axes=axes), [path])
        assert files_need_around(RuntimeOptions(), scan_input) == expected
        assert [line for line in scan_input.notes if "looking all around, in 4 passes (--ahead" in line] or not expected
    in_kitti_layout = tmp_path / "velodyne" / "000000.bin"
    for file in (in_kitti_layout, tmp_path / "calib" / "000000.txt"):
        file.parent.mkdir()
        file.touch()
    revolution.tofile(in_kitti_layout)
    assert not files_need_around(RuntimeOptions(), ScanInput(ScanSettings(), [in_kitti_layout]))
