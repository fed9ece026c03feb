"""Evaluation by IoU or center distance: any class, boxes in the LiDAR frame, no camera."""

from pathlib import Path
from typing import Any

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import atomic_directory, write_json
from asca_pillars.base.progress import Reporter
from asca_pillars.base.system import describe_environment
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import detector_scope
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.evaluation.arguments import (
    Evaluation,
    EvaluationTask,
    Model,
    OpenModel,
    model_scores,
    scores_by_class,
)
from asca_pillars.evaluation.boxes.box_predictions import BoxFrames, read_box_predictions, write_box_predictions
from asca_pillars.evaluation.boxes.box_report import BoxProtocol, box_json, box_notes, box_report, box_tables
from asca_pillars.evaluation.boxes.iou_metrics import fixed_scores
from asca_pillars.evaluation.errors.error_frames import BoxErrorFrames
from asca_pillars.evaluation.kitti_evaluation import (
    TEXT_SCORE,
    predictions_name,
    prepare_errors,
    report_errors,
    warn_of_degrees,
    warn_of_unusual_scans,
)
from asca_pillars.evaluation.report_files import MADE_BY, PREDICTIONS_FOLDER, check_output_folder, write_report
from asca_pillars.evaluation.report_page import ReportPage

PREDICTIONS = "detections.jsonl"


def evaluate_boxes(
    task: EvaluationTask, protocol: BoxProtocol, open_model: OpenModel, reporter: Reporter
) -> Evaluation:
    """Evaluate by IoU or by distance; write the tables, the JSON, and the model's predictions."""
    data, predictions = task.data, task.predictions
    assert data is not None, "checked with the arguments"
    check_output_folder(protocol, task.out, task.json, predictions, (task.model, data, *task.beside))
    split = open_split(data, task.split_name)
    about: dict[str, Any] = {"data": str(data), "split": task.split_name}
    if task.around and isinstance(split, BoxSplit) and split.has_camera:
        raise ConfigError(f"--around: {data} has labels within an angle ahead alone; leave it out")
    if predictions is None:
        model = open_model(split.mounting.sensor_height_m)
        scores = model_scores(model, task.score, task.min_score)
        analysis = prepare_errors(model.name, split, task.errors_by, task.beside) if task.errors else None
        frames = _run(model, split, task, reporter)
        class_names = model.spec.class_names
        subject, about = f"{model.name} on {data}, {task.split_name}", about | {"model": model.about}
    else:
        model_name = predictions_name(predictions)
        analysis = prepare_errors(model_name, split, task.errors_by, task.beside) if task.errors else None
        frames = read_box_predictions(predictions, split, reporter=reporter)
        class_names = tuple(sorted({kind for frame in frames.frames for kind in frame.detection_types}))
        scores = scores_by_class(task.score, dict.fromkeys(class_names, TEXT_SCORE))
        subject, about = f"{predictions} against {data}", about | {"predictions": str(predictions)}
    _require_common_class(frames, class_names, data)
    level = split.mounting.level.inverse  # yaws as stated in files
    warn_of_degrees(
        reporter,
        labels=[split.label_yaws(frame.frame_id) for frame in frames.frames],
        predictions=[level.boxes(frame.detections)[:, 6] for frame in frames.frames],
    )
    about["environment"] = describe_environment()
    at_score = fixed_scores(frames.frames, class_names, scores)
    report = box_report(subject, protocol, frames, class_names, at_score, about)
    page, content = ReportPage(report.title, box_tables(report), box_notes(report)), box_json(report)
    scored = task.out / "predictions" if predictions is None else predictions
    write_report(protocol, page, content, task.out, task.json, scored)
    errors = None
    if analysis is not None:
        labelled = {kind for frame in frames.frames for kind in frame.object_types}
        labelled_scores = {name: score for name, score in scores.items() if name in labelled}
        read = BoxErrorFrames(split, frames.frames)
        errors = report_errors(analysis, read, labelled_scores, subject, about, task.out, reporter)
    return Evaluation(protocol, content, page, errors, task.out)


def _run(model: Model, split: LabeledSplit, task: EvaluationTask, reporter: Reporter) -> BoxFrames:
    """Run the model and write its predictions: these files are evaluated, so that they can be evaluated again."""
    with atomic_directory(task.out / "predictions", *PREDICTIONS_FOLDER) as folder:
        camera_view = split.has_camera and model.camera_view
        write_box_predictions(
            folder / PREDICTIONS,
            split,
            model.detect,
            scope=detector_scope(model.spec, around=task.around),
            camera_view=camera_view,
            reporter=reporter,
        )
        about = {"model": model.about, "data": str(split.root), "split": split.name, "files": [PREDICTIONS]}
        write_json(folder / MADE_BY, about)
    warn_of_unusual_scans(model, len(split.frame_ids), reporter)
    return read_box_predictions(task.out / "predictions" / PREDICTIONS, split, reporter=reporter)


def _require_common_class(frames: BoxFrames, class_names: tuple[str, ...], data: Path) -> None:
    labelled = sorted({kind for frame in frames.frames for kind in frame.object_types})
    if not set(labelled) & set(class_names):
        raise DatasetError(
            f"{data}: labels are of {', '.join(labelled) or 'nothing'}, predictions of "
            f"{', '.join(class_names) or 'nothing'}: no class in common; give them the same names"
        )
