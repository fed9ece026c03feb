"""Pose and axes of a sensor, by which scans are transformed to the model's frame."""

import math
import re
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.files import read_text
from asca_pillars.base.strict import Strict
from asca_pillars.geometry.frame_change import FrameChange, is_rigid

Row: TypeAlias = tuple[float, float, float, float]

MIN_UPRIGHT = math.cos(math.radians(45))
"""Boxes rotate about z alone; a scan whose z axis is tilted further cannot have such boxes."""

MAX_HEIGHT_M = 10.0
_NAMED_AXES = {"x-forward": "x,y,z", "y-forward": "y,-x,z"}
_EXAMPLES = (
    "x-forward, y-forward or three signed axes, such as -y,x,z: where forward, left and up are found in the scan"
)


@dataclass(frozen=True)
class Mounting(Strict):
    """Pose of a scan's frame in the model's: x forward, y left, z up, level, at a height above the ground.

    Attributes:
        sensor_height_m: height above the ground of the frame's origin, after `axes` or `pose`: the sensor's for scans
            in its own frame, 0 where z = 0 is the ground. None: the height of the training scans.
        axes: axes of the scan that are forward, left and up. `x-forward` is x,y,z; `y-forward` is y,-x,z (x to the
            right, as on nuScenes' cars); z down is x,-y,-z. Mirrored frames such as x,-y,z are mirrored back.
        pose: 4x4 matrix from the scan to a level frame, x forward, y left, z up, metres; then `axes` keeps its default.

    Raises:
        ConfigError: invalid height or axes, a pose that is not a rotation and a translation, or an up axis that is not
            the scan's z or -z.
    """

    sensor_height_m: float | None = None
    axes: str = "x-forward"
    pose: tuple[Row, Row, Row, Row] | None = None

    def __post_init__(self) -> None:
        height = self.sensor_height_m
        if not isinstance(height, Real | None):
            raise ConfigError(f"sensor height {height!r:.40}: give metres; `measured_mounting(scans)` estimates them")
        if height is not None and not abs(float(height)) <= MAX_HEIGHT_M:  # also refuses NaN
            raise ConfigError(f"sensor height {height:g}: give metres above the ground, at most {MAX_HEIGHT_M:g}")
        if self.pose is not None:
            object.__setattr__(self, "pose", _rows(self.pose))
        if abs(self.level.axes[2, 2]) < MIN_UPRIGHT:
            what = f"axes {self.axes}" if self.pose is None else "pose"
            raise ConfigError(
                f"{what}: boxes turn about the scan's z axis, which must point up or down; turn the points first"
            )

    @cached_property
    def level(self) -> FrameChange:
        """Transform from the scan to x forward, y left, z up about the same origin, or that of the pose."""
        if self.pose is None:
            return FrameChange(_signed_axes(self.axes), np.zeros(3))
        refuse_axes_with_pose(self.axes)
        pose = np.array(self.pose)
        if not is_rigid(pose):
            raise ConfigError("pose: must be a rotation and a shift, the last row 0 0 0 1")
        return FrameChange(pose[:3, :3], pose[:3, 3])

    def to_model(self, trained_height_m: float | None) -> FrameChange:
        """Return the transform from the scan to the model's frame.

        Args:
            trained_height_m: height of the sensor in the scans that the model was trained on; None: unknown.
        """
        if self.sensor_height_m is None or trained_height_m is None:
            return self.level
        lift = np.array([0, 0, self.sensor_height_m - trained_height_m])
        return FrameChange(self.level.axes, self.level.shift_m + lift)


def refuse_axes_with_pose(axes: str) -> None:
    """Raise ConfigError if both axes and a pose are stated."""
    if axes != "x-forward":
        raise ConfigError(f"axes {axes} and a pose: the pose turns the axes already; give one of them")


def read_pose(path: str | Path) -> tuple[Row, Row, Row, Row]:
    """Read a 4x4 matrix from a text file of 16 numbers, row by row.

    Raises:
        ConfigError: the file cannot be read or has other content.
    """
    try:
        text = read_text(path, ConfigError)
        numbers = [float(word) for word in re.split(r"[\s,;\[\]]+", text) if word]
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as a pose ({error}); write 16 numbers, row by row") from None
    if len(numbers) != 16:
        raise ConfigError(f"{path}: holds {len(numbers)} numbers; a pose has 16, row by row")
    pose = np.reshape(numbers, (4, 4))
    if not is_rigid(pose):
        raise ConfigError(f"{path}: must be a rotation and a shift, without a scale, the last row 0 0 0 1; correct it")
    return _rows(pose)


def _rows(pose: object) -> tuple[Row, Row, Row, Row]:
    """Convert a pose to plain numbers, which compare and hash; ConfigError if it is not a 4x4 matrix."""
    try:
        matrix = np.asarray(pose, np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"pose {pose!r:.40}: give a 4x4 matrix; `read_pose(path)` reads one of a file") from None
    if matrix.shape != (4, 4):
        raise ConfigError(f"pose of shape {matrix.shape}: give a 4x4 matrix from the scan to the level frame")
    first, second, third, last = ((a, b, c, d) for a, b, c, d in matrix.tolist())
    return first, second, third, last


def _signed_axes(text: str) -> NDArray[np.float64]:
    """Return (3, 3) rows forward, left, up in the scan's frame."""
    if not isinstance(text, str):
        raise ConfigError(f"axes {text!r:.40}: give {_EXAMPLES}")
    names = [name.strip().lstrip("+") for name in _NAMED_AXES.get(text, text).split(",")]
    if sorted(name.lstrip("-") for name in names) != ["x", "y", "z"] or any(len(name) > 2 for name in names):
        raise ConfigError(f"axes {text[:40]}: give {_EXAMPLES}")
    axes = np.zeros((3, 3))
    for row, name in enumerate(names):
        axes[row, "xyz".index(name[-1])] = -1.0 if name[0] == "-" else 1.0
    return axes
