"""The plane that most of some points lie on, by RANSAC: a wall, cars and leaves among them do not move it."""

import math

import numpy as np
from numpy.typing import NDArray

_DRAWS = 200
_REFITS = 3
_MIN_AREA_M2 = 10.0


def most_common_plane(
    points: NDArray[np.float64], band_m: float, max_slope: float = math.inf
) -> NDArray[np.float64] | None:
    """The plane (3,) a, b, c of z = a x + b y + c that most of points (N, 3) lie within `band_m` of; metres.

    The draws are seeded: the same points give the same plane.

    Args:
        points: any frame.
        band_m: half the thickness of what counts as the plane.
        max_slope: a drawn plane that is steeper along x or y is none.

    Returns:
        None where no draw is a plane that may be.
    """
    if not len(points):
        return None
    triples = points[np.random.default_rng(0).integers(0, len(points), (_DRAWS, 3))]
    design = np.concatenate([triples[:, :, :2], np.ones((_DRAWS, 3, 1))], axis=2)
    regular = np.abs(np.linalg.det(design)) > _MIN_AREA_M2  # of twice the triangle's area
    planes = np.linalg.solve(design[regular], triples[regular, :, 2, None])[..., 0]
    planes = planes[(np.abs(planes[:, :2]) < max_slope).all(axis=1)]
    if not len(planes):
        return None
    z, full = points[:, 2], np.column_stack([points[:, :2], np.ones(len(points))])
    plane = planes[(np.abs(z - planes @ full.T) < band_m).sum(axis=1).argmax()]
    for _ in range(_REFITS):
        near = np.abs(z - full @ plane) < band_m
        if near.sum() < 3:
            return None
        plane = np.linalg.lstsq(full[near], z[near], rcond=None)[0]
    return plane
