"""`asca inspect`: inspection of a dataset before training, or of scans without labels before detection.

Tables of `asca inspect`, one for each kind of problem before training.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from asca_deploy.inspect_scans import ScansInspection
from asca_pillars.base.errors import printable
from asca_pillars.base.installation import require
from asca_pillars.cli.options import (
    AroundOption,
    AxesOption,
    BundleOption,
    ColumnsOption,
    JsonOption,
    PoseOption,
    ReflectanceScaleOption,
    SensorHeightOption,
    TopicOption,
    scan_settings,
)
from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.data.inspection.inspect_dataset import ClassFacts, Inspection, Spread
from asca_pillars.data.inspection.measurements import InputCells


def types_table(inspection: Inspection, names: Sequence[str]) -> Table:
    """Return a table of labelled types, their number, and their use in training."""
    neighbors = {NEIGHBOR_TYPES[name]: name for name in names if name in NEIGHBOR_TYPES}
    table = _table("Labels", "type", "count", "per frame", "in training")
    for kind, count in inspection.types.items():
        role = f"ignored: neither {neighbors[kind]} nor background" if kind in neighbors else "background"
        table.add_row(kind, str(count), f"{count / inspection.frames:.2f}", "a class" if kind in names else role)
    return table


def objects_table(inspection: Inspection, min_points: int) -> Table:
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


def conventions_table(inspection: Inspection) -> Table:
    """Return a table of the points in the boxes by each convention for yaw and z."""
    title = "Conventions: points in the boxes of the classes as labelled and otherwise; boxes with 10 % more or fewer"
    table = _table(title, "boxes", "points", "more", "fewer")
    for fit in inspection.conventions:
        table.add_row(fit.name, str(fit.points), str(fit.more), str(fit.fewer))
    return table


def sizes_table(inspection: Inspection) -> Table:
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


def matching_table(inspection: Inspection) -> Table:
    """Return a table of the number of positive anchors of each class."""
    title = "Matching: objects to find, by the best anchor that is to find them: positive_iou, only the nearest, none"
    table = _table(title, "class", "objects", "by IoU", "nearest", "none", "anchors per frame", "per object")
    for facts in inspection.classes:
        to_find = facts.overlapped + facts.forced + facts.missed
        shares = (_share(count, to_find) for count in (facts.overlapped, facts.forced, facts.missed))
        per_object = f"{facts.positives / to_find:.1f}" if to_find else "-"
        table.add_row(facts.name, str(to_find), *shares, f"{facts.positives / inspection.frames:.2f}", per_object)
    return table


def scans_table(inspection: Inspection, kind: InputCells, camera_view: bool) -> Table:
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


def recorded_table(found: ScansInspection) -> list[Table | str]:
    """Return what was inspected; for a recording its topics, if there are several, and its times, frames and fields."""
    of_topic = "" if found.topic is None else f", {printable(found.topic)}"
    ranges_text = ", ".join(
        f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", found.ranges, strict=True)
    )
    lines: list[Table | str] = [
        f"{found.path}{of_topic}: {found.inspected} of {found.scans} scans measured",
        f"against {found.model}, which looks in {ranges_text} m",
        *map(printable, found.notes),
    ]
    if len(found.topics) > 1:
        topics = _table("Topics", "topic", "type", "messages")
        for topic in found.topics:
            topics.add_row(printable(topic.name), printable(topic.type), str(topic.messages))
        lines.append(topics)
    facts = []
    if found.times is not None:
        rate = "" if found.times.rate_hz is None else f", {found.times.rate_hz:.3g} scans per second"
        facts.append(f"{found.times.seconds:.1f} s{rate}")
    if found.frame_ids:
        facts.append(f"frame {', '.join(found.frame_ids)}")
    if found.fields:
        facts.append(f"fields {', '.join(found.fields)}")
    return [*lines, *([printable("; ".join(facts))] if facts else [])]


def unlabelled_table(found: ScansInspection) -> Table:
    """Return a table of points, reflectance, ground and ranges of unlabelled scans, beside the training scans'."""
    expected, height = found.expected, found.height
    low, high = expected.points_per_scan
    view = " (a camera's view)" if expected.camera_view else ""
    dark, bright = expected.reflectance_mean
    ground = "-" if expected.ground_z_m is None else f"{expected.ground_z_m[0]:.2f} to {expected.ground_z_m[1]:.2f}"
    trained_m = "-" if expected.sensor_height_m is None else f"{expected.sensor_height_m:.2f}"
    share = None if found.inside_share is None else Spread(*(100 * value for value in found.inside_share))
    table = _table("Scans: 10 % / median / 90 %", "", "found", "expected")
    table.add_row("points", _spread(found.points), f"{low} to {high}{view}")
    table.add_row("points not finite", str(found.not_finite), "0")
    table.add_row("points within the ranges, %", _spread(share, 1), "")
    table.add_row("reflectance as stored", ", ".join(f"0 to {one:g}" for one in found.reflectance_scales) or "none", "")
    table.add_row("mean reflectance as read", _spread(found.reflectance, 3), f"{dark:.3f} to {bright:.3f}")
    table.add_row("ground near the sensor, z, m", _spread(found.ground_z_m, 2), ground)
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


