"""`asca eval`: a model or finished predictions against labels, by one of five protocols."""

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
        typer.Argument(
            help="Bundle (folder, or name of one that ships) or checkpoint (.ckpt). Default: asca_sim_int8."
        ),
    ] = None,
    *,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data", "-d", help="Dataset whose labels count (KITTI's layout or a dataset.yaml); a model is run on it."
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option("--split", help="A list of ImageSets/, or training for every frame; with --data. Default: val."),
    ] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(
            "--predictions",
            help="Instead of a model: a folder of KITTI text with scores, a file per frame, empty if nothing was "
            "found; for iou and distance the detections.jsonl of asca detect, or such a .csv.",
        ),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option("--labels", help="Folder of KITTI labels for --predictions. Default: those of --data."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for report, curves, gallery and the model's predictions.")
    ] = Path("evaluation"),
    json: Annotated[Path | None, typer.Option("--json", help="Also write the report's JSON to this file.")] = None,
    gallery: Annotated[
        int | None,
        typer.Option("--gallery", min=0, help="Worst frames to draw. Default: 8 if there are scans (--data)."),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            help="Predictions of another detector, such as predictions/ of another evaluation: the gallery shows the "
            "frames in which the two differ most, side by side.",
        ),
    ] = None,
    score: Annotated[
        list[str] | None,
        typer.Option(
            "--score",
            help="VALUE or CLASS=VALUE: score from which on detections count for recall, precision and gallery. "
            "Repeatable for classes. Default: the model's, per class; 0.3 for --predictions.",
        ),
    ] = None,
    min_score: Annotated[
        float,
        typer.Option(
            "--min-score", min=0, max=1, help="Lowest score that a model is run with: AP needs the weak detections too."
        ),
    ] = 0.05,
    protocol: Annotated[
        Literal["kitti", "waymo", "iou", "distance", "tracking"] | None,
        typer.Option(
            "--protocol",
            help="kitti: AP and AOS of Car, Pedestrian and Cyclist. waymo: AP and APH of any class by level and range. "
            "iou: AP of any class, 3D and BEV. distance: nuScenes' and Argoverse 2's metrics. "
            "tracking: HOTA, MOTA, identity switches of the tracks that asca detect --track wrote. "
            "Default: kitti; iou for a dataset without a camera.",
        ),
    ] = None,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
    around: AroundOption = False,
    errors: Annotated[
        bool,
        typer.Option(
            "--errors",
            help="Also analyze the errors, into errors.html, errors.md and errors.json: how boxes are off by view, "
            "distance, occlusion and points, what false detections stand on, pictures of the worst.",
        ),
    ] = False,
    errors_by: Annotated[
        str | None,
        typer.Option(
            "--errors-by",
            help="Rows for parts of the data, too: list, the other lists of ImageSets/ within --split; or a number, "
            "frames whose ids begin with the same so many characters.",
        ),
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option("--beside", help="errors.json of another evaluation, for the same tables. Repeatable."),
    ] = None,
) -> None:
    """Score a model, or finished predictions, by KITTI's protocol: AP and AOS, by distance, recall and precision.

    With --protocol waymo by Waymo's metric: AP and APH at LEVEL_1 and LEVEL_2, everywhere and by range.
    With --protocol iou or distance any class by its boxes in the LiDAR frame, all around; no camera is needed.
    Frames without a prediction file are left out, as by KITTI's own tool, and named in every form of the report.

    Example: asca eval runs/small/checkpoints/last.ckpt --data data/sim
    """
    from rich.console import Console

    from asca_deploy.open_model import RuntimeOptions, open_model
    from asca_pillars.cli import eval_steps as steps
    from asca_pillars.cli.eval_arguments import EvalArguments, check_arguments, default_protocol
    from asca_pillars.cli.eval_errors import prepare_errors, who_predicted
    from asca_pillars.cli.eval_files import claim
    from asca_pillars.cli.eval_gallery import draw_gallery
    from asca_pillars.data.kitti import KittiSplit
    from asca_pillars.evaluation.predictions import read_predictions, read_truth

    console = Console(markup=False)
    protocol = protocol or default_protocol(data)
    options = RuntimeOptions(bundle=model, provider=provider, precision=precision, threads=threads)
    scores = read_scores(score)
    sources = model, data, split, predictions, labels
    given = EvalArguments(
        protocol, *sources, out, gallery, compare, scores, min_score, around, errors, errors_by, beside
    )
    check_arguments(given, options)
    split = "val" if split is None else split
    if protocol == "tracking":
        from asca_pillars.cli.eval_tracks import evaluate_tracks

        assert data is not None and predictions is not None, "checked with the arguments"
        evaluate_tracks(data, split, predictions, out, json, console)
        return
    if protocol in ("iou", "distance"):
        from asca_pillars.cli.eval_boxes import BoxTask, evaluate_boxes

        assert data is not None, "checked with the arguments"
        box_task = BoxTask(protocol, data, split, out, json, scores, min_score, around, errors, errors_by, beside)
        evaluate_boxes(box_task, options, predictions, console)
        return
    inputs = (model, data, labels, compare, *(beside or ()))
    claim("report" if protocol == "kitti" else protocol, out, json, predictions, inputs)
    frames_of = None if data is None else KittiSplit(data, split)
    if labels is None:
        assert frames_of is not None, "checked with the arguments"
        labels = frames_of.folder / "label_2"
    truth = read_truth(labels, None if frames_of is None else frames_of.frame_ids)
    analysis = None
    if predictions is not None:
        if errors:
            assert frames_of is not None, "checked with the arguments"
            analysis = prepare_errors(who_predicted(predictions), frames_of, errors_by, beside)
        task = steps.text_task(predictions, labels, frames_of, scores)
    else:
        assert frames_of is not None, "checked with the arguments"
        opened = open_model(options, min_score)
        if errors:
            analysis = prepare_errors(opened.name, frames_of, errors_by, beside)
        fixed = steps.kitti_scores(opened, scores, min_score) if protocol == "kitti" else {}
        task = steps.run_model(opened, frames_of, labels, fixed, out, console)
    frames = read_predictions(task.predictions, truth, labels, console=console)
    steps.warn_of_degrees_in_text(console, frames)
    if protocol == "waymo":
        steps.report_waymo(task, frames, out, json, console)
    else:
        steps.check_classes(task, frames)
        steps.report_kitti(task, frames, out, json, console)
        draw_gallery(task, frames, out, gallery, compare, console)
        if analysis is not None:
            steps.analyze_errors(analysis, task, frames, out, console)
    console.print(f"Written to {out}/", highlight=False)
