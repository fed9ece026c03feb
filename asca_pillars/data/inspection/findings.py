"""Problems of a dataset, found before training, each with its remedy."""

from collections import Counter
from collections.abc import Iterator
from typing import Literal, NamedTuple

from asca_pillars.data.frames import other_spelling
from asca_pillars.data.inspection.inspect_dataset import ClassFacts, Inspection, ScanFacts
from asca_pillars.data.inspection.measurements import InspectedSpec, better_convention, input_cells
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
    there = ", ".join(f"{kind} {count}" for kind, count in inspection.types.items()) or "none at all"
    if inspection.sampled:
        advice = f"look at all frames with --frames {inspection.frames_in_split}, or list other frames in ImageSets/"
    else:
        advice = (
            "list frames that have some in ImageSets/, take the class out of model.spec.classes, or let --propose "
            "measure the classes that there are"
        )
    return f"no label is of this type (there are: {there}); {advice}"


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
