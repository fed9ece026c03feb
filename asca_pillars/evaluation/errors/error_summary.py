"""Errors of a dataset as numbers: per class and group of objects, kinds of false positives, label fit."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.strict import Strict
from asca_pillars.data.insertion.ground_fit import fit_ground
from asca_pillars.evaluation.errors.box_errors import (
    CORRECTIONS,
    FALSE_KINDS,
    RESIDUALS,
    TRAITS,
    DetectionMatch,
    ObjectMatch,
    Surroundings,
    box_residuals,
    boxes_from_residuals,
    corrected,
    describe,
    match_frame,
)
from asca_pillars.evaluation.errors.error_frames import UNKNOWN_OCCLUSION, ErrorFrame, ErrorFrames
from asca_pillars.evaluation.errors.label_fit import END_ON_DEG, STATISTICS, label_fit
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, min_overlap
from asca_pillars.geometry.overlap import paired_iou_3d

BLOCK_FRAMES = 10
MIN_BLOCKS = 5
"""Least number of blocks for an interval: values of fewer may be of one object."""
DRAWS = 300
SHARE = 0.95
_SEED = 0

_Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BootstrapSamples:
    """Bootstrap samples, as counts of each frame.

    Attributes:
        weights: (DRAWS, F) integers.
        blocks: (F,) block number of each frame.
    """

    weights: _Doubles
    blocks: NDArray[np.int64]

    def median_interval(self, values: _Doubles, frames: NDArray[np.int64]) -> tuple[float, float] | None:
        """Return the interval of the median of values (N,), in their unit; None with too few blocks.

        Args:
            values: numbers.
            frames: index of the frame of each value.
        """
        if len(np.unique(self.blocks[frames])) < MIN_BLOCKS:
            return None
        order = np.argsort(values, kind="stable")
        cumulative = np.cumsum(self.weights[:, frames[order]], axis=1)
        total = cumulative[:, -1]
        drawn = total > 0
        middle = (cumulative[drawn] >= total[drawn, None] / 2).argmax(axis=1)
        return _interval(values[order][middle])

    def ratio_interval(self, parts: _Doubles, wholes: _Doubles) -> tuple[float, float] | None:
        """Return the interval of the ratio sum(parts) / sum(wholes), counts (F,) by frame; None with too few blocks."""
        if len(np.unique(self.blocks[wholes > 0])) < MIN_BLOCKS:
            return None
        whole = self.weights @ wholes
        drawn = whole > 0
        return _interval((self.weights @ parts)[drawn] / whole[drawn])


def bootstrap_samples(parts: Sequence[NDArray[np.int64]], frames: int) -> BootstrapSamples:
    """Draw blocks of neighboring frames; the same draws for the same frames.

    Args:
        parts: indices of the frames of each part, in order; frames that are in none of them are never drawn.
        frames: number of frames.
    """
    generator = np.random.default_rng(_SEED)
    groups = [np.array_split(part, max(round(len(part) / BLOCK_FRAMES), 1)) for part in parts if len(part)]
    weights, number_of = np.zeros((DRAWS, frames)), np.full(frames, -1)
    for number, block in enumerate(block for group in groups for block in group):
        number_of[block] = number
    for row in weights:
        for part in generator.integers(len(groups), size=len(groups)):
            for block in generator.integers(len(groups[part]), size=len(groups[part])):
                row[groups[part][block]] += 1
    return BootstrapSamples(weights, number_of)


def _interval(drawn: _Doubles) -> tuple[float, float]:
    low, high = np.quantile(drawn, [(1 - SHARE) / 2, (1 + SHARE) / 2])
    return float(low), float(high)


FALSE_RATES = (0.05, 0.1, 0.2, 0.3, 0.5)
"""Numbers of false detections per frame for which a score threshold is reported."""
CLEAR_RANGE_M = 35.0
CLEAR_TRUNCATION = 0.1
SIDE_ON_DEG = 90.0 - END_ON_DEG
DISTANCES_M = (0.0, 15.0, 25.0, 40.0, inf)
POINTS = (1, 20, 100, inf)
NEIGHBORS_M = (0.0, 1.0, 2.0, inf)
OCCLUSIONS = ("fully visible", "partly occluded")
LARGELY_OCCLUDED = "largely occluded"
"""Objects that are not counted: their detections are neither true nor false positives."""
OTHER_IOU_3D = 0.5
ALL, CLEAR = "all", "clear"
VIEWS = ("clear, end-on", "clear, oblique", "clear, side-on")
MAIN_GROUPS = (ALL, CLEAR, *VIEWS)
WITHOUT_MEDIANS = "without median errors"

Interval = tuple[float, float] | None
_Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Spread(Strict):
    """Distribution of a quantity: number of values, median (of a share: the mean), 10th and 90th percentile.

    `interval` is the median's (mean's) 95 % interval over `bootstrap_samples`.
    """

    count: int
    middle: float | None
    low: float | None
    high: float | None
    interval: Interval


@dataclass(frozen=True)
class GroupErrors(Strict):
    """Objects of one class and group.

    Attributes:
        group: one of MAIN_GROUPS, or a group by distance, occlusion, points, or the nearest object of the class.
        objects: number of objects.
        found: number of found objects.
        below_score: number of the others with a sufficient box below the score threshold.
        recall_interval: interval of found / objects.
        residuals: residuals of their boxes, found or inaccurate (`box_errors`), by the names of RESIDUALS.
    """

    group: str
    objects: int
    found: int
    below_score: int
    recall_interval: Interval
    residuals: dict[str, Spread]


@dataclass(frozen=True)
class FalseDetections(Strict):
    """False positives of one class.

    Attributes:
        kinds: number of each of FALSE_KINDS.
        labels: types of the objects overlapped by those other than `background`, and their numbers.
        per_frame: number per frame.
        per_frame_interval: its interval.
        traits: share of those of `background` with each of TRAITS, and "none".
        surroundings: distance_m, points, top_m, reflectance and cluster_length_m of those of `background`.
    """

    kinds: dict[str, int]
    labels: dict[str, int]
    per_frame: float
    per_frame_interval: Interval
    traits: dict[str, float]
    surroundings: dict[str, Spread]


@dataclass(frozen=True)
class FalseRate(Strict):
    """The lowest score threshold that keeps a number of false detections per frame.

    Attributes:
        per_frame: largest number of false detections per frame.
        score: threshold.
        recall: share of the counted objects that are found at this threshold.
    """

    per_frame: float
    score: float
    recall: float


@dataclass(frozen=True)
class ClassErrors(Strict):
    """All results of one class.

    Attributes:
        score: score threshold.
        best_score: the score with the best F1 at the BEV IoU of a found object; None without a found object.
        false_rates: one for each of FALSE_RATES that some score keeps.
        iou_3d: 3D IoU for `reaching`: KITTI's of the class, OTHER_IOU_3D for any other.
        boxes: boxes on counted objects, found or inaccurate.
        reaching: share of them that reach it as predicted, and with each of CORRECTIONS or WITHOUT_MEDIANS.
        label_fit: fit of unoccluded, untruncated objects, by the names of STATISTICS.
    """

    class_name: str
    score: float
    best_score: float | None
    false_rates: tuple[FalseRate, ...]
    iou_3d: float
    boxes: int
    reaching: dict[str, float]
    groups: tuple[GroupErrors, ...]
    false: FalseDetections
    label_fit: dict[str, Spread]


@dataclass(frozen=True)
class DatasetErrors(Strict):
    """Results of a dataset, or a part of it."""

    name: str
    frames: int
    classes: tuple[ClassErrors, ...]


@dataclass(frozen=True, eq=False)
class Matches:
    """All objects and detections of an evaluation.

    Attributes:
        frame_ids: names of the frames; matches carry their index.
        scores: score threshold of each evaluated class.
        objects, fits: the objects, and a row of `label_fit` for each; NaN if an object is occluded or truncated.
        detections, surroundings: the detections, and the surroundings of reported false positives.
    """

    frame_ids: tuple[str, ...]
    scores: Mapping[str, float]
    objects: list[ObjectMatch] = field(default_factory=list)
    fits: list[NDArray[np.float64]] = field(default_factory=list)
    detections: list[DetectionMatch] = field(default_factory=list)
    surroundings: list[Surroundings | None] = field(default_factory=list)


def match_frames(frames: ErrorFrames, scores: Mapping[str, float], *, reporter: Reporter = SILENT) -> Matches:
    """Match every frame.

    Args:
        frames: the frames, read one by one.
        scores: score threshold of each class to evaluate.
        reporter: for the progress.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    matches = Matches(tuple(frames.frame_ids), scores)
    bar = reporter.track(matches.frame_ids, "Errors")
    for index, frame_id in enumerate(bar):
        frame = frames.read(frame_id)
        for name, score in scores.items():
            objects, detections = match_frame(frame, index, name, score)
            matches.objects.extend(objects)
            matches.fits.extend(_fit_of(frame, objects))
            matches.detections.extend(detections)
        news = matches.detections[len(matches.surroundings) :]
        false = [item for item in news if item.is_false]
        ground = fit_ground(frame.points) if false else None
        described = iter(describe(frame.points, ground, [item.box for item in false]))
        matches.surroundings.extend(next(described) if item.is_false else None for item in news)
    return matches


