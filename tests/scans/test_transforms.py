"""Frames are found over common parents, in both directions, and points of recordings are taken into them.

Poses between those that were recorded.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.recorded_scans import RecordedScans, open_recording
from asca_pillars.scans.recordings.recording import Message, Recording, Topic
from asca_pillars.scans.transforms import TRANSFORM_TYPES, Poses, Transforms, read_poses, read_static_transforms
from tests.scans.recordings.cloud_recordings import (
    START_NS,
    TRANSFORMS,
    cloud_points,
    laid_out,
    odometry_message,
    serialized,
    stamps,
    transform_message,
    write_mcap,
)

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")


def placed(shift: tuple[float, float, float], *angles_deg: float) -> NDArray[np.float64]:
    """(4, 4), turned by roll, pitch and yaw."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", angles_deg or [0, 0, 0], degrees=True).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def tree(*transforms: tuple[str, str, NDArray[np.float64]]) -> Transforms:
    """Of poses of a child in its parent: (parent, child, pose)."""
    found = Transforms()
    for parent, child, pose in transforms:
        found.add(transform_message(parent, child, pose))
    return found


def test_frames_along_the_tree_and_frames_that_nothing_connects() -> None:
    roof, lidar, camera = placed((0, 0, 1.5), 0, 0, 90), placed((1, 0, 0.2), 0, 10, 0), placed((2, 0, 1))
    transforms = tree(("base_link", "roof", roof), ("/roof", "/lidar", lidar), ("base_link", "camera", camera))
    for source, target, expected in (
        ("lidar", "base_link", roof @ lidar),
        ("base_link", "lidar", np.linalg.inv(roof @ lidar)),
        ("lidar", "camera", np.linalg.inv(camera) @ roof @ lidar),
        ("lidar", "lidar", np.eye(4)),
    ):
        pose = transforms.between(source, target)
        assert pose is not None and pose == pytest.approx(np.asarray(expected))
    assert transforms.frames == ["base_link", "camera", "lidar", "roof"]
    assert Transforms().between("lidar", "base_link") is None
    shifted = placed((1, 0, 0))
    assert tree(("a", "b", shifted), ("b", "a", shifted)).between("a", "base_link") is None
    transforms = tree(("base_link", "lidar", placed((1, 0, 0))), ("base_link", "lidar", placed((5, 0, 0))))
    broken = transform_message("base_link", "lidar", placed((7, 0, 0)))
    broken.transforms[0].transform.rotation.w = 0.0
    transforms.add(broken)
    pose = transforms.between("lidar", "base_link")
    assert pose is not None and pose[0, 3] == 5


# --- recordings

POSE = placed((1.2, -0.3, 1.9), 8, -35, 170)  # upside: no `axes` says it


def scans(path: Path, frame: str | None) -> RecordedScans:
    recording = open_recording(path)
    return RecordedScans(recording, recording.point_cloud_topic(), 1.0, frame)


def test_points_are_taken_into_the_frame(tmp_path: Path) -> None:
    points, half = cloud_points(1), np.diag([-1.0, -1.0, 1.0, 1.0])
    messages = [(time, laid_out(points, time_ns=time)) for time in stamps(2)]
    chain = [transform_message("base_link", "roof", POSE @ half), transform_message("roof", "lidar", half)]
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": messages}, transforms=chain)
    expected = points[:, :3] @ POSE[:3, :3].T + POSE[:3, 3]
    for one in scans(path, "base_link").read():
        assert one.scan is not None and one.frame_id == "base_link"
        assert one.scan.points[:, :3] == pytest.approx(expected, abs=1e-4)
        assert np.array_equal(one.scan.points[:, 3], points[:, 3])
    (first,) = scans(path, "base_link").first(1)
    assert first.points[:, :3] == pytest.approx(expected, abs=1e-4)
    same = next(iter(scans(path, None).read()))
    assert same.scan is not None and np.array_equal(same.scan.points, points) and same.frame_id == "lidar"


def test_frames_that_are_not_known_are_refused(tmp_path: Path) -> None:
    messages = {"/lidar": [(stamps(1)[0], laid_out(cloud_points(1)))]}
    with pytest.raises(ScanError, match=r"no messages on /tf_static .*--axes or --pose instead"):
        scans(write_mcap(tmp_path / "a.mcap", messages), "base_link")
    path = write_mcap(tmp_path / "b.mcap", messages, transforms=[transform_message("base_link", "camera", POSE)])
    with pytest.raises(ScanError, match=r"/tf_static names no car; there is base_link, camera, or say"):
        scans(path, "car")
    (one,) = scans(path, "base_link").read()
    assert one.scan is None
    assert "no static transform leads from lidar to base_link; there are base_link, camera" in str(one.error_text)


def test_transforms_of_ros_1_are_read(tmp_path: Path) -> None:
    class Bag(Recording):
        path = tmp_path
        topics = (Topic("/car/tf_static", "tf2_msgs/TFMessage", 2),)

        def messages(self, topic: str) -> Iterator[Message]:
            message = transform_message("base_link", "lidar", POSE, ros1=True)
            yield Message(1, b"torn", "ros1")
            yield Message(1, serialized(message, TRANSFORMS, ros1=True), "ros1")

    assert Bag.topics[0].type in TRANSFORM_TYPES
    pose = read_static_transforms(Bag(), "base_link").between("lidar", "base_link")
    assert pose is not None and pose == pytest.approx(POSE)


pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")


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
