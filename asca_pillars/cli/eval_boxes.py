"""The steps of `asca eval --protocol iou` and `distance`: any class, boxes in the LiDAR frame, no camera."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from asca_deploy.open_model import RuntimeOptions, open_model
from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import atomic_directory, write_json
from asca_pillars.base.system import describe_environment
from asca_pillars.cli.eval_errors import prepare_errors, report_errors, who_predicted
from asca_pillars.cli.eval_files import MADE_BY, PREDICTIONS_FOLDER, claim, write_report
from asca_pillars.cli.eval_steps import TEXT_SCORE, model_scores, warn_of_degrees, warn_of_unlike_scans
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import detector_scope
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.evaluation.boxes.box_predictions import BoxFrames, read_box_predictions, write_box_predictions
from asca_pillars.evaluation.boxes.box_report import BoxProtocol, box_json, box_notes, box_report, box_tables
from asca_pillars.evaluation.boxes.iou_metrics import fixed_scores
from asca_pillars.evaluation.errors.error_frames import BoxErrorFrames
from asca_pillars.evaluation.model import Model, scores_by_class
from asca_pillars.evaluation.report_page import ReportPage

PREDICTIONS = "detections.jsonl"


@dataclass(frozen=True)
class BoxTask:
    """What is evaluated, how, and where the report goes; the options of `asca eval` by the same names."""

    protocol: BoxProtocol
    data: Path
    split: str
    out: Path
    json: Path | None
    score: ScoreThresholds | None
    min_score: float
    around: bool
    errors: bool
    errors_by: str | None
    beside: list[Path] | None


def evaluate_boxes(task: BoxTask, options: RuntimeOptions, predictions: Path | None, console: Console) -> None:
    """Evaluate by IoU or by distance; print and write the tables, the JSON, and the model's predictions."""
    claim(task.protocol, task.out, task.json, predictions, (options.bundle, task.data, *(task.beside or ())))
    split = open_split(task.data, task.split)
    about: dict[str, Any] = {"data": str(task.data), "split": task.split}
    if task.around and isinstance(split, BoxSplit) and split.has_camera:
        raise ConfigError(f"--around: {task.data} has labels within an angle ahead alone; leave it out")
    if predictions is None:
        model = open_model(options, task.min_score, sensor_height_m=split.mounting.sensor_height_m, around=task.around)
        scores = model_scores(model, task.score, task.min_score)
        analysis = prepare_errors(model.name, split, task.errors_by, task.beside) if task.errors else None
        frames = _run(model, split, task, console)
        class_names = model.spec.class_names
        subject, about = f"{model.name} on {task.data}, {task.split}", about | {"model": model.about}
    else:
        analysis = (
            prepare_errors(who_predicted(predictions), split, task.errors_by, task.beside) if task.errors else None
        )
        frames = read_box_predictions(predictions, split, console=console)
        class_names = tuple(sorted({kind for frame in frames.frames for kind in frame.found_types}))
        scores = scores_by_class(task.score, dict.fromkeys(class_names, TEXT_SCORE))
        subject, about = f"{predictions} against {task.data}", about | {"predictions": str(predictions)}
    _require_common_class(frames, class_names, task.data)
    level = split.mounting.level.inverse  # yaws as files state them
    warn_of_degrees(
        console,
        labels=[split.label_yaws(frame.frame_id) for frame in frames.frames],
        predictions=[level.boxes(frame.found)[:, 6] for frame in frames.frames],
    )
    about["environment"] = describe_environment()
    at_score = fixed_scores(frames.frames, class_names, scores)
    report = box_report(subject, task.protocol, frames, class_names, at_score, about)
    page = ReportPage(report.title, box_tables(report), box_notes(report))
    scored = task.out / "predictions" if predictions is None else predictions
    write_report(task.protocol, page, box_json(report), task.out, task.json, scored, console)
    if analysis is not None:
        labelled = {kind for frame in frames.frames for kind in frame.object_types}
        found = {name: score for name, score in scores.items() if name in labelled}
        read = BoxErrorFrames(split, frames.frames)
        report_errors(analysis, read, found, subject, about, task.out, console)
    console.print(f"Written to {task.out}/", highlight=False)


def _run(model: Model, split: LabeledSplit, task: BoxTask, console: Console) -> BoxFrames:
    """Run the model and write what it finds: what is scored is read from there, so that it can be scored again."""
    with atomic_directory(task.out / "predictions", *PREDICTIONS_FOLDER) as folder:
        camera_view = split.has_camera and model.camera_view
        write_box_predictions(
            folder / PREDICTIONS,
            split,
            model.detect,
            scope=detector_scope(model.spec, around=task.around),
            camera_view=camera_view,
            console=console,
        )
        about = {"model": model.about, "data": str(split.root), "split": split.name, "files": [PREDICTIONS]}
        write_json(folder / MADE_BY, about)
    warn_of_unlike_scans(model, len(split.frame_ids), console)
    return read_box_predictions(task.out / "predictions" / PREDICTIONS, split, console=console)


def _require_common_class(frames: BoxFrames, class_names: tuple[str, ...], data: Path) -> None:
    labelled = sorted({kind for frame in frames.frames for kind in frame.object_types})
    if not set(labelled) & set(class_names):
        raise DatasetError(
            f"{data}: labels are of {', '.join(labelled) or 'nothing'}, predictions of "
            f"{', '.join(class_names) or 'nothing'}: no class in common; name them alike"
        )
