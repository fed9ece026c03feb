"""Poses between those that were recorded."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.odometry import Poses, read_poses
from asca_pillars.scans.recordings.open_recording import open_recording
from tests.scans.recordings.cloud_recordings import START_NS, odometry_message, write_mcap

SECOND = 10**9


def poses_of(path: Path, messages: list[Any]) -> Poses:
    """Of a recording with a pose each second."""
    odometry = [(START_NS + i * SECOND, message) for i, message in enumerate(messages)]
    return read_poses(open_recording(write_mcap(path / "a.mcap", {}, odometry=odometry)), "/odom")


def posed(number: int, x_m: float, *turn: float) -> Any:
    roll, pitch, yaw = turn or (0.0, 0.0, 0.0)
    return odometry_message(START_NS + number * SECOND, x_m, yaw, roll_rad=roll, pitch_rad=pitch)


@pytest.mark.parametrize(
    ("share", "x_m", "yaw"), [(-5, 0, 3.0), (0, 0, 3.0), (0.5, 5, 3.1), (1.25, 12.5, 3.25), (2, 20, 3.4), (9, 20, 3.4)]
)
def test_poses_lie_between_their_neighbors_and_stop_at_the_ends(
    tmp_path: Path, share: float, x_m: float, yaw: float
) -> None:
    poses = poses_of(tmp_path, [posed(i, 10.0 * i, 0, 0, yaw) for i, yaw in enumerate((3.0, 3.2, 3.4))])
    matrix = poses.at(START_NS + round(share * SECOND))
    assert matrix[:3, 3] == pytest.approx([x_m, 0, 0], abs=1e-6)
    assert matrix[:2, 0] == pytest.approx([np.cos(yaw), np.sin(yaw)], abs=1e-4)
    assert matrix[:3, :3] @ matrix[:3, :3].T == pytest.approx(np.eye(3))


def test_a_car_that_leans_is_turned_about_every_axis_and_one_pose_is_enough(tmp_path: Path) -> None:
    turns = [(0.3, -0.2, 2.0), (-0.1, 0.4, 2.5)]
    poses = poses_of(tmp_path, [posed(i, 0.0, *turn) for i, turn in enumerate(turns)])
    between = Slerp([0, 1], Rotation.from_euler("xyz", turns))
    for share in (0.0, 0.5, 1.0):  # where a straight line between two quaternions is as far along as the arc
        found = poses.at(START_NS + round(share * SECOND))[:3, :3]
        np.testing.assert_allclose(found, between(share).as_matrix(), atol=1e-9)
    assert poses_of(tmp_path, [posed(0, 4.0)]).at(START_NS + 7)[0, 3] == 4.0


def test_a_quaternion_and_its_opposite_are_the_same_turn(tmp_path: Path) -> None:
    """From the second pose on the sender gives the other sign, and keeps it."""
    yaws = (0.1, 0.3, 0.5, 0.7)
    messages = [posed(i, 0.0, 0, 0, yaw) for i, yaw in enumerate(yaws)]
    for message in messages[1:]:
        turn = message.pose.pose.orientation
        turn.z, turn.w = -turn.z, -turn.w
    poses = poses_of(tmp_path, messages)
    for i, yaw in enumerate((0.2, 0.4, 0.6)):
        matrix = poses.at(START_NS + i * SECOND + SECOND // 2)
        assert matrix[:2, 0] == pytest.approx([np.cos(yaw), np.sin(yaw)], abs=1e-6)


def test_what_cannot_be_used_is_named(tmp_path: Path) -> None:
    turned = posed(0, 1.0)
    turned.pose.pose.orientation.w = 1e300
    with pytest.raises(ScanError, match="no pose can be used"):
        poses_of(tmp_path, [posed(0, np.nan), posed(1, -1e300), turned])
    with pytest.raises(ScanError, match="/gps holds no nav_msgs/msg/Odometry; there is /odom"):
        read_poses(open_recording(tmp_path / "a.mcap"), "/gps")
