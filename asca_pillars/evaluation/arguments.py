"""Arguments of an evaluation, checks of their combinations, the detector under evaluation, and the result."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec, ScoreThresholds
from asca_pillars.evaluation.report_page import ReportPage

MIN_SCORE = 0.05
"""Default lowest score of an evaluated model's detections."""


@dataclass(frozen=True)
class Model:
    """Detector and its properties.

    Attributes:
        name: name of the model.
        detect: (N, 4) points -> detections, from `min_score` on.
        spec: spec of the model, with its own thresholds.
        camera_view: whether it expects only the points in the image.
        about: its source and device, for the report.
        input_warnings: the first warning of each scan that is unlike the training scans.
    """

    name: str
    detect: Callable[[NDArray[np.float32]], Detections]
    spec: DetectorSpec
    camera_view: bool
    about: dict[str, Any]
    input_warnings: list[str] = field(default_factory=list)


OpenModel: TypeAlias = Callable[[float | None], Model]
"""Opener of the model to evaluate, for scans of a sensor of this height, metres; None: as in the training scans."""


def model_scores(model: Model, score: ScoreThresholds | None, min_score: float) -> dict[str, float]:
    """Return the score threshold of each of the model's classes, for precision and recall.

    Raises:
        ConfigError: a score below the lowest score of the model's detections.
    """
    scores = scores_by_class(score, {item.name: item.score_threshold for item in model.spec.classes})
    for name, fixed in scores.items():
        if fixed > 1:
            raise ConfigError(f"--score {fixed:g}: scores of a model are at most 1")
        if fixed < min_score:
            raise ConfigError(
                f"score {fixed:g} of {name} is below --min-score {min_score:g}, the lowest that {model.name} is "
                "run with; lower --min-score"
            )
    return scores


def scores_by_class(stated: ScoreThresholds | None, defaults: Mapping[str, float]) -> dict[str, float]:
    """Return the score of each class of `defaults`: the stated one, or the default.

    Raises:
        ConfigError: a stated class is not among them.
    """
    if not isinstance(stated, Mapping):
        return dict(defaults) if stated is None else dict.fromkeys(defaults, stated)
    if unknown := [name for name in stated if name not in defaults]:
        raise ConfigError(f"--score {unknown[0]}: no such class; available: {', '.join(defaults)}")
    return dict(defaults) | dict(stated)


@dataclass(frozen=True, kw_only=True)
class EvaluationTask:
    """Data and options of an evaluation, named as the options of `asca eval`."""

    protocol: str
    model: Path | None = None
    data: Path | None = None
    split: str | None = None
    predictions: Path | None = None
    labels: Path | None = None
    out: Path
    json: Path | None = None
    gallery: int | None = None
    compare: Path | None = None
    score: ScoreThresholds | None = None
    min_score: float = MIN_SCORE
    around: bool = False
    errors: bool = False
    errors_by: str | None = None
    beside: tuple[Path, ...] = ()

    @property
    def split_name(self) -> str:
        """Name of the list of frames."""
        return "val" if self.split is None else self.split


@dataclass(frozen=True)
class Evaluation:
    """Finished evaluation.

    Attributes:
        protocol: kitti, waymo, iou, distance or tracking.
        report: all results, as in the JSON file.
        page: the tables; `page.markdown()` returns them as text.
        errors: the main tables of the error analysis; None without one.
        out: output folder.
        remarks: warnings about the data, and what was left out.
    """

    protocol: str
    report: dict[str, Any]
    page: ReportPage
    errors: ReportPage | None
    out: Path
    remarks: tuple[str, ...] = ()


def default_protocol(data: Path | None) -> Literal["kitti", "iou"]:
    """Return "kitti", or "iou" for a dataset without a camera."""
    return "kitti" if data is None or isinstance(open_split(data), KittiSplit) else "iou"


def check_arguments(given: EvaluationTask) -> None:
    """Refuse incompatible options with a ConfigError that names them and the remedy."""
    if given.split is not None and given.data is None:
        raise ConfigError(f"--split {given.split} is a list of the frames of a dataset: give --data ROOT, too")
    _check_errors(given)
    if given.protocol == "tracking":
        _check_tracking(given)
        return
    if given.predictions is not None and given.model is not None:
        raise ConfigError(
            f"{given.model} and --predictions {given.predictions}: give a model or its predictions, not both"
        )
    if given.protocol in ("iou", "distance"):
        _check_boxes(given)
    else:
        _check_kitti(given)
    scores = given.score.values() if isinstance(given.score, Mapping) else [given.score or 0.0]
    if wrong := [score for score in scores if not math.isfinite(score)]:
        raise ConfigError(f"--score {wrong[0]} must be a number")  # any number, since others may be logits


