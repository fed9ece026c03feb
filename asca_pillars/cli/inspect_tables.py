"""Tables of `asca inspect`, one for each kind of problem before training."""

from collections.abc import Sequence

from rich.table import Table

from asca_deploy.inspect_scans import ScansInspection
from asca_pillars.base.errors import printable
from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.data.inspection.inspect_dataset import ClassFacts, Inspection, Spread
from asca_pillars.data.inspection.measurements import InputCells


def types(inspection: Inspection, names: Sequence[str]) -> Table:
    """Return a table of labelled types, their number, and their use in training."""
    neighbors = {NEIGHBOR_TYPES[name]: name for name in names if name in NEIGHBOR_TYPES}
    table = _table("Labels", "type", "count", "per frame", "in training")
    for kind, count in inspection.types.items():
        role = f"ignored: neither {neighbors[kind]} nor background" if kind in neighbors else "background"
        table.add_row(kind, str(count), f"{count / inspection.frames:.2f}", "a class" if kind in names else role)
    return table


def objects(inspection: Inspection, min_points: int) -> Table:
    """Return a table of boxes and points per class, and of those outside the ranges."""
    few = f"< {min_points}"
    title = (
        "Objects: points inside a box (10 % / median / 90 %); boxes with 0 or few, out of the grid, cut by z_range_m"
    )
    table = _table(title, "class", "boxes", "points", "= 0", few, "x out", "y out", "z out", "z cut")
    for facts in inspection.classes:
        counts = (facts.no_points, facts.few_points, *facts.outside_xyz, facts.cut_in_z)
        table.add_row(
            facts.name, str(facts.boxes), _spread(facts.points), *(_share(count, facts.boxes) for count in counts)
        )
    return table


def conventions(inspection: Inspection) -> Table:
    """Return a table of the points in the boxes by each convention for yaw and z."""
    title = "Conventions: points in the boxes of the classes as labelled and otherwise; boxes with 10 % more or fewer"
    table = _table(title, "boxes", "points", "more", "fewer")
    for fit in inspection.conventions:
        table.add_row(fit.name, str(fit.points), str(fit.more), str(fit.fewer))
    return table


def sizes(inspection: Inspection) -> Table:
    """Return a table of sizes per class compared with the anchors."""
    title = "Sizes, m: mean ± standard deviation (difference to the anchor); misfits cannot reach positive_iou"
    table = _table(title, "class", "length", "width", "height", "center z", "misfits")
    for facts in inspection.classes:
        table.add_row(facts.name, *_size_cells(facts), _share(facts.misfits, facts.boxes))
    return table


def _size_cells(facts: ClassFacts) -> list[str]:
    if facts.size_m is None or facts.size_std_m is None or facts.z_m is None:
        return ["-"] * 4
    sizes = zip(facts.size_m, facts.size_std_m, facts.anchor_size_m, strict=True)
    cells = [f"{mean:.2f} ± {std:.2f} ({mean - anchor:+.2f})" for mean, std, anchor in sizes]
    return [*cells, f"{facts.z_m:.2f} ({facts.z_m - facts.anchor_z_m:+.2f})"]


def matching(inspection: Inspection) -> Table:
    """Return a table of the number of positive anchors of each class."""
    title = "Matching: objects to find, by the best anchor that is to find them: positive_iou, only the nearest, none"
    table = _table(title, "class", "objects", "by IoU", "nearest", "none", "anchors per frame", "per object")
    for facts in inspection.classes:
        to_find = facts.overlapped + facts.forced + facts.missed
        shares = (_share(count, to_find) for count in (facts.overlapped, facts.forced, facts.missed))
        per_object = f"{facts.positives / to_find:.1f}" if to_find else "-"
        table.add_row(facts.name, str(to_find), *shares, f"{facts.positives / inspection.frames:.2f}", per_object)
    return table


