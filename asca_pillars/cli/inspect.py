"""`asca inspect`: inspection of a dataset before training, or of scans without labels before detection."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import (
    AroundOption,
    AxesOption,
    BundleOption,
    ColumnsOption,
    JsonOption,
    OverridesOption,
    PoseOption,
    ReflectanceScaleOption,
    SensorHeightOption,
    TopicOption,
    scan_settings,
)


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
    override: OverridesOption = None,
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
    from asca_pillars.scans.recordings.recorded_scans import is_recording

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
    of_labels = {
        "--set": " ".join(override or ()) or None,
        "--split": split,
        "--propose": propose,
        "--draw": draw,
        "--out": out,
    }
    if config is not None:
        if is_recording(data):
            raise ConfigError(f"{data}: is a recording, and --config {config} for datasets with labels; leave it out")
        for name, value in of_scans.items():
            if value is not None:
                raise ConfigError(f"{name}: is for scans without labels, and --config for datasets; leave one out")
        _inspect_dataset(
            data, config, override or (), split=split, frames=frames, propose=propose, draw=draw, out=out, json=json
        )
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
    from asca_pillars.cli import inspect_tables as show
    from asca_pillars.cli.progress import Bars
    from asca_pillars.data.boxes.box_split import DATASET_FILE

    if (data / DATASET_FILE).is_file() or (data / "training").is_dir():
        raise ConfigError(f"{data}: is a dataset; give --config, or to look at its scans alone their folder")
    report_json = "asca inspect --json", json_object("model", "frame_ids", "inside_share", "findings")
    require_writable(json, *report_json, inputs=(data,))
    console = Console(markup=False, highlight=False)
    with Bars(console, transient=True) as bars:
        inspection = inspect_scans(data, **options, progress=bars)
    if json is not None:
        require_own_file(json, *report_json)
        height = None if inspection.height is None else inspection.height._asdict()
        write_json(
            json, asdict(inspection) | {"topics": [topic._asdict() for topic in inspection.topics], "height": height}
        )
    for part in (*show.recorded(inspection), show.unlabelled(inspection)):
        console.print(part, soft_wrap=isinstance(part, str))
    for text in inspection.findings:
        console.print(f"warning: {printable(text)}", style="yellow", soft_wrap=True)
    if inspection.problems:
        raise PartialError("; ".join(inspection.problems))
    if not inspection.findings:
        console.print("Nothing to warn of.")


def _inspect_dataset(
    data: Path,
    config: Path,
    override: Sequence[str],
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
    from asca_pillars.cli import inspect_tables as show
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config
    from asca_pillars.data.inspection.findings import findings, propose_config
    from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
    from asca_pillars.data.inspection.measurements import input_cells
    from asca_pillars.data.open_split import open_split
    from asca_pillars.pictures.training_pictures import draw_frames, require_replaceable_pictures

    report_json = "asca inspect --json", json_object("config", "frames_in_split", "states_mounting", "findings")
    require_writable(json, *report_json)
    if draw is None and out is not None:
        raise ConfigError(f"--out {out} is for the pictures of --draw; give --draw COUNT, too")
    pictures = Path("inspection") if out is None else out
    if draw is not None:
        require_replaceable_pictures(pictures)
    settings = load_config(config, override)
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
    problems = findings(inspection, spec, min_points)
    if json is not None:
        report = {"config": settings.name} | dataclasses.asdict(inspection)
        report |= {"findings": [finding._asdict() for finding in problems]}
        require_own_file(json, *report_json)
        write_json(json, report)
    console.print(
        f"{data}, split {inspection.split}, against {settings.name}: {inspection.frames} of "
        f"{inspection.frames_in_split} frames{', evenly spaced' if inspection.sampled else ''}; "
        f"{inspection.frames_without_objects} without an object"
    )
    console.print(
        show.types(inspection, spec.class_names), show.objects(inspection, min_points), show.sizes(inspection), sep="\n"
    )
    console.print(show.conventions(inspection))
    console.print(show.matching(inspection), show.scans(inspection, input_cells(spec), view), sep="\n")
    if draw is not None:
        console.print("\n".join(draw_frames(data, frames_of.name, settings, draw, pictures)), soft_wrap=True)
    errors = [finding for finding in problems if finding.level == "error"]
    for finding in problems:
        if finding not in errors[:1]:  # the first one is the command's error, below all of them
            style = "red" if finding.level == "error" else "yellow"
            console.print(f"{finding.level}: {finding.text}", style=style, soft_wrap=True)
    if errors:
        others = f" ({len(errors) - 1} more above)" if errors[1:] else ""
        raise DatasetError(f"{data}: {errors[0].text}{others}")
    if not problems:
        console.print("Nothing to warn of.")
