"""Measurements of one labelled frame as in training, computed with the functions of the training loader.

Conventions in which labels of other tools differ, and how well the points of scans fit each of them.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.config.tree import DataConfig
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, read_frame, within_ranges
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.detection.targets import Assigner, assign_targets
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.scans.input_check import AxesWarning, check_axes, ground_z_m
from asca_pillars.scans.scan_reader import decide_scale

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


InspectedSpec: TypeAlias = PillarSpec | VoxelSpec
"""Specs of the families that can be inspected."""


@dataclass(frozen=True)
class InputCells:
    """Pillars or voxels.

    Attributes:
        name: name of one cell.
        indices_of: finite points (N, >=3), metres, LiDAR frame -> flat index of each one's cell (N,), -1 outside.
        max_points: points of a cell that the network uses.
        max_points_key: key of `max_points` in the configuration.
        max_cells: limit of cells in a scan; None without one.
        closer_anchors: advice for a denser grid of anchors.
    """

    name: str
    indices_of: Callable[[NDArray[np.floating[Any]]], NDArray[np.int64]]
    max_points: int
    max_points_key: str
    max_cells: int | None
    closer_anchors: str


def input_cells(spec: InspectedSpec) -> InputCells:
    """Return the cells of this detector's input."""
    if isinstance(spec, PillarSpec):
        return InputCells(
            name="pillar",
            indices_of=spec.grid.cells,
            max_points=spec.limits.max_points,
            max_points_key="model.spec.limits.max_points",
            max_cells=spec.limits.max_pillars,
            closer_anchors="make model.spec.grid.v_max_m and v_y_m smaller",
        )
    finer = "make model.spec.grid.size_m smaller along x and y"
    return InputCells(
        name="voxel",
        indices_of=spec.grid.cells,
        max_points=spec.grid.max_points,
        max_points_key="model.spec.grid.max_points",
        max_cells=None,
        closer_anchors=f"set model.spec.last_stride=1, or {finer}" if spec.last_stride > 1 else finer,
    )


DOUBT_POINTS = 8_192
"""Points of a scan for the check of its axes."""


class MatchOutcome(IntEnum):
    """Assignment of anchors to a labelled object."""

    LEFT_OUT = 0
    """It has too few points, or its center is outside the grid."""
    OVERLAPPED = 1
    """A positive anchor overlaps it by positive_iou; with the assigner `atss`, at all."""
    FORCED = 2
    """No anchor overlaps it by that; the nearest ones are matched to it nevertheless, and fit poorly."""
    MISSED = 3
    """It has no positive anchor."""


class ScanMeasure(NamedTuple):
    """Scan as stored and as in training, and its pillars or voxels before any limit.

    `inside` counts the points inside the grid, `reflectance` is their mean in training, in 0..1. Stored reflectances
    are divided by `reflectance_scale`; the fraction `above_scale` is then clipped. `ground_z_m` is NaN if
    the ground near the sensor is not visible. `crowded` cells have more than max_points, which drops `cut` points.
    """

    points: int
    inside: int
    dropped: int
    stored_reflectance_low: float
    stored_reflectance_high: float
    reflectance_scale: float
    above_scale: float
    reflectance: float
    ground_z_m: float
    cells: int
    fullest: int
    crowded: int
    cut: int


class FrameMeasure(NamedTuple):
    """Measurements of a frame: its labels by type, the M objects of the C classes, and its scan.

    `boxes` (M, 7), `labels` (M,) class index, `points` (M,) inside each box, `outcomes` (M,), `positives` (C,) positive
    anchors of each class, `axes` a warning about the scan's axes, `convention_points` (C, M) inside each box by each
    of the conventions, `label_yaws` as labelled.
    """

    types: Counter[str]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    points: NDArray[np.int64]
    outcomes: NDArray[np.int64]
    positives: NDArray[np.int64]
    scan: ScanMeasure
    axes: AxesWarning | None
    convention_points: NDArray[np.int64]
    label_yaws: NDArray[np.float64]


