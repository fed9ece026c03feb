"""Evaluation by KITTI's and Waymo's protocols: running the model, reports and pictures, and the error analysis."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import atomic_directory, remove_directory, write_json
from asca_pillars.base.installation import install_command, missing_modules
from asca_pillars.base.own_files import is_own_picture, require_own_file
from asca_pillars.base.progress import Reporter
from asca_pillars.base.system import describe_environment
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.evaluation import report_files
from asca_pillars.evaluation.arguments import (
    Evaluation,
    EvaluationTask,
    Model,
    OpenModel,
    model_scores,
    scores_by_class,
)
from asca_pillars.evaluation.errors.error_frames import ErrorFrames, KittiErrorFrames
from asca_pillars.evaluation.errors.error_report import ErrorReport, parts_of, read_report, write_errors
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES, evaluate
from asca_pillars.evaluation.kitti.kitti_report import (
    BANDS_M,
    KittiReport,
    kitti_json,
    kitti_notes,
    kitti_tables,
    write_curves,
)
from asca_pillars.evaluation.kitti.score_threshold import best_scores, matches_at_score, operating_points
from asca_pillars.evaluation.predictions import ScoredFrames, read_predictions, read_truth, write_predictions
from asca_pillars.evaluation.report_files import (
    COMMAND,
    CURVES,
    GALLERY_FOLDER,
    MADE_BY,
    PREDICTIONS_FOLDER,
    check_output_folder,
    write_report,
)
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.evaluation.waymo import (
    WaymoReport,
    evaluated_classes,
    waymo_detection,
    waymo_frames,
    waymo_json,
    waymo_notes,
    waymo_table,
)
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.ops.pillar.grid import PillarGrid


@dataclass(frozen=True)
class ErrorAnalysis:
    """Inputs of an error analysis.

    Attributes:
        name: name of the data in the tables.
        parts: frame ids of each part of the data, by its name.
        beside: reports of other evaluations.
    """

    name: str
    parts: dict[str, list[str]]
    beside: tuple[ErrorReport, ...]


def prepare_errors(model_name: str, split: LabeledSplit, by: str | None, beside: Sequence[Path]) -> ErrorAnalysis:
    """Read the inputs of an error analysis: before a model runs, so that errors are found early.

    Args:
        model_name: name of the model or its predictions.
        split: the frames.
        by: see `evaluation.errors.error_report.parts_of`; None for no parts.
        beside: errors.json of other evaluations, for the same tables.

    Raises:
        ConfigError, DatasetError: as `parts_of` and `read_report`.
    """
    root = Path(split.root)
    where = f"{model_name} {root.resolve().name}"
    parts = {} if by is None else parts_of(root, split.name, split.frame_ids, by)
    named = {f"{where}/{part}": ids for part, ids in parts.items()}
    return ErrorAnalysis(f"{where}/{split.name}", named, tuple(read_report(path) for path in beside))


def predictions_name(predictions: Path) -> str:
    """Return the model's name if `asca eval` wrote the predictions, else that of the file or folder."""
    made_by = (predictions if predictions.is_dir() else predictions.parent) / MADE_BY
    try:
        return str(json.loads(made_by.read_text(encoding="utf-8"))["model"]["name"])
    except (OSError, ValueError, KeyError, TypeError):
        return predictions.name


def report_errors(
    analysis: ErrorAnalysis,
    frames: ErrorFrames,
    scores: dict[str, float],
    subject: str,
    about: dict[str, Any],
    out: Path,
    reporter: Reporter,
) -> ReportPage:
    """Analyze the errors and write the report; `scores` has the classes to evaluate."""
    return write_errors(
        frames,
        scores,
        subject=subject,
        name=analysis.name,
        parts=analysis.parts,
        beside=analysis.beside,
        about=about,
        out=out,
        reporter=reporter,
    )


GALLERY_FRAMES = 8
TEXT_SCORE = 0.3  # KITTI text does not state the detector's score threshold


