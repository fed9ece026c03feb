"""Configuration fitted to a dataset: classes with their anchors and thresholds, and ranges."""

import math
from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.base.files import write_text
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.config.tree import Config
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.inspection.findings import FEWEST_BOXES
from asca_pillars.data.inspection.measurements import InspectedSpec
from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD, ClassSpec
from asca_pillars.geometry.arrays import Floats, Singles
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.ops.pillar.grid import NECK_STRIDE
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import MAP_MULTIPLE

HELD = 0.98  # share of the boxes that each range has to contain
MATCHED = 0.6  # share of the boxes that an anchor should overlap by positive_iou; the best positive_iou with that share
POSITIVE_IOUS = (0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3)
NEGATIVE_BELOW = 0.15  # negative_iou below positive_iou, as for KITTI's classes
BEHIND_M = -5.0  # boxes further behind need a grid that extends behind the sensor
FINDABLE_POINTS = 5  # ranges are those of the boxes with so many: far ones with fewer would make the grid huge
SPARE_PILLARS = 1.1  # margin above the scan with the most pillars
_TENTH_M = 0.1


class Proposal(NamedTuple):
    """Configuration, and the number of boxes per class; `rare` types have too few for a class."""

    config: Config
    boxes: dict[str, int]
    rare: dict[str, int]