def measure_frame(
    split: LabeledSplit, frame_id: str, spec: InspectedSpec, data: DataConfig, assigner: Assigner = "overlap"
) -> FrameMeasure:
    """Read a frame without random changes, match it with the anchors, and count.

    Raises:
        DatasetError, ScanError: a damaged file, see `read_frame`.
    """
    # min_points=0: objects that training ignores for their few points are counted by class, too.
    frame = read_frame(split, frame_id, spec.class_names, camera_view=data.camera_view, min_points=0)
    points = points_in_boxes(frame.points, frame.boxes).sum(axis=0)
    to_find = replace(frame, labels=np.where(points < data.min_points, IGNORED, frame.labels))
    outcomes, positives = match(to_find, spec, assigner)
    counted = frame.labels != IGNORED
    stored = split.stored_points(frame_id)
    scale = 1.0 if split.one_reflectance_scale else decide_scale(stored[:, 3])[0]
    scan = measure_scan(stored, frame.points, spec, scale)
    sample = frame.points[:: max(1, len(frame.points) // DOUBT_POINTS)]
    return FrameMeasure(
        types=Counter(split.label_types(frame_id)),
        boxes=frame.boxes[counted],
        labels=frame.labels[counted],
        points=points[counted],
        outcomes=outcomes[counted],
        positives=positives,
        scan=scan,
        axes=check_axes(sample, None if np.isnan(scan.ground_z_m) else scan.ground_z_m) if len(sample) else None,
        convention_points=count_points(frame.points, frame.boxes[counted]),
        label_yaws=split.label_yaws(frame_id),
    )


def match(
    frame: LabeledFrame, spec: InspectedSpec, assigner: Assigner = "overlap"
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the `MatchOutcome` of each box (M,), and counts (C,) of the positive anchors of each class."""
    # Rows in place of the labels show which boxes are inside the grid.
    kept = within_ranges(replace(frame, labels=np.arange(len(frame.boxes))), spec.ranges).labels
    boxes, labels = frame.boxes[kept], frame.labels[kept]
    targets = assign_targets(spec.anchors, spec.classes, boxes, labels, assigner)
    outcomes = np.full(len(frame.boxes), MatchOutcome.LEFT_OUT, dtype=np.int64)
    for row in np.flatnonzero(labels != IGNORED):
        overlap = aligned_bev_iou(targets.anchors[targets.matched == row], boxes[row : row + 1]).max(initial=0)
        threshold = spec.classes[labels[row]].positive_iou if assigner == "overlap" else 0.0
        if overlap == 0:
            outcomes[kept[row]] = MatchOutcome.MISSED
        else:
            outcomes[kept[row]] = MatchOutcome.OVERLAPPED if overlap >= threshold else MatchOutcome.FORCED
    return outcomes, np.bincount(labels[targets.matched], minlength=len(spec.classes))


def measure_scan(
    stored: NDArray[np.float32], seen: NDArray[np.float32], spec: InspectedSpec, reflectance_scale: float = 1.0
) -> ScanMeasure:
    """Measure the points that a file has, (N, 4), and those of them that training sees, (M, 4), in the LiDAR frame."""
    finite = stored[np.isfinite(stored).all(axis=1)]
    ground = ground_z_m(finite)
    kind = input_cells(spec)
    cells = kind.indices_of(seen)
    _, per_cell = np.unique(cells[cells >= 0], return_counts=True)
    return ScanMeasure(
        points=len(seen),
        inside=int(per_cell.sum()),
        dropped=len(stored) - len(finite),
        stored_reflectance_low=float(finite[:, 3].min(initial=0)),
        stored_reflectance_high=float(finite[:, 3].max(initial=0)),
        reflectance_scale=reflectance_scale,
        above_scale=float((finite[:, 3] > reflectance_scale).mean()) if len(finite) else 0.0,
        reflectance=float(seen[:, 3].mean(dtype=np.float64)) if len(seen) else 0.0,
        ground_z_m=np.nan if ground is None else ground,
        cells=len(per_cell),
        fullest=int(per_cell.max(initial=0)),
        crowded=int((per_cell > kind.max_points).sum()),
        cut=int(np.maximum(per_cell - kind.max_points, 0).sum()),
    )
