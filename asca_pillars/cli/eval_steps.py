"""The steps of `asca eval`: what goes together, running the model, reports and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import atomic_directory, remove_directory, write_json
from asca_pillars.base.installation import install_command
from asca_pillars.base.own_files import is_own_picture, require_own_file
from asca_pillars.base.system import describe_environment
from asca_pillars.cli.eval_errors import ErrorAnalysis, report_errors
from asca_pillars.cli.eval_files import COMMAND, CURVES, GALLERY_FOLDER, MADE_BY, PREDICTIONS_FOLDER, write_report
from asca_pillars.cli.extras import missing_modules
from asca_pillars.cli.models import Model
from asca_pillars.cli.options import Scores, scores_by_class
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.evaluation.curves import write_curves
from asca_pillars.evaluation.errors.error_frames import KittiErrorFrames
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES, evaluate
from asca_pillars.evaluation.kitti.kitti_report import BANDS_M, KittiReport, kitti_json, kitti_notes, kitti_tables
from asca_pillars.evaluation.kitti.operating_point import best_scores, operating_points
from asca_pillars.evaluation.predictions import ScoredFrames, write_predictions
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
from asca_pillars.geometry.ranges import Ranges
from asca_pillars.ops.pillar.grid import PillarGrid

Protocol = Literal["kitti", "waymo"]

TEXT_SCORE = 0.3  # KITTI text does not say from which score on its detector would report


@dataclass(frozen=True)
class Task:
    """Predictions and labels to compare, from where they are, and where their scans are if anywhere."""

    subject: str
    predictions: Path
    labels: Path
    split: KittiSplit | None
    ranges: Ranges
    scores: dict[str, float]
    about: dict[str, Any]


def text_task(predictions: Path, labels: Path, split: KittiSplit | None, score: Scores | None) -> Task:
    """Finished predictions as KITTI text, counted from `score` on."""
    scores = scores_by_class(score, dict.fromkeys(CLASS_NAMES, TEXT_SCORE))
    about = {"predictions": str(predictions), "labels": str(labels)}
    return Task(f"{predictions} against {labels}", predictions, labels, split, PillarGrid().ranges, scores, about)


def check_classes(task: Task, frames: ScoredFrames) -> None:
    """Refuse what KITTI's protocol has nothing to say about; the report names single classes that are left out."""
    known = {name.casefold() for name in CLASS_NAMES}
    if frames.foreign_types and not any(
        known & set(frame.folded_types.tolist()) for frame in (*frames.truth, *frames.detections)
    ):
        raise DatasetError(
            f"{task.labels}: neither labels nor predictions are of a class that KITTI's protocol scores "
            f"({', '.join(CLASS_NAMES)}); they have {', '.join(frames.foreign_types)}: give --protocol waymo, "
            "which scores any class"
        )


def kitti_scores(model: Model, score: Scores | None, min_score: float) -> dict[str, float]:
    """For each class the score from which on detections count for precision and recall."""
    known = {name.lower(): name for name in CLASS_NAMES}
    scores = dict.fromkeys(CLASS_NAMES, TEXT_SCORE)
    if not any(item.name.lower() in known for item in model.spec.classes):
        raise ConfigError(
            f"{model.name} detects {', '.join(item.name for item in model.spec.classes)}; KITTI's protocol scores "
            f"{', '.join(CLASS_NAMES)}: give --protocol waymo, which scores any class"
        )
    for name, fixed in model_scores(model, score, min_score).items():
        if name.lower() in known:  # the report names others
            scores[known[name.lower()]] = fixed
    return scores


def model_scores(model: Model, score: Scores | None, min_score: float) -> dict[str, float]:
    """The same for each of the model's own classes.

    Raises:
        ConfigError: a score that the model is not run down to.
    """
    scores = scores_by_class(score, {item.name: item.score_threshold for item in model.spec.classes})
    for name, fixed in scores.items():
        if fixed > 1:
            raise ConfigError(f"--score {fixed:g}: no detection of a model has such a score; at most 1")
        if fixed < min_score:
            raise ConfigError(
                f"score {fixed:g} of {name} is below --min-score {min_score:g}, the lowest that {model.name} is "
                "run with; lower --min-score"
            )
    return scores


def warn_of_unlike_scans(model: Model, scans: int, console: Console) -> None:
    """Say how many of the scans are not like those of the training, if any."""
    if model.unlike:
        console.print(
            f"{len(model.unlike)} of {scans} scans are unlike those that {model.name} was trained on; "
            f"the first: {model.unlike[0]}",
            style="yellow",
            soft_wrap=True,
        )