def evaluate_text(task: EvaluationTask, open_model: OpenModel, reporter: Reporter) -> Evaluation:
    """Evaluate by KITTI's or Waymo's protocol, on KITTI text; write the reports, curves, gallery and predictions."""
    kitti, predictions, labels, out = task.protocol == "kitti", task.predictions, task.labels, task.out
    inputs = (task.model, task.data, labels, task.compare, *task.beside)
    check_output_folder("report" if kitti else task.protocol, out, task.json, predictions, inputs)
    frames_of = None if task.data is None else KittiSplit(task.data, task.split_name)
    if labels is None:
        assert frames_of is not None, "checked with the arguments"
        labels = frames_of.folder / "label_2"
    truth = read_truth(labels, None if frames_of is None else frames_of.frame_ids)
    analysis = None
    if predictions is not None:
        if task.errors:
            assert frames_of is not None, "checked with the arguments"
            analysis = prepare_errors(predictions_name(predictions), frames_of, task.errors_by, task.beside)
        compared = text_task(predictions, labels, frames_of, task.score)
    else:
        assert frames_of is not None, "checked with the arguments"
        model = open_model(None)
        if task.errors:
            analysis = prepare_errors(model.name, frames_of, task.errors_by, task.beside)
        fixed = kitti_scores(model, task.score, task.min_score) if kitti else {}
        compared = run_model(model, frames_of, labels, fixed, out, reporter)
    frames = read_predictions(compared.predictions, truth, labels, reporter=reporter)
    warn_of_degrees_in_text(reporter, frames)
    if not kitti:
        content, page = report_waymo(compared, frames, out, task.json, reporter)
        return Evaluation(task.protocol, content, page, None, out)
    check_classes(compared, frames)
    content, page = report_kitti(compared, frames, out, task.json, reporter)
    draw_gallery(compared, frames, out, task.gallery, task.compare, reporter)
    errors = None if analysis is None else analyze_errors(analysis, compared, frames, out, reporter)
    return Evaluation(task.protocol, content, page, errors, out)


@dataclass(frozen=True)
class Task:
    """Predictions and labels to compare, their source, and the folder of their scans if any."""

    subject: str
    predictions: Path
    labels: Path
    split: KittiSplit | None
    ranges: Ranges
    scores: dict[str, float]
    about: dict[str, Any]


def text_task(predictions: Path, labels: Path, split: KittiSplit | None, score: ScoreThresholds | None) -> Task:
    """Return the task of finished predictions as KITTI text, with the score threshold `score`."""
    scores = scores_by_class(score, dict.fromkeys(CLASS_NAMES, TEXT_SCORE))
    about = {"predictions": str(predictions), "labels": str(labels)}
    return Task(f"{predictions} against {labels}", predictions, labels, split, PillarGrid().ranges, scores, about)


def check_classes(task: Task, frames: ScoredFrames) -> None:
    """Refuse labels and predictions without any of KITTI's classes; the report names other classes left out."""
    known = {name.casefold() for name in CLASS_NAMES}
    if frames.foreign_types and not any(
        known & set(frame.folded_types.tolist()) for frame in (*frames.truth, *frames.detections)
    ):
        raise DatasetError(
            f"{task.labels}: neither labels nor predictions are of a class that KITTI's protocol scores "
            f"({', '.join(CLASS_NAMES)}); they have {', '.join(frames.foreign_types)}: give --protocol waymo, "
            "which scores any class"
        )


def kitti_scores(model: Model, score: ScoreThresholds | None, min_score: float) -> dict[str, float]:
    """Return the score threshold of each class for precision and recall."""
    known = {name.lower(): name for name in CLASS_NAMES}
    scores = dict.fromkeys(CLASS_NAMES, TEXT_SCORE)
    if not any(item.name.lower() in known for item in model.spec.classes):
        raise ConfigError(
            f"{model.name} detects {', '.join(item.name for item in model.spec.classes)}; KITTI's protocol scores "
            f"{', '.join(CLASS_NAMES)}: give --protocol waymo, which scores any class"
        )
    for name, fixed in model_scores(model, score, min_score).items():
        if name.lower() in known:  # the report names other classes
            scores[known[name.lower()]] = fixed
    return scores


