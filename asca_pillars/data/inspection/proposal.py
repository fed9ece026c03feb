"""A configuration measured on a dataset: classes with their anchors and thresholds, and the ranges that hold them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from asca_pillars.config import Config, pillar_spec
from asca_pillars.data.inspection.findings import FEWEST_BOXES
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.errors import DatasetError
from asca_pillars.geometry.anchors import ANCHOR_YAWS_RAD, ClassSpec
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.pillars.fitting import NECK_STRIDE
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.schema import to_dict

HELD = 0.98  # share of the boxes that each range has to hold
MATCHED = 0.6  # share of the boxes that an anchor should overlap by positive_iou; the best positive_iou that gives it
POSITIVE_IOUS = (0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3)
NEGATIVE_BELOW = 0.15  # negative_iou below positive_iou, as for KITTI's classes
BEHIND_M = -5.0  # boxes beyond this need a grid that looks back
FINDABLE_POINTS = 5  # ranges are those of the boxes with so many: far ones with fewer would make the grid huge
SPARE_PILLARS = 1.1  # room above the fullest scan

_Floats = NDArray[np.float64]


class Proposal(NamedTuple):
    """The configuration, and how many boxes each class was measured on; `rare` types have too few for a class."""

    config: Config
    boxes: dict[str, int]
    rare: dict[str, int]


def propose(split: LabeledSplit, config: Config, *, frames: int = 500, progress: bool = False) -> Proposal:
    """`config` with every labelled type of FEWEST_BOXES or more visible boxes as a class, and a grid that holds them.

    An anchor has the median size and height of its boxes. A range of the grid stays as it is if it holds HELD of them.

    Args:
        split: the labels.
        config: everything else is taken from it.
        frames: how many frames are looked at, evenly spaced.
        progress: show a bar.

    Raises:
        DatasetError: a frame cannot be read, or no type has enough boxes.
    """
    ids = split.frame_ids
    chosen = [ids[number * len(ids) // min(frames, len(ids))] for number in range(min(frames, len(ids)))]
    clouds = []
    found: dict[str, list[NDArray[np.float32]]] = {}
    findable: dict[str, list[NDArray[np.float32]]] = {}
    for frame_id in track(chosen, "Measuring", disable=not progress, transient=True):
        points = split.points(frame_id, camera_view=config.data.camera_view)
        boxes, types = split.labeled_boxes(frame_id)
        inside = points_in_boxes(points, boxes).sum(axis=0)
        for box, kind, held in zip(boxes, types, inside.tolist(), strict=True):
            found.setdefault(kind, []).extend([box] if held >= max(config.data.min_points, 1) else [])
            findable.setdefault(kind, []).extend([box] if held >= FINDABLE_POINTS else [])
        clouds.append(points)
    counts = {kind: len(own) for kind, own in sorted(found.items(), key=lambda item: -len(item[1]))}
    names = [kind for kind, count in counts.items() if count >= FEWEST_BOXES]
    if not names:
        there = ", ".join(f"{kind} {count}" for kind, count in counts.items()) or "none"
        raise DatasetError(
            f"{split.root}: no type has {FEWEST_BOXES} boxes with points (there are: {there}); add frames"
        )
    measured = {kind: np.array(found[kind], np.float64) for kind in names}
    of_classes = [np.array(findable[kind] or found[kind], np.float64) for kind in names]
    before = pillar_spec(config)
    grid = _grid(before.grid, np.concatenate(of_classes))
    classes = tuple(_class(kind, boxes, grid) for kind, boxes in measured.items())
    fullest = max(len(np.unique(cells[cells >= 0])) for cells in map(grid.cells, clouds))
    limits = before.limits
    if fullest > limits.max_pillars:
        limits = replace(limits, max_pillars=math.ceil(fullest * SPARE_PILLARS / 1000) * 1000)
    spec = replace(before, grid=grid, limits=limits, classes=classes)
    insert = config.augment.insert
    kept = {kind: share for kind, share in insert.proportions.items() if kind in names}
    proposed = replace(
        config,
        name=f"{config.name}_own",
        model=replace(config.model, spec=spec),  # type: ignore[arg-type]  # as `before` was
        augment=replace(config.augment, insert=replace(insert, proportions=kept)),
        data=replace(config.data, camera_view=config.data.camera_view and split.has_camera),
    )
    rare = {kind: count for kind, count in counts.items() if kind not in names}
    return Proposal(proposed, {kind: counts[kind] for kind in names}, rare)


def differences(config: Config) -> dict[str, Any]:
    """What of a configuration is not the default, as plain values for a YAML."""
    plain: dict[str, Any] = _differences(to_dict(config), to_dict(Config()))
    return plain


def _differences(value: Any, default: Any) -> Any:
    if not (isinstance(value, dict) and isinstance(default, dict)):
        return value
    changed = {key: own for key, own in value.items() if key not in default or own != default[key]}
    return {key: _differences(own, default.get(key)) for key, own in changed.items()}


def _grid(grid: PillarGrid, boxes: _Floats) -> PillarGrid:
    """A grid of the same pillars whose ranges hold the boxes (N, 7)."""
    outside = (1 - HELD) / 2
    if np.quantile(boxes[:, 0], outside) < min(BEHIND_M, grid.x_range_m[0]):
        # Zones grow coarser ahead of the sensor; a view all around needs pillars of one depth.
        grid = _replaced(grid, zones=1, v_max_m=grid.v_y_m, **_ranges_all_around(grid, boxes, outside))
    else:
        steps = NECK_STRIDE * grid.zones * grid.v_max_m, NECK_STRIDE * grid.v_y_m
        x_range_m = _widened(grid.x_range_m, boxes[:, 0], outside, steps[0])
        grid = _replaced(grid, x_range_m=x_range_m, y_range_m=_widened(grid.y_range_m, boxes[:, 1], outside, steps[1]))
    low = np.quantile(boxes[:, 2] - boxes[:, 5] / 2, outside)
    high = np.quantile(boxes[:, 2] + boxes[:, 5] / 2, 1 - outside)
    if not (grid.z_range_m[0] <= low and high <= grid.z_range_m[1]):
        margin_m = 0.5  # the ground below, and what is a little higher
        grid = _replaced(grid, z_range_m=(_tenths(low - margin_m), _tenths(high + margin_m)))
    return grid


def _ranges_all_around(grid: PillarGrid, boxes: _Floats, outside: float) -> dict[str, tuple[float, float]]:
    step_m = NECK_STRIDE * grid.v_y_m
    reach_m = np.quantile(np.abs(boxes[:, :2]), 1 - outside, axis=0)
    halves = [math.ceil(2 * reach / step_m) * step_m / 2 for reach in reach_m.tolist()]
    return {f"{axis}_range_m": (-half, half) for axis, half in zip("xy", halves, strict=True)}


def _widened(span_m: tuple[float, float], centers: _Floats, outside: float, step_m: float) -> tuple[float, float]:
    low, high = np.quantile(centers, outside), np.quantile(centers, 1 - outside)
    if span_m[0] <= low and high < span_m[1]:
        return span_m
    if span_m[0] == -span_m[1]:
        half = math.ceil(2 * max(-low, high) / step_m) * step_m / 2
        return -half, half
    start = min(span_m[0], math.floor(low / step_m) * step_m)
    return start, start + math.ceil((max(high, span_m[1]) - start) / step_m) * step_m


def _class(name: str, boxes: _Floats, grid: PillarGrid) -> ClassSpec:
    length, width, height = (round(float(value), 2) for value in np.median(boxes[:, 3:6], axis=0))
    z_m = round(float(np.median(boxes[:, 2])), 2)
    best = _best_overlaps(boxes, (length, width, height), grid)
    reached = [iou for iou in POSITIVE_IOUS if (best >= iou).mean() >= MATCHED]
    positive = max(reached, default=POSITIVE_IOUS[-1])
    return ClassSpec(name, length, width, height, z_m, positive, round(positive - NEGATIVE_BELOW, 2))


def _best_overlaps(boxes: _Floats, size_m: Sequence[float], grid: PillarGrid) -> _Floats:
    """(N,) overlap of each box with the better one of the anchors of the cell that is nearest to it."""
    x_m, y_m = grid.head_centers_m()
    best = np.zeros(len(boxes))
    for row, box in enumerate(boxes):
        near = x_m[np.abs(x_m - box[0]).argmin()], y_m[np.abs(y_m - box[1]).argmin()], 0.0
        anchors = np.array([[*near, *size_m, yaw] for yaw in ANCHOR_YAWS_RAD])
        best[row] = aligned_bev_iou(anchors, box[None]).max()
    return best


def _replaced(grid: PillarGrid, **changes: Any) -> PillarGrid:
    """The grid with other values, without float dust in its ranges: they are to be read in a YAML."""
    for name in {"x_range_m", "y_range_m"} & set(changes):
        changes[name] = tuple(round(edge, 6) for edge in changes[name])
    return replace(grid, **changes)


def _tenths(value: float) -> float:
    return round(float(value), 1)
