"""Box convention, ranges, and operations on single boxes: corners, points inside, residuals.

Frame: LiDAR, metres. x forward, y left, z up; yaw counter-clockwise about +z from +x, in [-pi, pi).

    seen from above              x (forward)
                                 ^
                   front-left    |       front-right
                        0 +------^------+ 3          The arrow is the heading: `length` runs along it,
                          |      |      |            `width` across it. Drawn here with yaw = 0.
              y           |      |      |
          (left) <--------|------o      | length     A footprint lists its corners 0, 1, 2, 3:
                          |             |            counter-clockwise, the front-left one first.
                          |             |
                        1 +-------------+ 2          o = (x, y, z), the geometric center.
                    rear-left  width  rear-right

Box: (x, y, z, length, width, height, yaw), one row of an (N, 7) array.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Floating = NDArray[np.floating[Any]]
"""Any floating-point type."""
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


DIRECTION_OFFSET_RAD = math.pi / 4
"""Yaw at which direction bin 0 begins by default: it contains yaws in [pi/4, 5pi/4), bin 1 the others.

Most boxes have a yaw near an anchor's, and bins are ambiguous near their borders: no border is at an anchor's yaw.
"""

# No object is a hundred times as long as its anchor, but exp() of an untrained or overflowing network's output
# can be infinite, and an infinite box makes every overlap with it NaN.
_MAX_LOG_RATIO = math.log(100.0)

# Signs of the length and the width of the corners 0..3.
_LENGTH_SIGNS = np.array([0.5, -0.5, -0.5, 0.5])
_WIDTH_SIGNS = np.array([0.5, 0.5, -0.5, -0.5])


def wrap_angle(angle_rad: ArrayLike, period: float = 2 * math.pi) -> NDArray[Any]:
    """Return angles (...,) wrapped into [-period / 2, period / 2); those already inside are unchanged.

    float32 in, float32 out; any other type is returned as float64. The interval holds for the rounded result
    too: the float32 nearest to pi is greater than pi and never returned.
    """
    angle = np.asarray(angle_rad)
    dtype = np.dtype(np.float32) if angle.dtype == np.float32 else np.dtype(np.float64)
    angle = angle.astype(np.float64)
    half = period / 2
    # The sum of a half and an angle just below a half rounds to the period.
    turns = np.where((angle >= -half) & (angle < half), 0, np.floor((angle + half) / period))
    wrapped = angle - period * turns
    wrapped = np.where(wrapped >= half, -half, np.maximum(wrapped, -half)).astype(dtype)
    if dtype == np.float32:
        low, high = np.float32(-half), np.float32(half)
        if float(low) < -half:
            low = np.nextafter(low, np.float32(0))
        if float(high) >= half:
            high = np.nextafter(high, np.float32(0))
        wrapped = np.clip(wrapped, low, high)
    return wrapped


def footprints(boxes: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return the BEV corners of the boxes: (N, 7) -> (N, 4, 2) x, y in metres, LiDAR frame.

    Counter-clockwise, the front-left corner first (see the drawing above). Keeps the floating type of `boxes`.
    """
    along = boxes[:, 3, None] * _LENGTH_SIGNS.astype(boxes.dtype)
    across = boxes[:, 4, None] * _WIDTH_SIGNS.astype(boxes.dtype)
    cos, sin = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    x = boxes[:, 0, None] + cos * along - sin * across
    y = boxes[:, 1, None] + sin * along + cos * across
    return np.stack([x, y], axis=-1)