def summarize(
    matches: Matches, name: str, parts: Mapping[str, Sequence[str]], *, reporter: Reporter = SILENT
) -> list[DatasetErrors]:
    """Summarize all frames, named `name`, then each part of them.

    Args:
        matches: of all frames.
        name: name of the whole.
        parts: frame ids of each part, by its name; they need not cover all frames.
        reporter: for the progress.
    """
    index = {frame_id: number for number, frame_id in enumerate(matches.frame_ids)}
    indices = {part: np.array(sorted(index[frame] for frame in ids if frame in index)) for part, ids in parts.items()}
    indices = {part: numbers for part, numbers in indices.items() if len(numbers)}
    everything = np.arange(len(matches.frame_ids))
    left = np.setdiff1d(everything, np.concatenate([*indices.values(), np.zeros(0, np.int64)]))
    drawn = {name: [*indices.values(), left]} | {part: [numbers] for part, numbers in indices.items()}
    sets = []
    for title, groups in reporter.track(drawn.items(), "Intervals"):
        chosen = np.unique(np.concatenate(groups).astype(np.int64))
        view = _Part(matches, np.isin(everything, chosen), bootstrap_samples(groups, len(everything)))
        sets.append(DatasetErrors(title, len(chosen), tuple(view.class_errors(name) for name in matches.scores)))
    return sets


