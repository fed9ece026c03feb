"""Frames are found over common parents, in both directions."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asca_pillars.scans.transforms import Transforms


def message(*transforms: tuple[str, str, list[float], list[float]]) -> Any:
    """(parent, child, shift, roll pitch yaw in degrees)."""
    entries = []
    for parent, child, shift, angles in transforms:
        x, y, z, w = Rotation.from_euler("xyz", angles, degrees=True).as_quat().tolist()
        transform = SimpleNamespace(
            translation=SimpleNamespace(x=shift[0], y=shift[1], z=shift[2]),
            rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
        )
        header = SimpleNamespace(frame_id=parent)
        entries.append(SimpleNamespace(header=header, child_frame_id=child, transform=transform))
    return SimpleNamespace(transforms=entries)


def test_a_sensor_in_the_vehicles_frame() -> None:
    transforms = Transforms()
    transforms.add(
        message(("base_link", "roof", [0, 0, 1.5], [0, 0, 90]), ("/roof", "/lidar", [1, 0, 0.2], [0, 10, 0]))
    )
    transforms.add(message(("base_link", "camera", [2, 0, 1], [0, 0, 0])))
    pose = transforms.between("lidar", "base_link")
    assert pose is not None
    assert pose[:3, 3] == pytest.approx([0, 1, 1.7])
    assert pose[:3, :3] == pytest.approx(
        (Rotation.from_euler("z", 90, degrees=True) * Rotation.from_euler("y", 10, degrees=True)).as_matrix()
    )
    back = transforms.between("base_link", "lidar")
    assert back is not None and back @ pose == pytest.approx(np.eye(4))
    beside = transforms.between("lidar", "camera")
    assert beside is not None and beside[:3, 3] == pytest.approx([-2, 1, 0.7])
    assert transforms.frames == ["base_link", "camera", "lidar", "roof"]


def test_frames_that_nothing_connects_and_frames_in_a_circle() -> None:
    transforms = Transforms()
    assert transforms.between("lidar", "base_link") is None
    transforms.add(message(("a", "b", [1, 0, 0], [0, 0, 0]), ("b", "a", [1, 0, 0], [0, 0, 0])))
    assert transforms.between("a", "base_link") is None
    same = transforms.between("lidar", "lidar")
    assert same is not None and same == pytest.approx(np.eye(4))


def test_a_transform_that_is_no_rotation_is_left_out() -> None:
    broken = message(("base_link", "lidar", [1, 0, 0], [0, 0, 0]))
    broken.transforms[0].transform.rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    transforms = Transforms()
    transforms.add(broken)
    assert transforms.between("lidar", "base_link") is None


def test_the_latest_transform_counts() -> None:
    transforms = Transforms()
    for shift in ([1.0, 0, 0], [5.0, 0, 0]):
        transforms.add(message(("base_link", "lidar", shift, [0, 0, 0])))
    pose = transforms.between("lidar", "base_link")
    assert pose is not None and pose[0, 3] == 5
