"""`asca import` and `asca import-weights`."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import (
    AxesOption,
    ColumnsOption,
    OverridesOption,
    PoseOption,
    ReflectanceScaleOption,
    SensorHeightOption,
    scan_settings,
)
from asca_pillars.data.importing.formats import FORMATS


def import_dataset(
    source: Annotated[Path, typer.Argument(help="The other dataset's folder; for boxes the file or folder of labels.")],
    out: Annotated[Path, typer.Argument(help="Folder for dataset.yaml, labels.jsonl and ImageSets/.")],
    *,
    source_format: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="FORMAT",
            help=" ".join(f"{name}: {form.help}." for name, form in FORMATS.items()),
            rich_help_panel="Input",
        ),
    ] = "boxes",
    scans: Annotated[
        Path | None,
        typer.Option("--scans", help="Folder of the scans; with boxes and labels of tools.", rich_help_panel="Input"),
    ] = None,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(
            "--rename",
            help="OLD=NEW, a class by another name; several may get one name. Repeatable.",
            rich_help_panel="Output",
        ),
    ] = None,
    val_share: Annotated[
        float,
        typer.Option(
            "--val-share",
            min=0.01,
            max=0.9,
            help="Share of the recordings in ImageSets/val.txt.",
            metavar="SHARE",
            rich_help_panel="Output",
        ),
    ] = 0.2,
) -> None:
    """Make a dataset of scans with boxes that train, inspect, prepare and eval read; no camera is needed.

    The scans are referred to, not copied. Whole recordings go to one list, because neighboring scans look alike. How
    the scans lie (--axes, --sensor-height and so on) is written to dataset.yaml, where every command reads it; of
    published datasets it is known.

    Examples:

    asca import boxes.csv data/own --scans recordings/

    asca import results/detections.jsonl data/own --scans sweeps/ --axes y-forward --sensor-height auto

    asca import labels/ data/own --from labelcloud --scans recordings/
    """
    from rich.console import Console

    from asca_pillars.base.errors import ConfigError
    from asca_pillars.base.installation import require
    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars, print_remark
    from asca_pillars.data.importing.imported import drop_unwritable, rename_types, require_own_dataset, write_imported
    from asca_pillars.scans.scan_settings import ScanSettings

    if source_format not in FORMATS:
        raise ConfigError(f"--from {source_format}: no such format; available: {', '.join(FORMATS)}")
    form = FORMATS[source_format]
    if (scans is not None) != form.scans_elsewhere:
        those = ", ".join(name for name, layout in FORMATS.items() if layout.scans_elsewhere)
        raise ConfigError(f"--scans FOLDER is for --from {those}, which need it; other formats say where scans are")
    if not source.exists():
        raise ConfigError(f"{source}: no such file or folder; check the path")
    if wrong := [text for text in rename or () if not all(text.partition("="))]:
        raise ConfigError(f"--rename {wrong[0]}: write OLD=NEW, such as --rename REGULAR_VEHICLE=Car")
    require_own_dataset(out, source)
    if form.extra is not None:
        require(form.extra)
    settings = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    if scans is None and settings != ScanSettings():
        raise ConfigError(
            f"--from {source_format} defines the axes of its scans; leave out --axes, --columns and the like"
        )
    console = Console(markup=False, highlight=False)
    with Bars(console, transient=True) as bars:
        imported = form.read(source, out=out, scans=scans, settings=settings, reporter=Reporter(bars))
    names = dict(text.split("=", 1) for text in rename or ())
    imported = rename_types(drop_unwritable(imported), names)
    counts = write_imported(out, imported, val_share)
    boxes = ", ".join(f"{name} {count}" for name, count in counts.boxes.items()) or "none"
    console.print(f"{out}: {counts.train} frames to train on, {counts.val} to validate; boxes: {boxes}", soft_wrap=True)
    for line in (*imported.skipped.lines(), *([counts.doubt] if counts.doubt else [])):
        print_remark(console, line)
    console.print(f"Next: asca inspect {out} -c asca_small_sim --propose own.yaml", soft_wrap=True)


def import_weights(
    file: Annotated[
        Path, typer.Argument(help="Checkpoint of OpenPCDet's or mmdetection3d's PointPillars or PV-RCNN (.pth).")
    ],
    *,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            "-c",
            help="YAML of the model, or the name of one that ships. Default: the published model on KITTI "
            "(openpcdet_pointpillars_kitti, pv_rcnn_kitti, mmdetection3d_pointpillars_kitti, "
            "mmdetection3d_pv_rcnn_kitti). Other ranges, classes or widths need their own.",
            rich_help_panel="Input",
        ),
    ] = None,
    override: OverridesOption = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Checkpoint to write, such as pointpillars.ckpt.", rich_help_panel="Output"),
    ],
) -> None:
    """Import weights of OpenPCDet or mmdetection3d 1.x.

    Every array of the file finds its place, or the command names it and stops. The file is read as data alone, nothing
    in it is executed. What is written is a checkpoint as `asca train` writes it: `asca export` makes a bundle of it,
    `asca eval` judges it, `asca train --init` starts from it.

    Examples:

    asca import-weights pointpillar.pth -o pointpillars.ckpt

    asca import-weights hv_pointpillars_secfpn_6x8_160e_kitti-3d-3class.pth -o pointpillars.ckpt

    asca export pointpillars.ckpt -o pointpillars --scans data/kitti/training/velodyne
    """
    require("train")
    from rich.console import Console

    from asca_pillars.config.tree import load_config
    from asca_pillars.models.checkpoint_file import require_new_checkpoint
    from asca_pillars.models.openpcdet.import_checkpoint import published_config, read_foreign, write_imported

    require_new_checkpoint(out)
    weights = read_foreign(file)
    name = str(config or published_config(weights))
    count = write_imported(weights, load_config(name, override or []), out)
    console = Console(markup=False, soft_wrap=True)
    console.print(f"Imported: {count} arrays of {file}, as {name}")
    console.print(f"Written: {out}")