def warn_of_unusual_scans(model: Model, scans: int, reporter: Reporter) -> None:
    """Say how many of the scans are not like those of the training, if any."""
    if model.input_warnings:
        reporter.remark(
            f"{len(model.input_warnings)} of {scans} scans are unlike those that {model.name} was trained on; "
            f"the first: {model.input_warnings[0]}"
        )


def warn_of_degrees(reporter: Reporter, **yaws: Sequence[NDArray[np.floating]]) -> None:
    """Say of which files, labels or predictions, the yaws look like degrees."""
    for what, values in yaws.items():
        if (doubt := check_yaws(values)) is not None:
            reporter.remark(f"{what}: {doubt}")


def warn_of_degrees_in_text(reporter: Reporter, frames: ScoredFrames) -> None:
    """Warn of rotation_y in degrees; objects without a 3D box are left out."""
    labels, predictions = (
        [frame.rotation_y[(frame.dimensions_hwl > 0).all(axis=1)] for frame in side]
        for side in (frames.truth, frames.detections)
    )
    warn_of_degrees(reporter, labels=labels, predictions=predictions)


def run_model(
    model: Model, split: KittiSplit, labels: Path, scores: dict[str, float], out: Path, reporter: Reporter
) -> Task:
    """Write the model's predictions to `out`: these files are evaluated, so that they can be evaluated again."""
    about = {"model": model.about, "data": str(split.root), "split": split.name}
    with atomic_directory(out / "predictions", *PREDICTIONS_FOLDER) as folder:
        write_predictions(folder, split, model.detect, camera_view=model.camera_view, reporter=reporter)
        files = sorted(path.name for path in folder.iterdir())
        write_json(folder / MADE_BY, about | {"scores": scores, "files": files})
    warn_of_unusual_scans(model, len(split.frame_ids), reporter)
    subject = f"{model.name} on {split.root}, {split.name}"
    return Task(subject, out / "predictions", labels, split, model.spec.ranges, scores, about)


def report_waymo(
    task: Task, frames: ScoredFrames, out: Path, json_path: Path | None, reporter: Reporter
) -> tuple[dict[str, Any], ReportPage]:
    """Evaluate by Waymo's metric; write the table, and the JSON (to `json_path` too)."""
    class_names = evaluated_classes(frames)
    if not class_names:
        raise DatasetError(f"{task.labels}: no label and no prediction is of a class to be evaluated")
    prepared = waymo_frames(frames, class_names, task.split, reporter=reporter)
    scores = waymo_detection(prepared.truth, prepared.detections, no_label=prepared.no_label, reporter=reporter)
    about = task.about | {"environment": describe_environment()}
    report = WaymoReport(task.subject, frames, scores, task.split is not None, about)
    page = ReportPage(report.title, [waymo_table(report)], waymo_notes(report))
    content = waymo_json(report)
    write_report("waymo", page, content, out, json_path, task.predictions)
    return content, page


def report_kitti(
    task: Task, frames: ScoredFrames, out: Path, json_path: Path | None, reporter: Reporter
) -> tuple[dict[str, Any], ReportPage]:
    """Evaluate; write the tables, the JSON (to `json_path` too) and the curves."""
    truth, detections = frames.truth, frames.detections
    bands_m = tuple(BANDS_M)
    ap = evaluate(truth, detections, CLASS_NAMES, bands_m=bands_m, reporter=reporter)
    points = operating_points(
        truth, detections, CLASS_NAMES, scores=task.scores, difficulties=DIFFICULTIES, bands_m=bands_m
    )
    about = task.about | {"environment": describe_environment()}
    report = KittiReport(task.subject, frames, ap, points, best_scores(truth, detections, CLASS_NAMES), about)
    page = ReportPage(report.title, kitti_tables(report), kitti_notes(report))
    content = kitti_json(report)
    write_report("report", page, content, out, json_path, task.predictions)
    remove_directory(out / "gallery", *GALLERY_FOLDER)
    require_own_file(out / CURVES, COMMAND, is_own_picture)
    if missing_modules("eval"):
        (out / CURVES).unlink(missing_ok=True)
        reporter.remark(f"No curves.png without matplotlib: {install_command('eval')}")
    else:
        write_curves(out / CURVES, ap.overall, report.title)
    return content, page


