"""`asca detect --track --odometry`: velocities over ground, and odometry that does not belong to the scans."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ConfigError, ScanError
from tests.cli.short_drive import POINTS, SCANS, run
from tests.scans.recordings.cloud_recordings import laid_out, odometry_message, stamps, write_mcap


def test_with_odometry_what_stands_still_has_no_speed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scans are those of a car that drives 5 m/s past things that stand still."""
    messages = [
        (time_ns, laid_out(POINTS - np.array([0.5 * i, 0, 0, 0], np.float32), time_ns=time_ns))
        for i, time_ns in enumerate(stamps(SCANS))
    ]
    poses = [
        (time_ns - 10**7, odometry_message(time_ns - 10**7, 100 + 0.5 * i - 0.05))
        for i, time_ns in enumerate(stamps(SCANS + 1))
    ]
    path = write_mcap(tmp_path / "drive.mcap", {"/lidar": messages}, odometry=poses)
    lines = run(path, tmp_path / "out", track=True, odometry="/odom")
    speeds = [np.hypot(box["vx_mps"], box["vy_mps"]) for box in lines[-1]["boxes"] if box["class"] == "Car"]
    assert len(speeds) >= 3 and np.median(speeds) < 1
    mirror = np.array([1, -1, 1, 1], np.float32)
    mirrored = [
        (time_ns, laid_out((POINTS - np.array([0.5 * i, 0, 0, 0], np.float32)) * mirror, time_ns=time_ns))
        for i, time_ns in enumerate(stamps(SCANS))
    ]
    path_mirrored = write_mcap(tmp_path / "mirrored.mcap", {"/lidar": mirrored}, odometry=poses)
    seen = run(path_mirrored, tmp_path / "mirrored", track=True, odometry="/odom", axes="x,-y,z")
    for key, sign in (("x_m", 1), ("y_m", -1), ("vx_mps", 1), ("vy_mps", -1), ("track_id", 1)):
        expected = [sign * box[key] for box in lines[-1]["boxes"]]
        assert [box[key] for box in seen[-1]["boxes"]] == pytest.approx(expected, abs=1e-3)
    late = [(time_ns + 37 * 10**9, odometry_message(time_ns + 37 * 10**9, 0.0)) for time_ns in stamps(SCANS)]
    other = write_mcap(tmp_path / "other.mcap", {"/lidar": messages}, odometry=late)
    with pytest.raises(ScanError, match=r"from \+37.0 to \+37.4 s of the first scan; 5 of 5 scans are at other times"):
        run(other, tmp_path / "other", track=True, odometry="/odom")
    short = write_mcap(tmp_path / "short.mcap", {"/lidar": messages}, odometry=poses[:2])
    run(short, tmp_path / "short", track=True, odometry="/odom")
    assert "2 of 5 scans lie outside" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(ConfigError, match="give --track"):
        run(path, tmp_path / "out", odometry="/odom")
    with pytest.raises(ScanError, match="/lidar holds no nav_msgs/msg/Odometry; there is /odom"):
        run(path, tmp_path / "out", track=True, odometry="/lidar")
