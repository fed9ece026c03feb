"""Poses between those that were recorded."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.odometry import read_poses
from asca_pillars.scans.recordings.open_recording import open_recording
from tests.scans.recordings.cloud_recordings import START_NS, clouds, odometry_message, write_mcap

SECOND = 10**9


def test_poses_lie_between_their_neighbors_and_stop_at_the_ends(tmp_path: Path) -> None:
    messages = [
        (START_NS + i * SECOND, odometry_message(START_NS + i * SECOND, 10.0 * i, yaw))
        for i, yaw in enumerate((3.0, 3.2, 3.4))
    ]
    poses = read_poses(open_recording(write_mcap(tmp_path / "a.mcap", {}, odometry=messages)), "/odom")
    for share, x_m, yaw in (
        (-5.0, 0, 3.0),
        (0.0, 0, 3.0),
        (0.5, 5, 3.1),
        (1.25, 12.5, 3.25),
        (2.0, 20, 3.4),
        (9.0, 20, 3.4),
    ):
        matrix = poses.at(START_NS + round(share * SECOND))
        assert matrix[:3, 3] == pytest.approx([x_m, 0, 0], abs=1e-6)
        assert matrix[:2, 0] == pytest.approx([np.cos(yaw), np.sin(yaw)], abs=1e-4)
        assert matrix[:3, :3] @ matrix[:3, :3].T == pytest.approx(np.eye(3))


def test_a_car_that_leans_is_turned_about_every_axis(tmp_path: Path) -> None:
    turns = [(0.3, -0.2, 2.0), (-0.1, 0.4, 2.5)]
    messages = [
        (time_ns, odometry_message(time_ns, 0.0, yaw, roll_rad=roll, pitch_rad=pitch))
        for time_ns, (roll, pitch, yaw) in zip((START_NS, START_NS + SECOND), turns, strict=True)
    ]
    poses = read_poses(open_recording(write_mcap(tmp_path / "a.mcap", {}, odometry=messages)), "/odom")
    between = Slerp([0, 1], Rotation.from_euler("xyz", turns))
    for share in (0.0, 0.5, 1.0):  # where a straight line between two quaternions is as far along as the arc
        found = poses.at(START_NS + round(share * SECOND))[:3, :3]
        np.testing.assert_allclose(found, between(share).as_matrix(), atol=1e-9)


def test_a_quaternion_and_its_opposite_are_the_same_turn(tmp_path: Path) -> None:
    """From the second pose on the sender gives the other sign, and keeps it."""
    yaws, messages = (0.1, 0.3, 0.5, 0.7), []
    for i, yaw in enumerate(yaws):
        message = odometry_message(START_NS + i * SECOND, 0.0, yaw)
        if i:
            turn = message.pose.pose.orientation
            turn.z, turn.w = -turn.z, -turn.w
        messages.append((START_NS + i * SECOND, message))
    poses = read_poses(open_recording(write_mcap(tmp_path / "a.mcap", {}, odometry=messages)), "/odom")
    for i in range(len(yaws) - 1):
        matrix, yaw = poses.at(START_NS + i * SECOND + SECOND // 2), (yaws[i] + yaws[i + 1]) / 2
        assert matrix[:2, 0] == pytest.approx([np.cos(yaw), np.sin(yaw)], abs=1e-6)


def test_one_pose_is_enough(tmp_path: Path) -> None:
    recording = open_recording(
        write_mcap(tmp_path / "a.mcap", {}, odometry=[(START_NS, odometry_message(START_NS, 4.0))])
    )
    assert read_poses(recording, "/odom").at(START_NS + 7)[0, 3] == 4.0


def test_what_cannot_be_used_is_named(tmp_path: Path) -> None:
    turned = odometry_message(START_NS, 1.0)
    turned.pose.pose.orientation.w = 1e300
    useless = [odometry_message(START_NS, np.nan), odometry_message(START_NS, -1e300), turned]
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(1)}, odometry=[(START_NS, message) for message in useless])
    with pytest.raises(ScanError, match="no pose can be used"):
        read_poses(open_recording(path), "/odom")
    with pytest.raises(ScanError, match="/gps holds no nav_msgs/msg/Odometry; there is /odom"):
        read_poses(open_recording(path), "/gps")
