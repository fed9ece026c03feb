"""Random corruption of a frame's points: what surfaces, occlusion and another sensor do to returns, drawn at random.

Real objects differ from those of a database or a simulator in how bright they are, which of their points come back,
and how exact these are. Each change is off unless the configuration asks for it, and then draws nothing either.
"""

import numpy as np
from numpy.typing import NDArray

from asca_pillars.config.tree import AugmentConfig
from asca_pillars.geometry.boxes import points_in_boxes

FEWEST_POINTS = 5  # an object keeps so many, or it is not cut, for it could not be found
WIDEST_CUT = 0.5  # of an object's extent in azimuth or elevation


def corrupt_objects(
    points: NDArray[np.float32],
    boxes: NDArray[np.float32],
    config: AugmentConfig,
    rng: np.random.Generator,
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float32]:
    """Brighten, shake and cut the points inside each box.

    Args:
        points: (N, 4) x, y, z in metres (LiDAR frame), reflectance 0..1; they stay as they are.
        boxes: (M, 7) labelled boxes, LiDAR frame.
        config: which changes, and how strong.
        rng: draws them.
        sensor_m: where the sensor is in the points' frame: it is from there that a cut is seen.

    Returns:
        (K, 4), K <= N, without the points that were cut out.
    """
    low, high = config.object_reflectance_gain
    brighten, shake = (low, high) != (1, 1), config.object_jitter_m > 0
    if not (brighten or shake or config.object_cut_probability):
        return points
    points = points.copy()
    kept = np.ones(len(points), dtype=bool)
    for inside in points_in_boxes(points, boxes).T:
        own = np.flatnonzero(inside)
        if brighten:
            gain = np.exp(rng.uniform(np.log(low), np.log(high)))  # twice as bright is as likely as half
            points[own, 3] = np.minimum(points[own, 3] * gain, 1)
        if shake:
            points[own, :3] += rng.normal(0, config.object_jitter_m, (len(own), 3))
        if config.object_cut_probability and rng.random() < config.object_cut_probability:
            rows = own[kept[own]]
            cut = _cut(points[rows, :3] - np.array(sensor_m, np.float32), rng)
            if len(rows) - np.count_nonzero(cut) >= FEWEST_POINTS:
                kept[rows[cut]] = False
    return points[kept]


def lose_reflectance(points: NDArray[np.float32], config: AugmentConfig, rng: np.random.Generator) -> None:
    """Some sensors give no reflectance for part of the points (N, 4), or for all: set it, in place, in some samples.

    Half of these samples get 0 for a random share of the points, the other half one value for all.
    """
    if not config.reflectance_loss_probability or rng.random() >= config.reflectance_loss_probability:
        return
    if rng.random() < 0.5:
        points[rng.random(len(points)) < rng.random(), 3] = 0
    else:
        points[:, 3] = rng.random()


def _cut(xyz: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of an object's points (N, 3), seen from the origin, lie in a random sector or in a random group of rings.

    Something thin in front takes away a sector of azimuth, a hedge or a beam that fails a range of elevation.
    """
    if not len(xyz):
        return np.zeros(0, dtype=bool)
    if rng.random() < 0.5:
        center = xyz.mean(axis=0)  # angles against the object's own direction do not wrap
        along = xyz[:, 0] * center[0] + xyz[:, 1] * center[1]
        across = xyz[:, 1] * center[0] - xyz[:, 0] * center[1]
        angle = np.arctan2(across, along)
    else:
        angle = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    extent = np.ptp(angle)
    width = rng.uniform(0, WIDEST_CUT) * extent
    start = angle.min() + rng.uniform(0, 1) * (extent - width)
    return (angle >= start) & (angle <= start + width)
