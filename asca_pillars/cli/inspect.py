"""`asca inspect`: what a dataset holds and whether a configuration fits it, before hours of training."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.extras import require
from asca_pillars.cli.options import JsonOption


def inspect(
    data: Annotated[
        Path, typer.Argument(help="Folder of a dataset: KITTI's layout, or with a dataset.yaml (docs/DATA.md).")
    ],
    *,
    config: Annotated[Path, typer.Option("--config", "-c", help="YAML to train with, or the name of one that ships.")],
    split: Annotated[
        str | None,
        typer.Option("--split", help="A list in ImageSets/, or training for every scan. Default: data.train_set."),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", "-n", min=1, help="Look at so many frames, evenly spaced.")] = 500,
    propose: Annotated[
        Path | None,
        typer.Option(
            "--propose",
            help="Measure classes, anchors, thresholds and ranges on the labels, and write the config with them to "
            "this YAML; what is inspected is then how well it fits.",
        ),
    ] = None,
    draw: Annotated[
        int | None,
        typer.Option(
            "--draw",
            min=1,
            help="Also draw so many training frames from above, with their labels, as training sees them: objects "
            "inserted, augmented.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the pictures of --draw. Default: inspection.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Look at a dataset before training: objects, points, sizes and positives per class, ranges, scans.

    Warnings name their remedy. A class that would have no positive anchor at all is an error: exit code 4.

    Examples:

    asca inspect data/kitti -c asca_pointpillars_kitti --draw 8

    asca inspect data/own -c asca_small_sim --propose own.yaml
    """
    import dataclasses

    from rich.console import Console

    from asca_pillars.base.errors import ConfigError, DatasetError
    from asca_pillars.base.files import write_json
    from asca_pillars.base.own_files import json_object, require_own_file
    from asca_pillars.base.writable_file import require_writable
    from asca_pillars.cli import inspect_tables as show
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
        settings, text = propose_config(frames_of, settings, propose, frames)
        console.print(text, soft_wrap=True)
        next_step = f"asca train {propose} --data {frames_of.root} --out runs/own"
        console.print(f"Written to {propose}. Next: {next_step}", soft_wrap=True)
    spec, min_points = settings.model.spec, settings.data.min_points
    view = settings.data.camera_view and frames_of.has_camera
    assigner = settings.model.loss.assigner if settings.model.kind == "pillar" else "overlap"
    inspection = inspect_dataset(frames_of, spec, settings.data, assigner=assigner, frames=frames, progress=True)
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
        show.types(inspection, spec.class_names), show.objects(inspection, min_points), show.sizes(inspection), sep="\n"
    )
    console.print(show.conventions(inspection))
    console.print(show.matching(inspection), show.scans(inspection, input_cells(spec), view), sep="\n")
    if draw is not None:
        console.print("\n".join(draw_frames(data, frames_of.name, settings, draw, pictures)), soft_wrap=True)
    errors = [finding for finding in found if finding.level == "error"]
    for finding in found:
        if finding not in errors[:1]:  # the first one is what the command fails with, below all of them
            style = "red" if finding.level == "error" else "yellow"
            console.print(f"{finding.level}: {finding.text}", style=style, soft_wrap=True)
    if errors:
        others = f" ({len(errors) - 1} more above)" if errors[1:] else ""
        raise DatasetError(f"{data}: {errors[0].text}{others}")
    if not found:
        console.print("Nothing to warn of.")
