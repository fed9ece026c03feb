"""The gallery of `asca eval`: the worst frames, or those in which two detectors differ most, side by side."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from asca_pillars.base.files import atomic_directory
from asca_pillars.cli.eval_files import GALLERY_FOLDER, MADE_BY
from asca_pillars.cli.eval_steps import Task
from asca_pillars.evaluation import gallery
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from asca_pillars.evaluation.kitti.score_threshold import matches_at_score
from asca_pillars.evaluation.predictions import ScoredFrames, read_predictions

FRAMES = 8


def draw_gallery(
    task: Task, frames: ScoredFrames, out: Path, count: int | None, compare: Path | None, console: Console
) -> None:
    """Draw `count` frames below `out`, if there are scans to draw.

    Args:
        task: what was evaluated.
        frames: its labels and predictions.
        out: of the evaluation.
        count: None for FRAMES.
        compare: KITTI text of another detector, which is drawn beside the first; None: the frames with most errors.
        console: shows the progress.

    Raises:
        DatasetError, ScanError: predictions of the other detector, or a frame, cannot be read.
    """
    count = FRAMES if count is None else count
    if task.split is None or count == 0:
        return
    own = gallery.Judged(task.subject, task.predictions, _judged(frames, task.scores))
    detectors = [own] if compare is None else _named_apart(own, task, _other(compare, task, frames, console))
    with atomic_directory(out / "gallery", *GALLERY_FOLDER) as folder:
        gallery.write_gallery(folder, detectors, count, task.split, task.labels, task.ranges, console=console)


def _named_apart(own: gallery.Judged, task: Task, other: gallery.Judged) -> list[gallery.Judged]:
    """Both, by the names of their models; with their folders where these are the same."""
    both = [replace(own, name=_name(task.about, task.predictions)), other]
    if both[0].name == both[1].name:
        both = [replace(one, name=f"{one.name}, {one.predictions}") for one in both]
    return both


def _other(compare: Path, task: Task, frames: ScoredFrames, console: Console) -> gallery.Judged:
    """The detector whose predictions lie in a folder, at its own scores where an evaluation of it states them."""
    about = _made_by(compare)
    found = read_predictions(compare, frames.truth, task.labels, console=console)
    if found.shortage is not None:
        console.print(f"--compare {compare}: {found.shortage}", style="yellow", soft_wrap=True)
    return gallery.Judged(_name(about, compare), compare, _judged(found, task.scores | _stated_scores(about)))


def _judged(frames: ScoredFrames, scores: dict[str, float]) -> gallery.Matches:
    return matches_at_score(frames.truth, frames.detections, CLASS_NAMES, scores=scores)


def _made_by(folder: Path) -> dict[str, Any]:
    """What an evaluation noted beside the predictions of its model; nothing where they are from elsewhere."""
    try:
        content = json.loads((folder / MADE_BY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _stated_scores(about: dict[str, Any]) -> dict[str, float]:
    """The score of each class from which on its detections count, as far as that is stated."""
    scores = about.get("scores")
    if not isinstance(scores, dict):
        return {}
    return {name: float(score) for name, score in scores.items() if isinstance(score, int | float)}


def _name(about: dict[str, Any], predictions: Path) -> str:
    model = about.get("model")
    return str(model["name"]) if isinstance(model, dict) and "name" in model else str(predictions)