def propose(split: LabeledSplit, config: Config, *, frames: int = 500, reporter: Reporter = SILENT) -> Proposal:
    """Return `config` with each type of FEWEST_BOXES or more visible boxes as a class, and a grid that contains them.

    An anchor has the median size and height of its boxes. A range of the grid is kept if it contains HELD of them.

    Args:
        split: the labels.
        config: the other settings.
        frames: number of frames to measure, evenly spaced.
        reporter: for the progress.

    Raises:
        DatasetError: a frame cannot be read, or no type has enough boxes.
    """
    ids = split.frame_ids
    chosen = [ids[number * len(ids) // min(frames, len(ids))] for number in range(min(frames, len(ids)))]
    clouds = []
    boxes_of: dict[str, list[Singles]] = {}
    findable: dict[str, list[Singles]] = {}
    for frame_id in reporter.track(chosen, "Measuring"):
        points = split.points(frame_id, camera_view=config.data.camera_view)
        boxes, types = split.labeled_boxes(frame_id)
        inside = points_in_boxes(points, boxes).sum(axis=0)
        for box, kind, held in zip(boxes, types, inside.tolist(), strict=True):
            boxes_of.setdefault(kind, []).extend([box] if held >= max(config.data.min_points, 1) else [])
            findable.setdefault(kind, []).extend([box] if held >= FINDABLE_POINTS else [])
        clouds.append(points)
    counts = {kind: len(boxes) for kind, boxes in sorted(boxes_of.items(), key=lambda item: -len(item[1]))}
    names = [kind for kind, count in counts.items() if count >= FEWEST_BOXES]
    if not names:
        there = ", ".join(f"{kind} {count}" for kind, count in counts.items()) or "none"
        raise DatasetError(
            f"{split.root}: no type has {FEWEST_BOXES} boxes with points (there are: {there}); add frames"
        )
    measured = {kind: np.array(boxes_of[kind], np.float64) for kind in names}
    of_classes = [np.array(findable[kind] or boxes_of[kind], np.float64) for kind in names]
    spec = _with_ranges_holding(config.model.spec, np.concatenate(of_classes))
    spec = replace(spec, classes=tuple(_class(kind, boxes, spec) for kind, boxes in measured.items()))
    if isinstance(spec, PillarSpec):
        fullest = max(len(np.unique(cells[cells >= 0])) for cells in map(spec.grid.cells, clouds))
        if fullest > spec.limits.max_pillars:
            most = math.ceil(fullest * SPARE_PILLARS / 1000) * 1000
            spec = replace(spec, limits=replace(spec.limits, max_pillars=most))
    insert = config.augment.insert
    kept = {kind: share for kind, share in insert.proportions.items() if kind in names}
    proposed = replace(
        config,
        name=f"{config.name}_own",
        model=replace(config.model, spec=spec),  # type: ignore[arg-type]  # of the same family
        augment=replace(config.augment, insert=replace(insert, proportions=kept)),
        data=replace(config.data, camera_view=config.data.camera_view and split.has_camera),
    )
    rare = {kind: count for kind, count in counts.items() if kind not in names}
    return Proposal(proposed, {kind: counts[kind] for kind in names}, rare)


def differences(config: Config) -> dict[str, Any]:
    """Return the settings of a configuration that differ from the defaults, as plain values for a YAML."""
    plain = _differences(config, to_dict(config))
    if config.model.kind != Config().model.kind:
        plain["model"] = {"kind": config.model.kind} | plain["model"]
    return plain


def _differences(settings: Any, plain: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a dataclass that differ from the defaults of its own type, recursively."""
    default, changed = type(settings)(), {}
    for key, value in plain.items():
        changed_value = getattr(settings, key)
        if changed_value != getattr(default, key):
            changed[key] = _differences(changed_value, value) if is_dataclass(changed_value) else value
    return changed


def _with_ranges_holding(spec: InspectedSpec, boxes: Floats) -> InspectedSpec:
    """Return the spec with a grid of the same cells whose ranges contain the boxes (N, 7)."""
    grid, outside, changes = spec.grid, (1 - HELD) / 2, dict[str, Any]()
    looks_back = np.quantile(boxes[:, 0], outside) < min(BEHIND_M, grid.x_range_m[0])
    if isinstance(spec, PillarSpec):
        depth_m, width_m, height_m = spec.grid.zones * spec.grid.v_max_m, spec.grid.v_y_m, _TENTH_M
        if looks_back:
            # Zones grow coarser ahead of the sensor; a view of every direction needs pillars of one depth.
            changes, depth_m = {"zones": 1, "v_max_m": width_m}, width_m
        steps_m = NECK_STRIDE * depth_m, NECK_STRIDE * width_m
    else:
        depth_m, width_m, height_m = spec.grid.size_m
        steps_m = MAP_MULTIPLE * spec.map_stride * depth_m, MAP_MULTIPLE * spec.map_stride * width_m
    for column, (axis, span_m, step_m) in enumerate(zip("xy", (grid.x_range_m, grid.y_range_m), steps_m, strict=True)):
        fitted = _symmetric if looks_back else _widened_range
        changes[f"{axis}_range_m"] = fitted(span_m, boxes[:, column], outside, step_m)
    low = np.quantile(boxes[:, 2] - boxes[:, 5] / 2, outside)
    high = np.quantile(boxes[:, 2] + boxes[:, 5] / 2, 1 - outside)
    if not (grid.z_range_m[0] <= low and high <= grid.z_range_m[1]):
        margin_m = 0.5  # for the ground below, and what is slightly higher
        changes["z_range_m"] = tuple(height_m * round(end / height_m) for end in (low - margin_m, high + margin_m))
    # Rounded for readability in a YAML.
    ranges = {key: tuple(round(float(end), 6) for end in changes[key]) for key in changes if key.endswith("range_m")}
    return replace(spec, grid=replace(grid, **(changes | ranges)))  # type: ignore[arg-type]  # its own grid


def _symmetric(span_m: tuple[float, float], centers: Floats, outside: float, step_m: float) -> tuple[float, float]:
    """Return a range as `_widened_range`, symmetric ahead and behind."""
    if span_m[0] == -span_m[1] and _widened_range(span_m, centers, outside, step_m) == span_m:
        half = math.ceil(round(2 * span_m[1] / step_m, 6)) * step_m / 2  # whole steps, which may have changed
        return -half, half
    reach_m = float(np.quantile(np.abs(centers), 1 - outside))
    half = math.ceil(2 * reach_m / step_m) * step_m / 2
    return -half, half


def _widened_range(span_m: tuple[float, float], centers: Floats, outside: float, step_m: float) -> tuple[float, float]:
    low, high = np.quantile(centers, outside), np.quantile(centers, 1 - outside)
    if span_m[0] <= low and high < span_m[1]:
        return span_m
    if span_m[0] == -span_m[1]:
        half = math.ceil(2 * max(-low, high) / step_m) * step_m / 2
        return -half, half
    start = min(span_m[0], math.floor(low / step_m) * step_m)
    return start, start + math.ceil((max(high, span_m[1]) - start) / step_m) * step_m


def _class(name: str, boxes: Floats, spec: InspectedSpec) -> ClassSpec:
    length, width, height = (round(float(value), 2) for value in np.median(boxes[:, 3:6], axis=0))
    z_m = round(float(np.median(boxes[:, 2])), 2)
    best = _best_overlaps(boxes, (length, width, height), spec)
    reached = [iou for iou in POSITIVE_IOUS if (best >= iou).mean() >= MATCHED]
    positive = max(reached, default=POSITIVE_IOUS[-1])
    return ClassSpec(name, length, width, height, z_m, positive, round(positive - NEGATIVE_BELOW, 2))


def _best_overlaps(boxes: Floats, size_m: Sequence[float], spec: InspectedSpec) -> Floats:
    """Return the overlap (N,) of each box with the better one of the anchors of its nearest cell."""
    x_m, y_m = spec.anchor_centers_m()
    best = np.zeros(len(boxes))
    for row, box in enumerate(boxes):
        nearest = x_m[np.abs(x_m - box[0]).argmin()], y_m[np.abs(y_m - box[1]).argmin()], 0.0
        anchors = np.array([[*nearest, *size_m, yaw] for yaw in ANCHOR_YAWS_RAD])
        best[row] = aligned_bev_iou(anchors, box[None]).max()
    return best


def propose_config(
    split: LabeledSplit, config: Config, path: Path, frames: int, reporter: Reporter = SILENT
) -> tuple[Config, str]:
    """Measure and write to `path`; gives the configuration that was written, and its text.

    Raises:
        DatasetError: as `propose`.
        OutputError: there is a file already.
    """
    if path.exists():
        raise OutputError(f"{path}: is there already and may have been edited; choose another name, or remove it")
    proposal = propose(split, config, frames=frames, reporter=reporter)
    boxes = ", ".join(f"{name} {count}" for name, count in proposal.boxes.items())
    notes = [f"Measured on {split.root}, {split.name}: {boxes} boxes."]
    if proposal.rare:
        rare = ", ".join(f"{name} {count}" for name, count in proposal.rare.items())
        notes.append(f"No classes, for fewer than {FEWEST_BOXES} boxes with points: {rare}.")
    text = "".join(f"# {note}\n" for note in notes) + yaml.safe_dump(differences(proposal.config), sort_keys=False)
    write_text(path, text)
    return proposal.config, text