def scans(inspection: Inspection, kind: InputCells, camera_view: bool) -> Table:
    """Return a table of points, reflectance, ground, pillars or voxels of the scans."""
    scans = inspection.scans
    low, high = scans.reflectance_stored
    ground = "not seen" if scans.ground_z_m is None else _spread(scans.ground_z_m, 2)
    bottoms = " to ".join(f"{bottom:.2f}" for bottom in scans.anchor_bottoms_m)
    view = "in the camera's view" if camera_view else "per scan"
    table = _table("Scans: 10 % / median / 90 %", "", "found", "expected")
    table.add_row(f"points {view}", _spread(scans.points), "")
    table.add_row("points outside the grid", f"{100 * scans.outside_share:.1f} %", "")
    table.add_row("points not finite", f"{scans.dropped_points} in {scans.scans_with_dropped} scans", "0")
    table.add_row("reflectance in the files", f"{low:.3g} to {high:.5g}", "0 to 1")
    table.add_row("mean reflectance as read", _spread(scans.reflectance, 3), "")
    table.add_row("ground near the sensor, z in m", ground, f"{bottoms}, where the anchors stand")
    if kind.max_cells is None:
        table.add_row(f"{kind.name}s", _spread(scans.cells), "")
    else:
        over = _share(scans.scans_over_max_cells, inspection.frames)
        table.add_row(f"{kind.name}s", _spread(scans.cells), f"at most {kind.max_cells}")
        table.add_row(f"scans with more {kind.name}s", f"{over}, largest {scans.cells.largest:.0f}", "0 %")
    table.add_row(f"points of the fullest {kind.name}", str(scans.fullest_cell), f"at most {kind.max_points}")
    table.add_row(f"{kind.name}s with more points", f"{100 * scans.crowded_share:.1f} %", "")
    table.add_row("points lost that way", f"{100 * scans.cut_share:.1f} %", "")
    return table


def recorded(inspection: ScansInspection) -> list[Table | str]:
    """Return what was inspected; for a recording its topics, if there are several, and its times, frames and fields."""
    of_topic = "" if inspection.topic is None else f", {printable(inspection.topic)}"
    ranges_text = ", ".join(
        f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", inspection.ranges, strict=True)
    )
    lines: list[Table | str] = [
        f"{inspection.path}{of_topic}: {inspection.inspected} of {inspection.scans} scans measured",
        f"against {inspection.model}, which looks in {ranges_text} m",
        *map(printable, inspection.notes),
    ]
    if len(inspection.topics) > 1:
        topics = _table("Topics", "topic", "type", "messages")
        for topic in inspection.topics:
            topics.add_row(printable(topic.name), printable(topic.type), str(topic.messages))
        lines.append(topics)
    facts = []
    if inspection.times is not None:
        rate = "" if inspection.times.rate_hz is None else f", {inspection.times.rate_hz:.3g} scans per second"
        facts.append(f"{inspection.times.seconds:.1f} s{rate}")
    if inspection.frame_ids:
        facts.append(f"frame {', '.join(inspection.frame_ids)}")
    if inspection.fields:
        facts.append(f"fields {', '.join(inspection.fields)}")
    return [*lines, *([printable("; ".join(facts))] if facts else [])]


def unlabelled(inspection: ScansInspection) -> Table:
    """Return a table of points, reflectance, ground and ranges of unlabelled scans, beside the training scans'."""
    expected, height = inspection.expected, inspection.height
    low, high = expected.points_per_scan
    view = " (a camera's view)" if expected.camera_view else ""
    dark, bright = expected.reflectance_mean
    ground = "-" if expected.ground_z_m is None else f"{expected.ground_z_m[0]:.2f} to {expected.ground_z_m[1]:.2f}"
    trained_m = "-" if expected.sensor_height_m is None else f"{expected.sensor_height_m:.2f}"
    share = None if inspection.inside_share is None else Spread(*(100 * value for value in inspection.inside_share))
    table = _table("Scans: 10 % / median / 90 %", "", "found", "expected")
    table.add_row("points", _spread(inspection.points), f"{low} to {high}{view}")
    table.add_row("points not finite", str(inspection.not_finite), "0")
    table.add_row("points within the ranges, %", _spread(share, 1), "")
    table.add_row(
        "reflectance as stored", ", ".join(f"0 to {scale:g}" for scale in inspection.reflectance_scales) or "none", ""
    )
    table.add_row("mean reflectance as read", _spread(inspection.reflectance, 3), f"{dark:.3f} to {bright:.3f}")
    table.add_row("ground near the sensor, z, m", _spread(inspection.ground_z_m, 2), ground)
    table.add_row("sensor above the ground, m", "-" if height is None else f"{height.height_m:.2f}", trained_m)
    return table


def _table(title: str, first: str, *others: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="left" if name in ("in training", "expected", "type") else "right")
    return table


def _spread(spread: Spread | None, digits: int = 0) -> str:
    if spread is None:
        return "-"
    return " / ".join(f"{value:.{digits}f}" for value in (spread.p10, spread.median, spread.p90))


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "-"