def inspect(
    data: Annotated[
        Path,
        typer.Argument(
            help="Folder of a dataset: KITTI's layout, or with a dataset.yaml (docs/DATA.md); or without labels a "
            "recording (.mcap .db3 .bag .pcap, a rosbag2 folder), a scan or a folder of scans."
        ),
    ],
    *,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            "-c",
            help="Of a dataset: the YAML to train with, or the name of one that ships.",
            rich_help_panel="Input",
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            "--split",
            help="A list in ImageSets/, or training for every scan. Default: data.train_set.",
            rich_help_panel="Input",
        ),
    ] = None,
    frames: Annotated[
        int,
        typer.Option(
            "--frames", "-n", min=1, help="Look at so many frames, evenly spaced.", rich_help_panel="Input", metavar="N"
        ),
    ] = 500,
    bundle: BundleOption = None,
    around: AroundOption = False,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    topic: TopicOption = None,
    propose: Annotated[
        Path | None,
        typer.Option(
            "--propose",
            help="Measure classes, anchors, thresholds and ranges on the labels, and write the config with them to "
            "this YAML; what is inspected is then how well it fits.",
            rich_help_panel="Output",
        ),
    ] = None,
    draw: Annotated[
        int | None,
        typer.Option(
            "--draw",
            min=1,
            help="Also draw so many training frames from above, with their labels, as training sees them: objects "
            "inserted, augmented.",
            rich_help_panel="Output",
            metavar="N",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Folder for the pictures of --draw. Default: inspection.", rich_help_panel="Output"
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Look at a dataset before training: objects, points, sizes and positives per class, ranges, scans.

    Warnings name their remedy. A class that would have no positive anchor at all is an error: exit code 4.

    Scans without labels, files or a recording, are compared with those that a model (--bundle) was trained on: rate,
    gaps, points, reflectance, height of the sensor, share of the points within its ranges. The options of Sensor and
    Recording are for them, as for asca detect; a dataset states how its scans lie.

    Examples:

    asca inspect data/kitti -c asca_pointpillars_kitti --draw 8

    asca inspect data/own -c asca_small_sim --propose own.yaml

    asca inspect drive.mcap --axes y-forward --around
    """
    from asca_pillars.base.errors import ConfigError
    from asca_pillars.scans.recordings.open_recording import is_recording

    of_scans = {
        "--bundle": bundle,
        "--around": around or None,
        "--sensor-height": sensor_height,
        "--axes": None if axes == "x-forward" else axes,
        "--pose": pose,
        "--reflectance-scale": None if reflectance_scale == "auto" else reflectance_scale,
        "--columns": columns,
        "--topic": topic,
    }
    of_labels = {"--split": split, "--propose": propose, "--draw": draw, "--out": out}
    if config is not None:
        if is_recording(data):
            raise ConfigError(f"{data}: is a recording, and --config {config} for datasets with labels; leave it out")
        for name, value in of_scans.items():
            if value is not None:
                raise ConfigError(f"{name}: is for scans without labels, and --config for datasets; leave one out")
        _inspect_dataset(data, config, split=split, frames=frames, propose=propose, draw=draw, out=out, json=json)
        return
    for name, value in of_labels.items():
        if value is not None:
            raise ConfigError(f"{name} {value}: is for a dataset with labels; give --config, too")
    reading = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    _inspect_scans(data, json, topic=topic, bundle=bundle, around=around, reading=reading, frames=frames)


def _inspect_scans(data: Path, json: Path | None, **options: Any) -> None:
    """Print what `inspect_scans` finds; PartialError if some scans cannot be read."""
    from dataclasses import asdict

    from rich.console import Console

    from asca_deploy.inspect_scans import inspect_scans
    from asca_pillars.base.errors import ConfigError, PartialError, printable
    from asca_pillars.base.files import require_writable, write_json
    from asca_pillars.base.own_files import json_object, require_own_file
    from asca_pillars.cli.progress import Bars
    from asca_pillars.data.boxes.box_split import DATASET_FILE

    if (data / DATASET_FILE).is_file() or (data / "training").is_dir():
        raise ConfigError(f"{data}: is a dataset; give --config, or to look at its scans alone their folder")
    report_json = "asca inspect --json", json_object("model", "frame_ids", "inside_share", "findings")
    require_writable(json, *report_json, inputs=(data,))
    console = Console(markup=False, highlight=False)
    with Bars(console, transient=True) as bars:
        found = inspect_scans(data, **options, progress=bars)
    if json is not None:
        require_own_file(json, *report_json)
        height = None if found.height is None else found.height._asdict()
        write_json(json, asdict(found) | {"topics": [topic._asdict() for topic in found.topics], "height": height})
    for part in (*recorded_table(found), unlabelled_table(found)):
        console.print(part, soft_wrap=isinstance(part, str))
    for text in found.findings:
        console.print(f"warning: {printable(text)}", style="yellow", soft_wrap=True)
    if found.problems:
        raise PartialError("; ".join(found.problems))
    if not found.findings:
        console.print("Nothing to warn of.")


def _inspect_dataset(
    data: Path,
    config: Path,
    *,
    split: str | None,
    frames: int,
    propose: Path | None,
    draw: int | None,
    out: Path | None,
    json: Path | None,
) -> None:
    """Print the tables and findings of a dataset; DatasetError if training could learn nothing of it."""
    import dataclasses

    from rich.console import Console

    from asca_pillars.base.errors import ConfigError, DatasetError
    from asca_pillars.base.files import require_writable, write_json
    from asca_pillars.base.own_files import json_object, require_own_file
    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config
    from asca_pillars.data.inspection.findings import findings
    from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
    from asca_pillars.data.inspection.measurements import input_cells
    from asca_pillars.data.inspection.proposal import propose_config
    from asca_pillars.data.open_split import open_split
    from asca_pillars.pictures.training_pictures import draw_frames, require_replaceable_pictures

    report_json = "asca inspect --json", json_object("config", "frames_in_split", "states_mounting", "findings")
    require_writable(json, *report_json)
    if draw is None and out is not None:
        raise ConfigError(f"--out {out} is for the pictures of --draw; give --draw COUNT, too")
    pictures = Path("inspection") if out is None else out
    if draw is not None:
        require_replaceable_pictures(pictures)
    settings = load_config(config)
    console = Console(markup=False, highlight=False)
    frames_of = open_split(data, settings.data.train_set if split is None else split)
    if settings.model.kind == "pillar_refine":
        if propose is not None:
            raise ConfigError(f"--propose {propose}: classes of model.kind pillar_refine are its first stage's")
        require("train")
        from asca_pillars.models.two_stage.first_stage import with_first_stage

        settings = dataclasses.replace(settings, model=with_first_stage(settings.model))
    if propose is not None:
        with Bars(console, transient=True) as bars:
            settings, text = propose_config(frames_of, settings, propose, frames, Reporter(bars))
        console.print(text, soft_wrap=True)
        next_step = f"asca train {propose} --data {frames_of.root} --out runs/own"
        console.print(f"Written to {propose}. Next: {next_step}", soft_wrap=True)
    spec, min_points = settings.model.spec, settings.data.min_points
    view = settings.data.camera_view and frames_of.has_camera
    assigner = settings.model.loss.assigner if settings.model.kind == "pillar" else "overlap"
    with Bars(console, transient=True) as bars:
        inspection = inspect_dataset(
            frames_of, spec, settings.data, assigner=assigner, frames=frames, reporter=Reporter(bars)
        )
    found = findings(inspection, spec, min_points)
    if json is not None:
        report = {"config": settings.name} | dataclasses.asdict(inspection)
        report |= {"findings": [finding._asdict() for finding in found]}
        require_own_file(json, *report_json)
        write_json(json, report)
    console.print(
        f"{data}, split {inspection.split}, against {settings.name}: {inspection.frames} of "
        f"{inspection.frames_in_split} frames{', evenly spaced' if inspection.sampled else ''}; "
        f"{inspection.frames_without_objects} without an object"
    )
    console.print(
        types_table(inspection, spec.class_names),
        objects_table(inspection, min_points),
        sizes_table(inspection),
        sep="\n",
    )
    console.print(conventions_table(inspection))
    console.print(matching_table(inspection), scans_table(inspection, input_cells(spec), view), sep="\n")
    if draw is not None:
        console.print("\n".join(draw_frames(data, frames_of.name, settings, draw, pictures)), soft_wrap=True)
    errors = [finding for finding in found if finding.level == "error"]
    for finding in found:
        if finding not in errors[:1]:  # the first one is the command's error, below all of them
            style = "red" if finding.level == "error" else "yellow"
            console.print(f"{finding.level}: {finding.text}", style=style, soft_wrap=True)
    if errors:
        others = f" ({len(errors) - 1} more above)" if errors[1:] else ""
        raise DatasetError(f"{data}: {errors[0].text}{others}")
    if not found:
        console.print("Nothing to warn of.")
