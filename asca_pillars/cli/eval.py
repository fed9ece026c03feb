"""`asca eval`: evaluation of a model or of predictions against labels, by one of five protocols."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from asca_pillars.cli.options import (
    AroundOption,
    PrecisionOption,
    ProviderOption,
    ThreadsOption,
    read_scores,
)


def evaluate(
    model: Annotated[
        Path | None,
        typer.Argument(help="Bundle (folder, or name of one that ships) or checkpoint (.ckpt). Without it: default."),
    ] = None,
    *,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            "-d",
            help="Dataset whose labels count (KITTI's layout or a dataset.yaml); a model is run on it.",
            rich_help_panel="Input",
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            "--split",
            help="A list of ImageSets/, or training for every frame; with --data. Default: val.",
            rich_help_panel="Input",
        ),
    ] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(
            "--predictions",
            help="Instead of a model: a folder of KITTI text with scores, a file per frame, empty if nothing was "
            "found; for iou and distance the detections.jsonl of asca detect, or such a .csv.",
            rich_help_panel="Input",
        ),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            "--labels",
            help="Folder of KITTI labels for --predictions. Default: those of --data.",
            rich_help_panel="Input",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            help="Predictions of another detector, such as predictions/ of another evaluation: the gallery shows the "
            "frames in which the two differ most, side by side.",
            rich_help_panel="Input",
        ),
    ] = None,
    around: AroundOption = False,
    protocol: Annotated[
        Literal["kitti", "waymo", "iou", "distance", "tracking"] | None,
        typer.Option(
            "--protocol",
            help="kitti: AP and AOS of Car, Pedestrian and Cyclist. waymo: AP and APH of any class by level and range. "
            "iou: AP of any class, 3D and BEV. distance: nuScenes' and Argoverse 2's metrics. "
            "tracking: HOTA, MOTA, identity switches of the tracks that asca detect --track wrote. "
            "Default: kitti; iou for a dataset without a camera.",
            metavar="PROTOCOL",
            rich_help_panel="Metrics",
        ),
    ] = None,
    min_score: Annotated[
        float,
        typer.Option(
            "--min-score",
            min=0,
            max=1,
            help="Lowest score that a model is run with: AP needs the weak detections too.",
            metavar="SCORE",
            rich_help_panel="Metrics",
        ),
    ] = 0.05,
    errors: Annotated[
        bool,
        typer.Option(
            "--errors",
            help="Also analyze the errors, into errors.html, errors.md and errors.json: how boxes are off by view, "
            "distance, occlusion and points, what false detections stand on, pictures of the worst.",
            rich_help_panel="Metrics",
        ),
    ] = False,
    errors_by: Annotated[
        str | None,
        typer.Option(
            "--errors-by",
            help="Rows for parts of the data, too: list, the other lists of ImageSets/ within --split; or a number, "
            "frames whose ids begin with the same so many characters.",
            rich_help_panel="Metrics",
        ),
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(
            "--beside",
            help="errors.json of another evaluation, for the same tables. Repeatable.",
            rich_help_panel="Metrics",
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Folder for report, curves, gallery and the model's predictions.",
            rich_help_panel="Output",
        ),
    ] = Path("evaluation"),
    json: Annotated[
        Path | None, typer.Option("--json", help="Also write the report's JSON to this file.", rich_help_panel="Output")
    ] = None,
    gallery: Annotated[
        int | None,
        typer.Option(
            "--gallery",
            min=0,
            help="Worst frames to draw. Default: 8 if there are scans (--data).",
            metavar="N",
            rich_help_panel="Output",
        ),
    ] = None,
    score: Annotated[
        list[str] | None,
        typer.Option(
            "--score",
            help="VALUE or CLASS=VALUE: score from which on detections count for recall, precision and gallery. "
            "Repeatable for classes. Default: the model's, per class; 0.3 for --predictions.",
            rich_help_panel="Output",
        ),
    ] = None,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
) -> None:
    """Score a model, or finished predictions, by KITTI's protocol: AP and AOS, by distance, recall and precision.

    With --protocol waymo by Waymo's metric: AP and APH at LEVEL_1 and LEVEL_2, everywhere and by range.
    With --protocol iou or distance any class by its boxes in the LiDAR frame, all around; no camera is needed.
    Frames without a prediction file are left out, as by KITTI's own tool, and named in every form of the report.

    Example: asca eval runs/small/checkpoints/last.ckpt --data data/sim
    """
    from rich.console import Console

    from asca_deploy.evaluate import evaluate as run
    from asca_deploy.open_model import RuntimeOptions
    from asca_pillars.cli.progress import Bars

    console = Console(markup=False)
    with Bars(console) as bars:
        done = run(
            model,
            data,
            out,
            split=split,
            protocol=protocol,
            predictions=predictions,
            labels=labels,
            score=read_scores(score),
            min_score=min_score,
            around=around,
            gallery=gallery,
            compare=compare,
            errors=errors,
            errors_by=errors_by,
            beside=beside or (),
            json=json,
            options=RuntimeOptions(provider=provider, precision=precision, threads=threads),
            progress=bars,
            remark=bars.remark,
        )
    done.page.print(console)
    if done.errors is not None:
        done.errors.print(console)
    console.print(f"Written to {out}/", highlight=False)
