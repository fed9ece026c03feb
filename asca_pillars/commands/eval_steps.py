"""The steps of `asca eval`: what goes together, running the model, reports and pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from asca_pillars.commands.eval_files import COMMAND, MADE_BY, write_report
from asca_pillars.commands.extras import missing_modules
from asca_pillars.commands.models import Model
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.errors import ConfigError, DatasetError
from asca_pillars.evaluation import gallery
from asca_pillars.evaluation.curves import write_curves
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES, evaluate
from asca_pillars.evaluation.kitti.kitti_report import BANDS_M, KittiReport, kitti_json, kitti_notes, kitti_tables
from asca_pillars.evaluation.kitti.operating_point import best_scores, operating_points
from asca_pillars.evaluation.kitti.score_threshold import matches_at_score
from asca_pillars.evaluation.predictions import ScoredFrames, write_predictions
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.evaluation.waymo import waymo_detection
from asca_pillars.evaluation.waymo_frames import evaluated_classes, waymo_frames
from asca_pillars.evaluation.waymo_report import WaymoReport, waymo_json, waymo_notes, waymo_table
from asca_pillars.files import atomic_directory, remove_directory, write_json
from asca_pillars.geometry.ranges import Ranges
from asca_pillars.installation import install_command
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.system import describe_environment

Protocol = Literal["kitti", "waymo"]

TEXT_SCORE = 0.3  # KITTI text does not say from which score on its detector would report
GALLERY = 8


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


def text_task(predictions: Path, labels: Path, split: KittiSplit | None, score: float | None) -> Task:
    """Finished predictions as KITTI text, counted from `score` on."""
    scores = dict.fromkeys(CLASS_NAMES, TEXT_SCORE if score is None else score)
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


def kitti_scores(model: Model, score: float | None, min_score: float) -> dict[str, float]:
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


def model_scores(model: Model, score: float | None, min_score: float) -> dict[str, float]:
    """The same for each of the model's own classes.

    Raises:
        ConfigError: a score that the model is not run down to.
    """
    scores = {item.name: item.score_threshold if score is None else score for item in model.spec.classes}
    if score is not None and score > 1:
        raise ConfigError(f"--score {score:g}: no detection of a model has such a score; at most 1")
    for name, fixed in scores.items():
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


def run_model(
    model: Model, split: KittiSplit, labels: Path, scores: dict[str, float], out: Path, console: Console
) -> Task:
    """Write the model's predictions to `out`: what is scored is read from there, so that it can be scored again."""
    about = {"model": model.about, "data": str(split.root), "split": split.name}
    with atomic_directory(out / "predictions", COMMAND, MADE_BY) as folder:
        write_predictions(folder, split, model.detect, camera_view=model.camera_view, console=console)
        write_json(folder / MADE_BY, about | {"files": sorted(path.name for path in folder.iterdir())})
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
    remove_directory(out / "gallery", COMMAND, gallery.INDEX)
    if missing_modules("eval"):
        (out / "curves.png").unlink(missing_ok=True)
        console.print(f"No curves.png without matplotlib: {install_command('eval')}", style="yellow", soft_wrap=True)
    else:
        write_curves(out / "curves.png", ap.overall, report.title)


def draw_gallery(task: Task, frames: ScoredFrames, out: Path, count: int | None, console: Console) -> None:
    """Draw the `count` frames with the most errors below `out`, if there are scans to draw."""
    count = GALLERY if count is None else count
    if task.split is None or count == 0:
        return
    judged = matches_at_score(frames.truth, frames.detections, CLASS_NAMES, scores=task.scores)
    worst = gallery.worst_frames(judged, count)
    folders = task.split, task.labels, task.predictions
    with atomic_directory(out / "gallery", COMMAND, gallery.INDEX) as folder:
        gallery.write_gallery(folder, worst, *folders, task.ranges, task.subject, console=console)
