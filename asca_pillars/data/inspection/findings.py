"""Problems of a dataset, found before training, each with its remedy, and a configuration fitted to the dataset."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import yaml

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.base.files import write_text
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.config.tree import Config
from asca_pillars.data.frames import LabeledSplit, other_spelling
from asca_pillars.data.inspection.inspect_dataset import ClassFacts, Inspection, ScanFacts
from asca_pillars.data.inspection.measurements import InspectedSpec, better_convention, input_cells
from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD, ClassSpec
from asca_pillars.geometry.boxes import Floats, Singles, points_in_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.ops.pillar.grid import NECK_STRIDE
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import MAP_MULTIPLE
from asca_pillars.scans.find_scans import evenly_spaced
from asca_pillars.scans.input_check import TOLERANCE_M

# Larger shares indicate an error or cost recall; KITTI and the simulator are well below all of them.
BOXES_OUTSIDE = 0.05
BOXES_CUT_IN_Z = 0.1
BOXES_WITHOUT_POINTS = 0.2
BOXES_WITH_FEW_POINTS = 0.3
BOXES_MISFIT = 0.25
BOXES_FORCED = 0.6
BOXES_MISSED = 0.02
POINTS_OUTSIDE = 0.75  # a grid ahead of the sensor excludes half of a revolution
POINTS_CUT = 0.2
SCANS_OVER_MAX_CELLS = 0.05
REFLECTANCES_CUT = 0.001  # fewer are noise and retroreflectors
ODD_SCANS = 0.5  # single scans may look turned, on wide streets and at crossings
FEWEST_BOXES = 10  # too few for a share or a mean
DIM_REFLECTANCE = 0.1  # the brightest point of all scans; the reflectance was scaled down twice


class Finding(NamedTuple):
    """Problem of a dataset. `error`: training cannot succeed. `about`: class or part, `text`: one line with remedy."""

    level: Literal["error", "warning"]
    about: str
    text: str


def findings(inspection: Inspection, spec: InspectedSpec, min_points: int) -> list[Finding]:
    """Return the problems, errors first: unreadable frames, classes without positives; then other problems.

    Args:
        inspection: measurements of the dataset.
        spec: the detector that the dataset was measured against.
        min_points: data.min_points of the same configuration.
    """
    problems: list[Finding] = []
    if inspection.damaged:
        text = f"frames that cannot be read: {len(inspection.damaged)}, the first: {inspection.damaged[0]}"
        problems.append(Finding("error", "frames", text))
    for facts in inspection.classes:
        if facts.positives == 0:
            frames = f"{inspection.frames} of {inspection.frames_in_split} frames of '{inspection.split}'"
            reason = _no_objects_reason(facts, inspection, spec, min_points)
            text = f"no anchor is positive for {facts.name} in {frames}: {reason}"
            problems.append(Finding("error", facts.name, text))
    for facts in inspection.classes:
        if facts.positives:
            problems += [
                Finding("warning", facts.name, f"{facts.name}: {text}")
                for text in _class_findings(facts, spec, min_points)
            ]
    scans = inspection.scans
    problems += [Finding("warning", "axes", text) for text in _axes_findings(inspection)]
    problems += [Finding("warning", "boxes", text) for text in _convention_findings(inspection)]
    problems += [Finding("warning", "reflectance", text) for text in _reflectance_findings(scans, inspection.frames)]
    problems += [Finding("warning", "height", text) for text in _height_findings(inspection)]
    problems += [Finding("warning", "points", text) for text in _point_findings(scans, inspection.frames, spec)]
    return problems


def _no_objects_reason(facts: ClassFacts, inspection: Inspection, spec: InspectedSpec, min_points: int) -> str:
    if facts.boxes == 0:
        return _why_no_boxes(facts.name, inspection)
    if facts.no_points == facts.boxes:
        return "none of its boxes holds a point; labels and calib must belong to the scans"
    if facts.few_points == facts.boxes:
        return f"all of its boxes have fewer points than data.min_points = {min_points}; lower it"
    if facts.missed == 0:
        return f"its boxes with enough points lie outside the grid; {_widen(facts, spec)}"
    return f"the anchors stand too far apart to overlap its boxes; {input_cells(spec).closer_anchors}"


def _why_no_boxes(name: str, inspection: Inspection) -> str:
    if (other := other_spelling(name, inspection.types)) is not None:
        return f"the labels spell it '{other}'; rename it there or in model.spec.classes"
    listed = ", ".join(f"{kind} {count}" for kind, count in inspection.types.items()) or "none at all"
    if inspection.sampled:
        advice = f"look at all frames with --frames {inspection.frames_in_split}, or list other frames in ImageSets/"
    else:
        advice = (
            "list frames that have some in ImageSets/, take the class out of model.spec.classes, or let --propose "
            "measure the classes that there are"
        )
    return f"no label is of this type (there are: {listed}); {advice}"


def _class_findings(facts: ClassFacts, spec: InspectedSpec, min_points: int) -> Iterator[str]:
    boxes = facts.boxes
    if boxes < FEWEST_BOXES:
        number = "1 box" if boxes == 1 else f"{boxes} boxes"
        yield f"only {number}, too few to learn from or to compare with the anchors; inspect or add more frames"
        return
    assert facts.size_m is not None and facts.z_m is not None, "there are boxes"
    if facts.no_points > BOXES_WITHOUT_POINTS * boxes:
        share = _percent(facts.no_points, boxes)
        yield f"{share} of the boxes hold no point; check that labels and calib belong to the scans"
    elif facts.few_points > BOXES_WITH_FEW_POINTS * boxes:
        share, limit = _percent(facts.few_points, boxes), min_points
        yield f"{share} of the boxes have fewer points than data.min_points = {limit} and are ignored; lower it"
    if max(facts.outside_xyz[:2]) > BOXES_OUTSIDE * boxes:
        x, y = (_percent(count, boxes) for count in facts.outside_xyz[:2])
        yield f"boxes lie outside the grid, {x} in x and {y} in y, and are left out; {_widen(facts, spec)}"
    if facts.cut_in_z > BOXES_CUT_IN_Z * boxes:
        share, z_range = _percent(facts.cut_in_z, boxes), list(spec.grid.z_range_m)
        yield f"{share} of the boxes reach beyond model.spec.grid.z_range_m {z_range} and lose points; widen it"
    if abs(facts.z_m - facts.anchor_z_m) > TOLERANCE_M:
        yield (
            f"the boxes' centers are at z = {facts.z_m:.2f} m on average, the anchor's at {facts.anchor_z_m:.2f} m; "
            f"set its z_m to {facts.z_m:.2f}"
        )
    if facts.misfits > BOXES_MISFIT * boxes:
        length, width, height = facts.size_m
        yield (
            f"{_percent(facts.misfits, boxes)} of the boxes differ too much in size from the anchor for positive_iou; "
            f"set length_m {length:.2f}, width_m {width:.2f}, height_m {height:.2f}, or lower positive_iou"
        )
    to_find = facts.overlapped + facts.forced + facts.missed
    if facts.missed > BOXES_MISSED * to_find:
        yield (
            f"{_percent(facts.missed, to_find)} of the objects have no positive anchor; "
            f"{input_cells(spec).closer_anchors}, or look for labels that stand twice"
        )
    if facts.forced > BOXES_FORCED * to_find >= facts.misfits:
        yield (
            f"{_percent(facts.forced, to_find)} of the objects have no anchor that overlaps them by positive_iou, only "
            f"the nearest; {input_cells(spec).closer_anchors}, or lower positive_iou and negative_iou"
        )


def _reflectance_findings(scans: ScanFacts, frames: int) -> Iterator[str]:
    low, high = scans.reflectance_stored
    if low < 0:
        yield f"reflectance goes down to {low:.4g} and is cut off at 0; store it as 0..1"
    if high == 0:
        yield "reflectance is 0 everywhere; check what exported the scans, the detector uses it"
    elif high < DIM_REFLECTANCE:
        yield f"reflectance reaches {high:.2g} only; store it as 0..1 (was it divided twice?)"
    *others, (scale, scaled) = scans.reflectance_scales
    if others:
        yield (
            f"reflectance reaches {high:.4g} in {scaled} of {frames} scans, which are divided by {scale:g}; "
            f"the others are taken as 0..{others[0][0]:g}: store all of them as 0..1"
        )
    elif scale > 1:
        yield (
            f"reflectance reaches {high:.5g} and is divided by {scale:g} when read: training sees 0 to "
            f"{min(1, high / scale):.2f}; divide it by its full scale in the files, then no dark scan is taken for one "
            "of 0..1"
        )
    if scans.above_scale_share > REFLECTANCES_CUT:
        yield (
            f"reflectance reaches {high:.4g} and is cut off at {scale:g} in {100 * scans.above_scale_share:.1f} % of "
            "the points; divide it by its full scale in the files"
        )


def _axes_findings(inspection: Inspection) -> Iterator[str]:
    if len(inspection.axes_warnings) <= ODD_SCANS * inspection.frames:
        return
    (_, axes), _ = Counter((warning.about, warning.axes) for warning in inspection.axes_warnings).most_common(1)[0]
    first = next(warning for warning in inspection.axes_warnings if warning.axes == axes)
    key, what = ("pose: FILE", "how the sensor is tilted") if axes is None else (f"axes: {axes}", "the axes")
    if inspection.states_mounting:
        remedy = f"if so, state {what}, `{key}` in dataset.yaml"
    else:
        remedy = "if so, turn the points of all scans to x forward, y left, z up, and calib with them"
    yield f"{len(inspection.axes_warnings)} of {inspection.frames} scans are odd, the first: {first.text}: {remedy}"


def _convention_findings(inspection: Inspection) -> Iterator[str]:
    if inspection.yaws_doubt is not None:
        yield inspection.yaws_doubt
    if (better := better_convention(inspection.conventions)) is not None:
        convention, fit = better
        yield (
            f"the points fit the boxes better {convention.name}: {fit.more} boxes hold more points so and {fit.fewer} "
            f"fewer, {fit.points} points together instead of {inspection.conventions[0].points}; {convention.remedy}"
        )


def _height_findings(inspection: Inspection) -> Iterator[str]:
    if inspection.scans.ground_z_m is None:
        return
    ground, (low, high) = inspection.scans.ground_z_m.median, inspection.scans.anchor_bottoms_m
    known = [item for item in inspection.classes if item.boxes >= FEWEST_BOXES]
    bottoms = [item.z_m - item.size_m[2] / 2 for item in known if item.z_m is not None and item.size_m is not None]
    floating = [bottom - ground for bottom in bottoms if abs(bottom - ground) > TOLERANCE_M]
    if floating and len(floating) == len(bottoms):
        yield (
            f"the ground near the sensor lies at z = {ground:.2f} m, the boxes stand {floating[0]:+.2f} m from it; "
            "calib and labels must belong to the scans"
        )
    elif not low - TOLERANCE_M <= ground <= high + TOLERANCE_M:
        yield (
            f"the ground near the sensor lies at z = {ground:.2f} m, the anchors stand on z = {low:.2f} to {high:.2f} "
            f"m; move z_m of the classes and z_range_m by about {ground - (low + high) / 2:+.1f} m"
        )


def _point_findings(scans: ScanFacts, frames: int, spec: InspectedSpec) -> Iterator[str]:
    if scans.dropped_points:
        yield (
            f"points with a value that is not finite: {scans.dropped_points}, in {scans.scans_with_dropped} of "
            f"{frames} scans; they are dropped: remove them where the scans are written"
        )
    if scans.scans_without_points:
        yield (
            f"scans without a point inside the grid: {scans.scans_without_points} of {frames}; "
            "check their calib and the grid's ranges, or take them out of the list"
        )
    if scans.outside_share > POINTS_OUTSIDE:
        yield (
            f"{100 * scans.outside_share:.0f} % of the points lie outside the grid; widen its ranges, or check the "
            "axes: x is forward, y left, z up, in meters"
        )
    kind = input_cells(spec)
    if scans.scans_over_max_cells > SCANS_OVER_MAX_CELLS * frames:
        yield (
            f"{_percent(scans.scans_over_max_cells, frames)} of the scans have more pillars than "
            f"model.spec.limits.max_pillars = {kind.max_cells} and lose the rest; raise it to {scans.cells.largest:.0f}"
        )
    if scans.cut_share > POINTS_CUT:
        yield (
            f"{kind.max_points_key} = {kind.max_points} takes away {100 * scans.cut_share:.0f} % of the points; "
            f"raise it, or make the {kind.name}s smaller"
        )


def _widen(facts: ClassFacts, spec: InspectedSpec) -> str:
    """Return the extent of the boxes along x, y or both, with the range that does not contain them."""
    assert facts.reach_m is not None, "there are boxes"
    ranges = (spec.grid.x_range_m, spec.grid.y_range_m)
    wrong = [
        f"they reach from {axis} = {low:.1f} to {high:.1f} m: widen model.spec.grid.{axis}_range_m {list(span)}"
        for axis, (low, high), span, count in zip("xy", facts.reach_m, ranges, facts.outside_xyz, strict=False)
        if count
    ]
    return ", ".join(wrong)


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"


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
    chosen = evenly_spaced(split.frame_ids, frames)
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
        listed = ", ".join(f"{kind} {count}" for kind, count in counts.items()) or "none"
        raise DatasetError(
            f"{split.root}: no type has {FEWEST_BOXES} boxes with points (there are: {listed}); add frames"
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
        raise OutputError(f"{path}: already exists and may have been edited; choose another name, or remove it")
    proposal = propose(split, config, frames=frames, reporter=reporter)
    boxes = ", ".join(f"{name} {count}" for name, count in proposal.boxes.items())
    notes = [f"Measured on {split.root}, {split.name}: {boxes} boxes."]
    if proposal.rare:
        rare = ", ".join(f"{name} {count}" for name, count in proposal.rare.items())
        notes.append(f"No classes, for fewer than {FEWEST_BOXES} boxes with points: {rare}.")
    text = "".join(f"# {note}\n" for note in notes) + yaml.safe_dump(differences(proposal.config), sort_keys=False)
    write_text(path, text)
    return proposal.config, text
