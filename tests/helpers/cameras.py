"""Made-up calibrations, and what every complaint about a dataset's file must look like."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.kitti import Calibration


def make_calibration(
    roll_deg: float = 0.0,
    pitch_deg: float = 0.0,
    yaw_deg: float = 0.0,
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Calibration:
    """A pinhole camera that looks along the LiDAR's x axis, its frame then turned about its own axes."""
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # camera x = -y, y = -z, z = x of the LiDAR
    (cx, sx), (cy, sy), (cz, sz) = (
        (math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (pitch_deg, yaw_deg, roll_deg)
    )
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    p2 = np.array([[700.0, 0, 620, 0], [0, 700, 180, 0], [0, 0, 1, 0]])
    return Calibration(p2, about_z @ about_x, np.column_stack([about_y @ axes, offset_m]))


def assert_one_line(place: str | Path, words: list[str], action: Callable[[], object]) -> None:
    """`action` raises a DatasetError of one line that names `place` and `words`."""
    with pytest.raises(DatasetError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(place), *words):
        assert word in message
