"""`asca adapt`: training on scans without labels."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import (
    AxesOption,
    ColumnsOption,
    PoseOption,
    ReflectanceScaleOption,
    SensorHeightOption,
    TopicOption,
    scan_settings,
)
from asca_pillars.cli.train import INTERRUPTED
from asca_pillars.scans.find_scans import SCAN_SUFFIXES


def adapt(
    scans: Annotated[
        Path,
        typer.Argument(
            help=f"Folder of scans ({' '.join(SCAN_SUFFIXES)}), or a recording (.mcap .db3 .bag .pcap, a rosbag2 "
            "folder)."
        ),
    ],
    *,
    frames: Annotated[
        int,
        typer.Option(
            "--frames",
            "-n",
            min=10,
            help="At most so many scans, evenly spaced, are learnt from.",
            rich_help_panel="Input",
        ),
    ] = 250,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    topic: TopicOption = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder of the bundle; the training is in OUT_run.", rich_help_panel="Output"),
    ],
) -> None:
    """Train the model that ships on scans of your own, without labels.

    The boxes that `accurate` finds ahead stand for labels, and `default` learns them. It then finds more on the same
    streets, and loses little on others: docs/guide/fine_tuning.md has figures. 250 scans take some ten minutes on two
    cores. After Ctrl-C the same command resumes.

    Examples:

    asca adapt my_scans/ -o my_bundle

    asca detect my_scans/ --bundle my_bundle
    """
    require("train")
    import logging

    from rich.console import Console

    from asca_export.adapt import adapt as run
    from asca_export.adapt import run_folder
    from asca_pillars.cli.progress import Bars

    reading = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # what is odd about the scans is said once, as remarks
    console = Console(markup=False, highlight=False)
    with console.status("Loading PyTorch"):
        from asca_pillars.cli.run_progress import RunProgress
        from asca_pillars.training.callbacks import TrainingInterruptedError
    try:
        with Bars(console, transient=True) as bars:
            bar = RunProgress(console)
            result = run(
                scans,
                out,
                frames=frames,
                topic=topic,
                reading=reading,
                progress=bars,
                remark=bars.remark,
                bar=bar,
                step=bars.step,
            )
    except TrainingInterruptedError as stop:
        console.print(str(stop))
        raise typer.Exit(INTERRUPTED) from None
    boxes = ", ".join(f"{name} {count}" for name, count in result.boxes.items())
    console.print(f"Trained on {result.train} scans, validated on {result.val}; boxes: {boxes}", soft_wrap=True)
    console.print(f"Written: {out}/; {run_folder(out)}/ is not needed any more", soft_wrap=True)
    console.print(f"Next: asca detect {scans} --bundle {out}", soft_wrap=True)
