"""`asca import`: labels of other datasets as a dataset with boxes in the LiDAR frame; scans stay where they are."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from asca_pillars.cli.options import (
    AxesOption,
    ColumnsOption,
    PoseOption,
    ReflectanceScaleOption,
    SensorHeightOption,
    scan_settings,
)


def import_dataset(
    source: Annotated[Path, typer.Argument(help="The other dataset's folder; for boxes the file or folder of labels.")],
    out: Annotated[Path, typer.Argument(help="Folder for dataset.yaml, labels.jsonl and ImageSets/.")],
    *,
    source_format: Annotated[
        Literal["boxes", "argoverse2", "nuscenes", "waymo", "kitti-raw", "kitti-tracking"],
        typer.Option(
            "--from",
            help="boxes: .csv or .jsonl for all scans, or a folder with a .csv or .json for each (docs/DATA.md). "
            "argoverse2: a folder of logs. nuscenes: the folder with samples/ and v1.0-*/. waymo: the folder with "
            "lidar/, lidar_box/ and lidar_calibration/ (parquet). kitti-raw: a folder of drives with their tracklets. "
            "kitti-tracking: the folder with training/.",
        ),
    ] = "boxes",
    scans: Annotated[Path | None, typer.Option("--scans", help="Folder of the scans; with --from boxes.")] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option("--rename", help="OLD=NEW, a class by another name; several may get one name. Repeatable."),
    ] = None,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    val_share: Annotated[
        float, typer.Option("--val-share", min=0.01, max=0.9, help="Share of the recordings in ImageSets/val.txt.")
    ] = 0.2,
) -> None:
    """Make a dataset of scans with boxes that train, inspect, prepare and eval read; no camera is needed.

    The scans are referred to, not copied. Whole recordings go to one list, because neighboring scans look alike. How
    the scans lie (--axes, --sensor-height and so on) is written to dataset.yaml, where every command reads it; of
    published datasets it is known.

    Examples:

    asca import boxes.csv data/own --scans recordings/

    asca import results/detections.jsonl data/own --scans sweeps/ --axes y-forward --sensor-height auto
    """
    from rich.console import Console

    from asca_pillars.base.errors import ConfigError, printable
    from asca_pillars.base.extras import require
    from asca_pillars.data.importing.argoverse2 import read_argoverse2
    from asca_pillars.data.importing.box_files import read_box_files
    from asca_pillars.data.importing.imported import Importer, renamed, require_own_dataset, usable, write_imported
    from asca_pillars.data.importing.kitti_raw import read_kitti_raw
    from asca_pillars.data.importing.kitti_tracking import read_kitti_tracking
    from asca_pillars.data.importing.nuscenes import read_nuscenes
    from asca_pillars.data.importing.waymo_parquet import read_waymo
    from asca_pillars.scans.scan_settings import ScanSettings

    if (scans is not None) != (source_format == "boxes"):
        raise ConfigError("--scans FOLDER goes with --from boxes, and only with it: other formats say where scans are")
    if not source.exists():
        raise ConfigError(f"{source}: no such file or folder; check the path")
    if wrong := [text for text in rename or () if not all(text.partition("="))]:
        raise ConfigError(f"--rename {wrong[0]}: write OLD=NEW, such as --rename REGULAR_VEHICLE=Car")
    require_own_dataset(out, source)
    if source_format == "argoverse2":
        require("import")
    importers: dict[str, Importer] = {
        "argoverse2": read_argoverse2,
        "nuscenes": read_nuscenes,
        "kitti-raw": read_kitti_raw,
        "kitti-tracking": read_kitti_tracking,
    }
    settings = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    if scans is not None:
        imported = read_box_files(source, scans, settings)
    elif settings != ScanSettings():
        raise ConfigError(f"--from {source_format} knows how its scans lie: leave --axes, --columns and the like out")
    elif source_format == "waymo":
        require("import")
        imported = read_waymo(source, out)
    else:
        imported = importers[source_format](source)
    names = dict(text.split("=", 1) for text in rename or ())
    imported = renamed(usable(imported), names)
    counts = write_imported(out, imported, val_share)
    boxes = ", ".join(f"{name} {count}" for name, count in counts.boxes.items()) or "none"
    console = Console(markup=False, highlight=False)
    console.print(f"{out}: {counts.train} frames to train on, {counts.val} to validate; boxes: {boxes}", soft_wrap=True)
    for line in (*imported.left_out.lines(), *([counts.doubt] if counts.doubt else [])):
        console.print(printable(line), style="yellow", soft_wrap=True)
    console.print(f"Next: asca inspect {out} -c asca_small_sim --propose own.yaml", soft_wrap=True)
