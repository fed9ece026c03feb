"""Real objects beside simulated ones at like distance, angle of view and occlusion.

A real object's look-alikes are the NEIGHBORS simulated objects of its class that are nearest in these three, where
DISTANCE_SPAN of distance, VIEW_SPAN_DEG of angle and OCCLUSION_SPAN states of occlusion count alike. For scores, they
are near in the number of returns, too (POINTS_SPAN): more returns are a gap of their own. Of every measure three things
are told: the means of both sides, their ratio, and the real object's percentile among its look-alikes, averaged over
the objects: 0.5 where there is no gap, whatever the measure.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.sim.report.object_records import ObjectRecord
from asca_pillars.sim.report.reference import CLASSES

NEIGHBORS = 30
DISTANCE_SPAN, VIEW_SPAN_DEG, OCCLUSION_SPAN = 0.15, 15.0, 0.5  # the first is of the logarithm
POINTS_SPAN = 0.25  # of the logarithm
ALL = "All"
MEASURES = {
    "points": "points",
    "pillars": "pillars of 0.16 m",
    "lowest": "points in the lowest 12 %",
    "wheels": "points at 12-30 % of height",
    "middle": "points at 50-70 % of height",
    "length_m": "length covered (m)",
    "bright": "bright returns (>= 0.5)",
    "score": "score",
}
_COUNTS = ("points", "pillars")
_DRAWS = 2000


@dataclass(frozen=True)
class LikeRow:
    """One measure of one class.

    Attributes:
        class_name: or ALL.
        measure: a key of MEASURES.
        objects: real ones that were compared.
        real, simulated: means over the objects, and over the means of their look-alikes; of counts, geometric means,
            because near objects have a thousand times the returns of far ones.
        ratio: real / simulated, and the interval that holds it with 95 %.
        percentile: mean percentile of the real objects among their look-alikes, and its standard error.
    """

    class_name: str
    measure: str
    objects: int
    real: float
    simulated: float
    ratio: float
    ratio_interval: tuple[float, float]
    percentile: float
    percentile_error: float


def compare_objects(real: Sequence[ObjectRecord], simulated: Sequence[ObjectRecord]) -> list[LikeRow]:
    """Rows of each class that both sides have (of scores one of all classes, too)."""
    rows, scores = [], []
    for name in CLASSES:
        ours = [record for record in real if record.class_name == name]
        theirs = [record for record in simulated if record.class_name == name]
        if not ours or len(theirs) < NEIGHBORS:
            continue
        alike, of_like_points = look_alikes(ours, theirs), look_alikes(ours, theirs, like_points=True)
        for measure in MEASURES:
            value = np.array([getattr(record, measure) for record in ours])
            among = np.array([getattr(record, measure) for record in theirs])
            among = among[of_like_points if measure == "score" else alike]
            if np.isfinite(value).all() and np.isfinite(among).all():
                rows.append(_row(name, measure, value, among))
                if measure == "score":
                    scores.append((value, among))
    if len(scores) > 1:
        rows.append(_row(ALL, "score", *(np.concatenate(side) for side in zip(*scores, strict=True))))
    return rows


def look_alikes(
    real: Sequence[ObjectRecord], simulated: Sequence[ObjectRecord], *, like_points: bool = False
) -> NDArray[np.int64]:
    """Indices (R, NEIGHBORS) of each real object's look-alikes among simulated ones of its class."""
    from_real, from_simulated = _place(real, like_points), _place(simulated, like_points)
    away = np.linalg.norm(from_real[:, None] - from_simulated[None], axis=2)
    return np.argsort(away, axis=1, kind="stable")[:, :NEIGHBORS]


def percentiles(value: NDArray[np.float64], among: NDArray[np.float64]) -> NDArray[np.float64]:
    """Percentile 0..1 of each value (R,) among (R, K); ties count half."""
    below, same = (among < value[:, None]).mean(axis=1), (among == value[:, None]).mean(axis=1)
    return np.asarray(below + 0.5 * same)


def _place(records: Sequence[ObjectRecord], like_points: bool) -> NDArray[np.float64]:
    """Where objects lie among others (N, 3 or 4), in the spans that count alike."""
    columns = [
        [np.log(record.distance_m) / DISTANCE_SPAN for record in records],
        [record.view_deg / VIEW_SPAN_DEG for record in records],
        [record.occluded / OCCLUSION_SPAN for record in records],
    ]
    if like_points:
        columns.append([np.log(record.points) / POINTS_SPAN for record in records])
    return np.array(columns).T


def _row(name: str, measure: str, value: NDArray[np.float64], among: NDArray[np.float64]) -> LikeRow:
    counts = measure in _COUNTS
    ours, theirs = (np.log(value), np.log(among).mean(axis=1)) if counts else (value, among.mean(axis=1))
    draws = np.random.default_rng(0).integers(len(value), size=(_DRAWS, len(value)))
    with np.errstate(divide="ignore", invalid="ignore"):
        drawn = _ratio(ours[draws].mean(axis=1), theirs[draws].mean(axis=1), counts)
        ratio = float(_ratio(ours.mean(), theirs.mean(), counts))
    low, high = np.nanpercentile(drawn, (2.5, 97.5)) if np.isfinite(drawn).any() else (np.nan, np.nan)
    rank = percentiles(value, among)
    error = max(float(rank.std()), 1 / np.sqrt(12)) / np.sqrt(len(rank))  # few objects may agree by chance
    real, simulated = (float(np.exp(side.mean()) if counts else side.mean()) for side in (ours, theirs))
    interval = float(low), float(high)
    return LikeRow(name, measure, len(value), real, simulated, ratio, interval, float(rank.mean()), error)


def _ratio(
    ours: NDArray[np.float64] | np.float64, theirs: NDArray[np.float64] | np.float64, logarithms: bool
) -> NDArray[np.float64]:
    return np.asarray(np.exp(ours - theirs) if logarithms else ours / theirs)
