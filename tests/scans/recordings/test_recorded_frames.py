"""Points of recordings in the vehicle's frame, by /tf_static."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from scipy.spatial.transform import Rotation

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.messages import typestore
from asca_pillars.scans.recordings.open_recording import open_recording
from asca_pillars.scans.recordings.recorded_scans import RecordedScans
from asca_pillars.scans.recordings.recording import Message, Recording, Topic
from asca_pillars.scans.transforms import TRANSFORM_TYPES, read_static_transforms
from tests.scans.recordings.cloud_recordings import (
    TRANSFORMS,
    cloud_points,
    laid_out,
    stamps,
    transform_message,
    write_mcap,
)

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", [8, -35, 170], degrees=True).as_matrix()  # upside: no `axes` says it
POSE[:3, 3] = 1.2, -0.3, 1.9


def scans(path: Path, frame: str | None) -> RecordedScans:
    recording = open_recording(path)
    return RecordedScans(recording, recording.point_cloud_topic(), 1.0, frame)


def test_points_are_taken_into_the_frame(tmp_path: Path) -> None:
    points = cloud_points(1)
    messages = [(time, laid_out(points, time_ns=time)) for time in stamps(2)]
    half = np.linalg.inv(np.diag([-1.0, -1.0, 1.0, 1.0]))
    chain = [
        transform_message("base_link", "roof", POSE @ half),
        transform_message("roof", "lidar", np.linalg.inv(half).astype(np.float64)),
    ]
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": messages}, transforms=chain)
    for one in scans(path, "base_link").read():
        assert one.scan is not None and one.frame_id == "base_link"
        expected = points[:, :3] @ POSE[:3, :3].T + POSE[:3, 3]
        assert one.scan.points[:, :3] == pytest.approx(expected, abs=1e-4)
        assert np.array_equal(one.scan.points[:, 3], points[:, 3])
    (first,) = scans(path, "base_link").first(1)
    assert first.points[:, :3] == pytest.approx(expected, abs=1e-4)
    same = next(iter(scans(path, None).read()))
    assert same.scan is not None and np.array_equal(same.scan.points, points) and same.frame_id == "lidar"


def test_frames_that_are_not_known_are_refused(tmp_path: Path) -> None:
    messages = {"/lidar": [(stamps(1)[0], laid_out(cloud_points(1)))]}
    path = write_mcap(tmp_path / "a.mcap", messages)
    with pytest.raises(ScanError, match=r"no messages on /tf_static .*--axes or --pose instead"):
        scans(path, "base_link")
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
            yield Message(1, bytes(typestore("ros1").serialize_ros1(message, TRANSFORMS)), "ros1")

    assert Bag.topics[0].type in TRANSFORM_TYPES
    pose = read_static_transforms(Bag(), "base_link").between("lidar", "base_link")
    assert pose is not None and pose == pytest.approx(POSE)