def warn_of_degrees(console: Console, **yaws: Sequence[NDArray[np.floating]]) -> None:
    """Say of which files, labels or predictions, the yaws look like degrees."""
    for what, own in yaws.items():
        if (doubt := check_yaws(own)) is not None:
            console.print(f"{what}: {doubt}", style="yellow", soft_wrap=True)


def warn_of_degrees_in_text(console: Console, frames: ScoredFrames) -> None:
    """The same of rotation_y; objects without a 3D box have none."""
    labels, predictions = (
        [frame.rotation_y[(frame.dimensions_hwl > 0).all(axis=1)] for frame in side]
        for side in (frames.truth, frames.detections)
    )
    warn_of_degrees(console, labels=labels, predictions=predictions)


def run_model(
    model: Model, split: KittiSplit, labels: Path, scores: dict[str, float], out: Path, console: Console
) -> Task:
    """Write the model's predictions to `out`: what is scored is read from there, so that it can be scored again."""
    about = {"model": model.about, "data": str(split.root), "split": split.name}
    with atomic_directory(out / "predictions", *PREDICTIONS_FOLDER) as folder:
        write_predictions(folder, split, model.detect, camera_view=model.camera_view, console=console)
        files = sorted(path.name for path in folder.iterdir())
        write_json(folder / MADE_BY, about | {"scores": scores, "files": files})
    warn_of_unlike_scans(model, len(split.frame_ids), console)
    subject = f"{model.name} on {split.root}, {split.name}"
    return Task(subject, out / "predictions", labels, split, model.spec.ranges, scores, about)


def report_waymo(task: Task, frames: ScoredFrames, out: Path, json_path: Path | None, console: Console) -> None:
    """Evaluate by Waymo's metric; print and write the table, and the JSON (to `json_path` too)."""
    class_names = evaluated_classes(frames)
    if not class_names:
        raise DatasetError(f"{task.labels}: no label and no prediction is of a class to be evaluated")
    prepared = waymo_frames(frames, class_names, task.split, console=console)
    scores = waymo_detection(prepared.truth, prepared.detections, no_label=prepared.no_label, console=console)
    about = task.about | {"environment": describe_environment()}
    report = WaymoReport(task.subject, frames, scores, task.split is not None, about)
    page = ReportPage(report.title, [waymo_table(report)], waymo_notes(report))
    write_report("waymo", page, waymo_json(report), out, json_path, task.predictions, console)


def report_kitti(task: Task, frames: ScoredFrames, out: Path, json_path: Path | None, console: Console) -> None:
    """Evaluate; print and write the tables, the JSON (to `json_path` too) and the curves."""
    truth, found = frames.truth, frames.detections
    bands_m = tuple(BANDS_M)
    ap = evaluate(truth, found, CLASS_NAMES, bands_m=bands_m, progress=True)
    points = operating_points(truth, found, CLASS_NAMES, scores=task.scores, difficulties=DIFFICULTIES, bands_m=bands_m)
    about = task.about | {"environment": describe_environment()}
    report = KittiReport(task.subject, frames, ap, points, best_scores(truth, found, CLASS_NAMES), about)
    page = ReportPage(report.title, kitti_tables(report), kitti_notes(report))
    write_report("report", page, kitti_json(report), out, json_path, task.predictions, console)
    remove_directory(out / "gallery", *GALLERY_FOLDER)
    require_own_file(out / CURVES, COMMAND, is_own_picture)
    if missing_modules("eval"):
        (out / CURVES).unlink(missing_ok=True)
        console.print(f"No curves.png without matplotlib: {install_command('eval')}", style="yellow", soft_wrap=True)
    else:
        write_curves(out / CURVES, ap.overall, report.title)


def analyze_errors(analysis: ErrorAnalysis, task: Task, frames: ScoredFrames, out: Path, console: Console) -> None:
    """Write the error analysis of KITTI's classes that are labelled or detected below `out`."""
    assert task.split is not None, "checked with the arguments"
    there = {name for frame in (*frames.truth, *frames.detections) for name in frame.folded_types.tolist()}
    scores = {name: score for name, score in task.scores.items() if name.casefold() in there}
    frame_ids = tuple(frame.frame_id for frame in frames.truth)
    read = KittiErrorFrames(task.split, task.labels, task.predictions, tuple(scores), frame_ids)
    about = task.about | {"environment": describe_environment()}
    report_errors(analysis, read, scores, task.subject, about, out, console)
