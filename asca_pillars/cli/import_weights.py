"""`asca import-weights`: conversion of an OpenPCDet or mmdetection3d checkpoint to one that `asca` exports."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import OverridesOption


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
