"""Conventions in which labels of other tools differ, and how well the points of scans fit each of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import points_in_boxes

_MORE = 1.1  # ratio of points
_SEEN_POINTS = 5  # in a box by any convention, for the box to count
_WINS_PER_LOSS = 4
_DEVIATIONS = 3.0
"""Least excess of boxes with more points over those with fewer, in standard deviations of a fair coin."""


class Convention(NamedTuple):
    """Change of boxes: yaw is multiplied and shifted, z shifted by a fraction of the height."""

    name: str
    remedy: str
    yaw_sign: float = 1.0
    yaw_rad: float = 0.0
    heights: float = 0.0


CONVENTIONS = (
    Convention("as labelled", ""),
    Convention(
        "turned by 90 degrees",
        "yaw is 0 where the length points along x, forward; add a quarter turn to yaw, or swap length and width",
        yaw_rad=np.pi / 2,
    ),
    Convention("mirrored", "yaw is counter-clockwise seen from above; change its sign", yaw_sign=-1.0),
    Convention(
        "mirrored and turned by 90 degrees",
        "yaw is counter-clockwise from x, forward; take -yaw - pi / 2, as of KITTI's rotation_y",
        yaw_sign=-1.0,
        yaw_rad=np.pi / 2,
    ),
    Convention(
        "raised by half a height",
        "z is that of the box's center (in KITTI's text y is that of its bottom); add half the height to z",
        heights=0.5,
    ),
    Convention(
        "lowered by half a height",
        "z is that of the box's center (in KITTI's text y is that of its bottom); take half the height from z",
        heights=-0.5,
    ),
)
"""Conventions, the first of which is the reference. Swapped length and width look like a turn by 90 degrees."""


class ConventionFit(NamedTuple):
    """Fit of a convention to M boxes.

    `points` in all boxes together; boxes with 10 % `more` points than as labelled, and those with 10 % `fewer`.
    """

    name: str
    points: int
    more: int
    fewer: int


def count_points(points: NDArray[np.float32], boxes: NDArray[np.float32]) -> NDArray[np.int64]:
    """Count the points (N, >=3), metres, in each box (M, 7) by each of the `CONVENTIONS`: (C, M)."""
    counts = np.zeros((len(CONVENTIONS), len(boxes)), np.int64)
    for column, box in enumerate(boxes):
        reach = np.hypot(box[3], box[4]) / 2 + 0.01
        candidates = points[(np.abs(points[:, 0] - box[0]) < reach) & (np.abs(points[:, 1] - box[1]) < reach)]
        counts[:, column] = points_in_boxes(candidates, _by_conventions(box)).sum(axis=0)
    return counts


def convention_fits(counts: NDArray[np.int64]) -> tuple[ConventionFit, ...]:
    """Return the fit of each convention to boxes with these numbers of points, (C, M) of `count_points`."""
    seen = counts[:, counts.max(axis=0, initial=0) >= _SEEN_POINTS]
    more, fewer = seen > _MORE * seen[0], seen[0] > _MORE * seen
    rows = zip(CONVENTIONS, counts.sum(axis=1), more.sum(axis=1), fewer.sum(axis=1), strict=True)
    return tuple(ConventionFit(kind.name, int(points), int(a), int(b)) for kind, points, a, b in rows)


def better_convention(fits: Sequence[ConventionFit]) -> tuple[Convention, ConventionFit] | None:
    """Return the best convention that fits significantly better than that of the labels; None if none does."""
    better = [
        (convention, fit)
        for convention, fit in zip(CONVENTIONS, fits, strict=True)
        if fit.more >= _WINS_PER_LOSS * fit.fewer and fit.more - fit.fewer > _DEVIATIONS * np.sqrt(fit.more + fit.fewer)
    ]
    return max(better, key=lambda item: item[1].more - item[1].fewer) if better else None


def _by_conventions(box: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the box (7,) in each convention: (C, 7)."""
    boxes = np.repeat(box[None], len(CONVENTIONS), axis=0)
    for row, convention in zip(boxes, CONVENTIONS, strict=True):
        row[6] = convention.yaw_sign * box[6] + convention.yaw_rad
        row[2] += convention.heights * box[5]
    return boxes