def _check_errors(given: EvaluationTask) -> None:
    if not given.errors:
        if given.errors_by is not None or given.beside:
            option = "--beside" if given.errors_by is None else f"--errors-by {given.errors_by}"
            raise ConfigError(f"{option} belongs to the error analysis: give --errors, too")
        return
    if given.protocol in ("waymo", "tracking"):
        raise ConfigError(f"--errors goes with --protocol kitti, iou or distance, not with {given.protocol}")
    if given.data is None:
        raise ConfigError("--errors looks at the points of the scans: give --data ROOT that has them")


def _check_tracking(given: EvaluationTask) -> None:
    if given.model is not None:
        raise ConfigError(
            f"{given.model}: --protocol tracking runs no model; give --predictions, of asca detect --track"
        )
    if given.around:
        raise ConfigError("--around runs a model; --protocol tracking scores tracks as they are: leave it out")
    _check_no_text(given)
    if given.score is not None:
        raise ConfigError(
            f"--score {_typed(given.score)}: --protocol tracking goes over all tracks; give it to asca detect --track"
        )
    if given.data is None or given.predictions is None:
        raise ConfigError("--protocol tracking: give --data ROOT and --predictions, the output of asca detect --track")


def _check_boxes(given: EvaluationTask) -> None:
    if given.data is None:
        raise ConfigError(f"--protocol {given.protocol} needs the labels: give --data ROOT")
    if given.around and given.predictions is not None:
        raise ConfigError("--around runs a model; predictions are scored as they are: leave one of them out")
    _check_no_text(given)


def _check_no_text(given: EvaluationTask) -> None:
    """Refuse options that only labels as KITTI text have."""
    if given.labels is not None:
        raise ConfigError(f"--labels {given.labels} belongs to --protocol kitti and waymo; give --data ROOT alone")
    if given.gallery:
        raise ConfigError(
            f"--gallery {given.gallery} belongs to --protocol kitti; `asca detect` draws scans with boxes"
        )
    if given.compare is not None:
        raise ConfigError(f"--compare {given.compare} belongs to the gallery of --protocol kitti; leave it out")


def _check_kitti(given: EvaluationTask) -> None:
    if given.around:
        raise ConfigError("--around needs labels in every direction: give --protocol iou or distance, too")
    if given.predictions is None and given.labels is not None:
        raise ConfigError(f"--labels {given.labels} goes with --predictions DIR; a model is run on --data ROOT")
    if given.predictions is None and given.data is None:
        raise ConfigError("nothing to evaluate on: give --data ROOT, or --predictions DIR and --labels DIR")
    if given.predictions is not None and given.labels is None and given.data is None:
        raise ConfigError(f"--predictions {given.predictions} needs --labels DIR, or --data ROOT that has the labels")
    if given.gallery and given.data is None:
        raise ConfigError(f"--gallery {given.gallery} draws scans: give --data ROOT that has them")
    if given.data is not None and not isinstance(open_split(given.data), KittiSplit):
        raise ConfigError(
            f"--protocol {given.protocol}: {given.data} has no camera, which it needs; choose iou or distance"
        )
    if given.compare is not None:
        _check_compare(given.compare, given)
    options = [f"--gallery {given.gallery}"] if given.gallery else []
    options += [] if given.score is None else [f"--score {_typed(given.score)}"]
    if given.protocol == "waymo" and options:
        raise ConfigError(
            f"{options[0]} belongs to --protocol kitti; Waymo's metric goes over all scores: leave it out"
        )


def _check_compare(compare: Path, given: EvaluationTask) -> None:
    if given.protocol != "kitti":
        raise ConfigError(f"--compare {compare} belongs to the gallery of --protocol kitti; leave it out")
    if given.data is None or given.gallery == 0:
        why = "give --data ROOT that has them" if given.data is None else "leave --gallery 0 out"
        raise ConfigError(f"--compare {compare} draws scans: {why}")
    replaced = (given.out / "predictions").resolve()
    if replaced in (compare.resolve(), *compare.resolve().parents):
        raise ConfigError(f"--compare {compare}: this evaluation writes there; give it another --out")


def _typed(score: ScoreThresholds) -> str:
    """Return a score threshold as typed on the command line, the first one of several."""
    return next(f"{name}={value:g}" for name, value in score.items()) if isinstance(score, Mapping) else f"{score:g}"