def analyze_errors(
    analysis: ErrorAnalysis, task: Task, frames: ScoredFrames, out: Path, reporter: Reporter
) -> ReportPage:
    """Write the error analysis of KITTI's classes that are labelled or detected below `out`."""
    assert task.split is not None, "checked with the arguments"
    types = {name for frame in (*frames.truth, *frames.detections) for name in frame.folded_types.tolist()}
    scores = {name: score for name, score in task.scores.items() if name.casefold() in types}
    frame_ids = tuple(frame.frame_id for frame in frames.truth)
    read = KittiErrorFrames(task.split, task.labels, task.predictions, tuple(scores), frame_ids)
    about = task.about | {"environment": describe_environment()}
    return report_errors(analysis, read, scores, task.subject, about, out, reporter)


def draw_gallery(
    task: Task, frames: ScoredFrames, out: Path, count: int | None, compare: Path | None, reporter: Reporter
) -> None:
    """Draw `count` frames below `out`, if there are scans to draw.

    Args:
        task: predictions and labels.
        frames: its labels and predictions.
        out: output folder of the evaluation.
        count: None for GALLERY_FRAMES.
        compare: KITTI text of another detector, drawn next to the first; None: the frames with most errors.
        reporter: for the progress.

    Raises:
        DatasetError, ScanError: predictions of the other detector, or a frame, cannot be read.
    """
    count = GALLERY_FRAMES if count is None else count
    if task.split is None or count == 0:
        return
    evaluated = report_files.EvaluatedDetector(task.subject, task.predictions, _match_at_scores(frames, task.scores))
    detectors = (
        [evaluated]
        if compare is None
        else _with_distinct_names(evaluated, task, _read_compared(compare, task, frames, reporter))
    )
    with atomic_directory(out / "gallery", *GALLERY_FOLDER) as folder:
        report_files.write_gallery(folder, detectors, count, task.split, task.labels, task.ranges, reporter=reporter)


def _with_distinct_names(
    evaluated: report_files.EvaluatedDetector, task: Task, other: report_files.EvaluatedDetector
) -> list[report_files.EvaluatedDetector]:
    """Return both detectors named by their models, or by their folders if these are the same."""
    named = [replace(evaluated, name=_name(task.about, task.predictions)), other]
    if named[0].name == named[1].name:
        named = [replace(detector, name=f"{detector.name}, {detector.predictions}") for detector in named]
    return named


def _read_compared(
    compare: Path, task: Task, frames: ScoredFrames, reporter: Reporter
) -> report_files.EvaluatedDetector:
    """Return the detector of a folder of predictions, at its own scores if an evaluation of it states them."""
    about = _made_by(compare)
    predictions = read_predictions(compare, frames.truth, task.labels, reporter=reporter)
    if predictions.shortage is not None:
        reporter.remark(f"--compare {compare}: {predictions.shortage}")
    return report_files.EvaluatedDetector(
        _name(about, compare), compare, _match_at_scores(predictions, task.scores | _stated_scores(about))
    )


def _match_at_scores(frames: ScoredFrames, scores: dict[str, float]) -> report_files.Matches:
    return matches_at_score(frames.truth, frames.detections, CLASS_NAMES, scores=scores)


def _made_by(folder: Path) -> dict[str, Any]:
    """Read an evaluation's notes on the predictions of its model; empty for predictions of other programs."""
    try:
        content = json.loads((folder / MADE_BY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _stated_scores(about: dict[str, Any]) -> dict[str, float]:
    """Return the stated score threshold of each class."""
    scores = about.get("scores")
    if not isinstance(scores, dict):
        return {}
    return {name: float(score) for name, score in scores.items() if isinstance(score, int | float)}


def _name(about: dict[str, Any], predictions: Path) -> str:
    model = about.get("model")
    return str(model["name"]) if isinstance(model, dict) and "name" in model else str(predictions)