def corners(boxes: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return all corners: (N, 7) -> (N, 8, 3) metres, LiDAR frame; bottom four as in `footprints`, then top four."""
    flat = footprints(boxes)
    half_height = boxes[:, 5] / 2
    z = np.stack([boxes[:, 2] - half_height, boxes[:, 2] + half_height], axis=1)
    return np.concatenate([np.tile(flat, (1, 2, 1)), np.repeat(z, 4, axis=1)[:, :, None]], axis=2)


def points_in_boxes(
    points: NDArray[np.floating[Any]], boxes: NDArray[np.floating[Any]], margin_m: float = 0.0
) -> NDArray[np.bool_]:
    """Return the mask of the points in each box, faces included: (P, >=3), (N, 7) -> (P, N) bool.

    Args:
        points: columns x, y, z in metres, LiDAR frame; non-finite ones are in no box.
        margin_m: distance by which each face of the boxes is moved outwards.
    """
    inside = np.zeros((len(boxes), len(points)), bool)
    xyz = np.ascontiguousarray(points[:, :3].T)
    for row, (x, y, z, length, width, height, yaw) in zip(inside, boxes.astype(np.float64), strict=True):
        reach = math.hypot(length / 2 + margin_m, width / 2 + margin_m)
        # Select along x first, with some slack for float32: few points are near any one box.
        candidates = np.flatnonzero(np.abs(xyz[0] - x) <= reach + 1e-3)
        dx, dy, dz = (xyz[axis, candidates].astype(np.float64) - center for axis, center in enumerate((x, y, z)))
        along = math.cos(yaw) * dx + math.sin(yaw) * dy
        across = math.cos(yaw) * dy - math.sin(yaw) * dx
        row[candidates] = (
            (np.abs(along) <= length / 2 + margin_m)
            & (np.abs(across) <= width / 2 + margin_m)
            & (np.abs(dz) <= height / 2 + margin_m)
        )
    return inside.T


def encode_boxes(
    boxes: NDArray[np.floating[Any]],
    anchors: NDArray[np.floating[Any]],
    direction_offset_rad: float = DIRECTION_OFFSET_RAD,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Encode boxes as regression targets: boxes and anchors (..., 7) -> residuals (..., 7), direction (...,).

    dx and dy over the anchor's diagonal, dz over its height, logarithms of the size ratios, and the yaw
    difference in [-pi, pi); direction is the bin 0 or 1 of the box's yaw. The paper's eq. 12 as printed
    takes the logarithm of a difference; this is the encoding of PointPillars, which the paper says it
    adopts. The yaw is carried twice: as a residual, in which the loss does not see half a turn (it takes
    the sine of the error), and as one of two direction bins, the first of which begins at `direction_offset_rad`,
    which settles it.
    """
    box, anchor = boxes.astype(np.float64), anchors.astype(np.float64)
    diagonal = np.hypot(anchor[..., 3], anchor[..., 4])[..., None]
    residuals = np.concatenate(
        [
            (box[..., :2] - anchor[..., :2]) / diagonal,
            (box[..., 2:3] - anchor[..., 2:3]) / anchor[..., 5:6],
            np.log(box[..., 3:6] / anchor[..., 3:6]),
            wrap_angle(box[..., 6:] - anchor[..., 6:]),
        ],
        axis=-1,
    ).astype(np.float32)
    # From the rounded residual, as the decoder reads it: a yaw within rounding of a bin's border must not be decoded as
    # its opposite.
    return residuals, direction_bins(residuals[..., 6].astype(np.float64) + anchor[..., 6], direction_offset_rad)


def direction_bins(
    yaw_rad: NDArray[np.floating[Any]], direction_offset_rad: float = DIRECTION_OFFSET_RAD
) -> NDArray[np.int64]:
    """Return bin 0 or 1 of each yaw: (...,) -> (...,); the two directions of a heading are in different bins."""
    return (np.mod(yaw_rad - direction_offset_rad, 2 * math.pi) >= math.pi).astype(np.int64)


def decode_boxes(
    residuals: NDArray[np.floating[Any]],
    direction: NDArray[np.integer[Any]],
    anchors: NDArray[np.floating[Any]],
    direction_offset_rad: float = DIRECTION_OFFSET_RAD,
) -> NDArray[np.float32]:
    """Decode residuals, the inverse of `encode_boxes`: (..., 7), direction (...,), anchors (..., 7) -> boxes (..., 7).

    The direction bin alone decides between a yaw and its opposite. Size ratios are clipped to 1/100 and 100.
    """
    residual, anchor = residuals.astype(np.float64), anchors.astype(np.float64)
    diagonal = np.hypot(anchor[..., 3], anchor[..., 4])[..., None]
    center = anchor[..., :2] + residual[..., :2] * diagonal
    z = anchor[..., 2:3] + residual[..., 2:3] * anchor[..., 5:6]
    size = anchor[..., 3:6] * np.exp(np.clip(residual[..., 3:6], -_MAX_LOG_RATIO, _MAX_LOG_RATIO))
    into_bin = np.mod(residual[..., 6] + anchor[..., 6] - direction_offset_rad, math.pi)
    yaw = direction_offset_rad + math.pi * direction + into_bin
    boxes = np.concatenate([center, z, size, yaw[..., None]], axis=-1).astype(np.float32)
    boxes[..., 6] = wrap_angle(yaw.astype(np.float32))
    return boxes


def within(
    points: NDArray[np.floating], ranges: Iterable[tuple[float, float]] | NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Return the mask (N,) of the points or boxes (N, >= axes) within (lowest, highest) of each axis, in turn.

    The lowest is inside, the highest is not. Values that are not finite are outside.
    """
    inside = np.ones(len(points), bool)
    for axis, (low, high) in enumerate(ranges):
        inside &= (points[:, axis] >= low) & (points[:, axis] < high)
    return inside


class Ranges(NamedTuple):
    """(lowest, highest) along each axis in metres, LiDAR frame; the lowest is inside, the highest is not."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    z_m: tuple[float, float]

    def shifted(self, by_m: Sequence[float] | NDArray[np.float64]) -> "Ranges":
        """Return the ranges translated by (3,) metres."""
        x, y, z = ((low + by, high + by) for (low, high), by in zip(self, by_m, strict=True))
        return Ranges(x, y, z)

    def behind(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the mask (N,) of points (N, >=2), metres, LiDAR frame, in directions that the detector does not cover.

        A direction is covered if the range extends there as far as ahead or to its nearer side, whichever is less; its
        beginning does not matter. If the range does not extend ahead and to both sides, none is in the mask.
        """
        reach_m = min(self.x_m[1], -self.y_m[0], self.y_m[1])
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        return np.asarray((reach_m > 0) & (x * reach_m < min(self.x_m[0], 0.0) * np.hypot(x, y)))

    def hold_centers(self, boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the mask (N,) of the boxes (N, 7), metres, LiDAR frame, whose center is inside in bird's-eye view."""
        return within(boxes, self[:2])