def view_of(view_deg: float) -> str:
    """Return one of VIEWS for the angle between heading and line of sight."""
    return VIEWS[0 if view_deg < END_ON_DEG else 1 if view_deg <= SIDE_ON_DEG else 2]


def is_clear(item: ObjectMatch) -> bool:
    """Return whether an object is near and labelled neither occluded nor truncated."""
    near = np.hypot(item.box[0], item.box[1]) <= CLEAR_RANGE_M
    return bool(near) and _is_whole(item.occluded, item.truncated)


@dataclass(frozen=True, eq=False)
class _Part:
    """Matches of the frames in a mask (F,)."""

    matches: Matches
    frames: _Mask
    draws: BootstrapSamples

    def class_errors(self, name: str) -> ClassErrors:
        rows = [
            row for row, item in enumerate(self.matches.objects) if item.class_name == name and self.frames[item.frame]
        ]
        objects = [self.matches.objects[row] for row in rows]
        fits = np.array([self.matches.fits[row] for row in rows]).reshape(-1, len(STATISTICS))
        of_frame = np.array([item.frame for item in objects], np.int64)
        boxes = np.array([item.detection is not None for item in objects], bool)
        labels = np.array([item.box for item in objects if item.detection is not None]).reshape(-1, 7)
        matched = np.array([item.detection for item in objects if item.detection is not None]).reshape(-1, 7)
        residuals = np.full((len(objects), len(RESIDUALS)), np.nan)
        residuals[boxes] = box_residuals(matched, labels)
        counted = np.array([item.counted for item in objects], bool)
        iou = min_overlap(name) if name in CLASS_NAMES else OTHER_IOU_3D
        detections = [
            (item, around)
            for item, around in zip(self.matches.detections, self.matches.surroundings, strict=True)
            if item.class_name == name and self.frames[item.frame]
        ]
        return ClassErrors(
            class_name=name,
            score=self.matches.scores[name],
            best_score=_best_score([item for item, _ in detections], int(counted.sum())),
            false_rates=_false_rates([item for item, _ in detections], int(counted.sum()), int(self.frames.sum())),
            iou_3d=iou,
            boxes=int((counted & boxes).sum()),
            reaching=_shares_reaching(labels[counted[boxes]], residuals[counted & boxes], iou),
            groups=tuple(
                self._group(group, [objects[row] for row in np.flatnonzero(mask)], residuals[mask])
                for group, mask in _groups(objects).items()
                if mask.any()
            ),
            false=self._false(detections),
            label_fit=self._spreads(STATISTICS, fits, of_frame, shares=("low_inside",)),
        )

    def _group(self, group: str, objects: list[ObjectMatch], residuals: NDArray[np.float64]) -> GroupErrors:
        frames = np.array([item.frame for item in objects], np.int64)
        found = np.array([item.found for item in objects], bool)
        return GroupErrors(
            group=group,
            objects=len(objects),
            found=int(found.sum()),
            below_score=sum(item.below_score for item in objects),
            recall_interval=self.draws.ratio_interval(self._by_frame(frames[found]), self._by_frame(frames)),
            residuals=self._spreads(RESIDUALS, residuals, frames, shares=("turned",)),
        )

    def _false(self, detections: list[tuple[DetectionMatch, Surroundings | None]]) -> FalseDetections:
        false = [item for item, _ in detections if item.is_false]
        background = [(item, around) for item, around in detections if around is not None and item.kind == "background"]
        traits = Counter(trait for _, around in background for trait in around.traits or ("none",))
        frames = np.array([item.frame for item, _ in background], np.int64)
        names = ("distance_m", "points", "top_m", "reflectance", "cluster_length_m")
        values = np.array([[getattr(around, field) for field in names] for _, around in background], float)
        kinds, labels = Counter(item.kind for item in false), Counter(item.label for item in false if item.label)
        counts = self._by_frame(np.array([item.frame for item in false], np.int64))
        return FalseDetections(
            kinds={kind: kinds[kind] for kind in FALSE_KINDS},
            labels=dict(sorted(labels.items())),
            per_frame=len(false) / max(int(self.frames.sum()), 1),
            per_frame_interval=self.draws.ratio_interval(counts, self.frames.astype(np.float64)),
            traits={trait: traits[trait] / len(background) for trait in (*TRAITS, "none")} if background else {},
            surroundings=self._spreads(names, values.reshape(-1, len(names)), frames),
        )

    def _spreads(
        self,
        names: Sequence[str] | Mapping[str, str],
        values: NDArray[np.float64],
        frames: NDArray[np.int64],
        *,
        shares: Sequence[str] = (),
    ) -> dict[str, Spread]:
        """Compute the spread of each column of values (N, len(names)); NaN values are left out."""
        result = {}
        for name, column in zip(names, values.T, strict=True):
            kept = np.isfinite(column)
            finite, where = column[kept], frames[kept]
            if not len(finite):
                result[name] = Spread(0, None, None, None, None)
            elif name in shares:
                interval = self.draws.ratio_interval(self._by_frame(where, finite), self._by_frame(where))
                result[name] = Spread(len(finite), float(finite.mean()), None, None, interval)
            else:
                low, middle, high = np.percentile(finite, [10, 50, 90]).tolist()
                result[name] = Spread(len(finite), middle, low, high, self.draws.median_interval(finite, where))
        return result

    def _by_frame(self, frames: NDArray[np.int64], values: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        return np.bincount(frames, values, minlength=len(self.frames)).astype(np.float64)


def _fit_of(frame: ErrorFrame, objects: list[ObjectMatch]) -> NDArray[np.float64]:
    fits = label_fit(frame.points, np.array([item.box for item in objects]).reshape(-1, 7))
    hidden = [not _is_whole(item.occluded, item.truncated) for item in objects]
    fits[hidden] = np.nan
    return fits


def _is_whole(occluded: int, truncated: float) -> bool:
    return occluded in (0, UNKNOWN_OCCLUSION) and truncated <= CLEAR_TRUNCATION


def _groups(objects: Sequence[ObjectMatch]) -> dict[str, _Mask]:
    """Return masks (N,) of the groups in the order of the report; groups may be empty."""
    counted = np.array([item.counted for item in objects], bool)
    clear = counted & np.array([is_clear(item) for item in objects], bool)
    view = np.array([view_of(item.view_deg) for item in objects], dtype=object)
    occluded = np.array([item.occluded for item in objects], np.int64)
    distance = np.array([np.hypot(item.box[0], item.box[1]) for item in objects])
    points = np.array([item.points for item in objects], np.float64)
    neighbor = np.array([item.neighbor_m for item in objects], np.float64)
    groups = {ALL: counted, CLEAR: clear} | {name: clear & (view == name) for name in VIEWS}
    groups |= {_band(low, high, "m"): counted & _within(distance, low, high) for low, high in pairwise(DISTANCES_M)}
    groups |= {name: counted & (occluded == state) for state, name in enumerate(OCCLUSIONS)}
    groups[LARGELY_OCCLUDED] = occluded == len(OCCLUSIONS)
    for low, high in pairwise(POINTS):
        groups[_band(low, high - 1, "points")] = counted & _within(points, low, high)
    for low, high in pairwise(NEIGHBORS_M):
        groups[f"next one at {_band(low, high, 'm')}"] = counted & _within(neighbor, low, high)
    return groups


def _within(values: NDArray[np.float64], low: float, high: float) -> _Mask:
    return (values >= low) & ((values < high) | (high == inf))


def _band(low: float, high: float, unit: str) -> str:
    return f"{low:g}+ {unit}" if high == inf else f"{low:g}-{high:g} {unit}"


def _shares_reaching(labels: NDArray[np.float64], residuals: NDArray[np.float64], iou: float) -> dict[str, float]:
    if not len(labels):
        return {}
    boxes = {name: corrected(labels, residuals, name) for name in CORRECTIONS}
    turned = list(RESIDUALS).index("turned")
    systematic = np.median(residuals, axis=0)
    systematic[turned] = 0.0
    boxes[WITHOUT_MEDIANS] = boxes_from_residuals(labels, residuals - systematic)
    return {name: float(np.mean(paired_iou_3d(fixed, labels) >= iou)) for name, fixed in boxes.items()}


def _false_rates(detections: list[DetectionMatch], counted: int, frames: int) -> tuple[FalseRate, ...]:
    """Return thresholds for FALSE_RATES; detections of equal scores are reported together."""
    judged = sorted((item for item in detections if item.kind != "ignored"), key=lambda item: -item.score)
    scores = np.array([item.score for item in judged])
    last_of_score = np.flatnonzero(np.append(np.diff(scores) != 0, True)[: len(scores)])
    found = np.cumsum([item.kind == "found" for item in judged], dtype=np.int64)[last_of_score]
    false = np.cumsum([item.kind != "found" for item in judged], dtype=np.int64)[last_of_score]
    rates = []
    for per_frame in FALSE_RATES:
        allowed = np.flatnonzero(false <= per_frame * frames + 1e-9)
        if len(allowed) and counted:
            row = allowed[-1]
            rates.append(FalseRate(per_frame, float(scores[last_of_score[row]]), float(found[row] / counted)))
    return tuple(rates)


def _best_score(detections: list[DetectionMatch], counted: int) -> float | None:
    """Return the score threshold with the best F1 of counted objects; None if none is found."""
    judged = [item for item in detections if item.kind != "ignored"]
    scores = np.array([item.score for item in judged])
    order = np.argsort(-scores, kind="stable")
    true = np.array([item.kind == "found" for item in judged], bool)[order].cumsum()
    if not len(judged) or not true[-1]:
        return None
    scores = scores[order]
    f1 = 2 * true / (counted + np.arange(1, len(judged) + 1))
    f1[:-1][scores[:-1] == scores[1:]] = 0.0  # equal scores are reported together
    return float(scores[f1.argmax()])
