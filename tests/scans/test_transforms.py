"""Frames are found over common parents, in both directions, and points of recordings are taken into them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.open_recording import open_recording
from asca_pillars.scans.recordings.recorded_scans import RecordedScans
from asca_pillars.scans.recordings.recording import Message, Recording, Topic
from asca_pillars.scans.transforms import TRANSFORM_TYPES, Transforms, read_static_transforms
from tests.scans.recordings.cloud_recordings import (
    TRANSFORMS,
    cloud_points,
    laid_out,
    serialized,
    stamps,
    transform_message,
    write_mcap,
)


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
