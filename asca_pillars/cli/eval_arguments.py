"""Which options of `asca eval` go together."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from asca_deploy.open_model import RuntimeOptions
from asca_pillars.base.errors import ConfigError
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.evaluation.model import MIN_SCORE


@dataclass(frozen=True)
class EvalArguments:
    """What is evaluated and on what; the options of `asca eval` by the same names."""

    protocol: str
    model: Path | None
    data: Path | None
    split: str | None
    predictions: Path | None
    labels: Path | None
    out: Path
    gallery: int | None
    compare: Path | None
    score: ScoreThresholds | None
    min_score: float
    around: bool
    errors: bool = False
    errors_by: str | None = None
    beside: list[Path] | None = None


def default_protocol(data: Path | None) -> Literal["kitti", "iou"]:
    """KITTI's, unless the dataset has no camera."""
    return "kitti" if data is None or isinstance(open_split(data), KittiSplit) else "iou"


def check_arguments(given: EvalArguments, options: RuntimeOptions) -> None:
    """Refuse options that do not go together, with a ConfigError that says which and what to do."""
    if given.predictions is not None:
        _check_no_runtime(given.predictions, options, given.min_score)
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
        raise ConfigError(f"--score {wrong[0]} must be a number")  # any: predictions from elsewhere may hold logits


def _check_no_runtime(predictions: Path, options: RuntimeOptions, min_score: float) -> None:
    plain = RuntimeOptions()
    given = {
        f"--provider {options.provider}": options.provider != plain.provider,
        f"--precision {options.precision}": options.precision != plain.precision,
        f"--threads {options.threads}": options.threads != plain.threads,
        f"--min-score {min_score:g}": min_score != MIN_SCORE,
    }
    if options_given := [name for name, differs in given.items() if differs]:
        raise ConfigError(
            f"{options_given[0]} is for running a model; --predictions {predictions} are scored as they are"
        )


def _check_errors(given: EvalArguments) -> None:
    if not given.errors:
        if given.errors_by is not None or given.beside:
            option = "--beside" if given.errors_by is None else f"--errors-by {given.errors_by}"
            raise ConfigError(f"{option} belongs to the error analysis: give --errors, too")
        return
    if given.protocol in ("waymo", "tracking"):
        raise ConfigError(f"--errors goes with --protocol kitti, iou or distance, not with {given.protocol}")
    if given.data is None:
        raise ConfigError("--errors looks at the points of the scans: give --data ROOT that has them")


def _check_tracking(given: EvalArguments) -> None:
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


def _check_boxes(given: EvalArguments) -> None:
    if given.data is None:
        raise ConfigError(f"--protocol {given.protocol} needs the labels: give --data ROOT")
    if given.around and given.predictions is not None:
        raise ConfigError("--around runs a model; predictions are scored as they are: leave one of them out")
    _check_no_text(given)


def _check_no_text(given: EvalArguments) -> None:
    """What only labels as KITTI text have."""
    if given.labels is not None:
        raise ConfigError(f"--labels {given.labels} belongs to --protocol kitti and waymo; give --data ROOT alone")
    if given.gallery:
        raise ConfigError(
            f"--gallery {given.gallery} belongs to --protocol kitti; `asca detect` draws scans with boxes"
        )
    if given.compare is not None:
        raise ConfigError(f"--compare {given.compare} belongs to the gallery of --protocol kitti; leave it out")


def _check_kitti(given: EvalArguments) -> None:
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


def _check_compare(compare: Path, given: EvalArguments) -> None:
    if given.protocol != "kitti":
        raise ConfigError(f"--compare {compare} belongs to the gallery of --protocol kitti; leave it out")
    if given.data is None or given.gallery == 0:
        why = "give --data ROOT that has them" if given.data is None else "leave --gallery 0 out"
        raise ConfigError(f"--compare {compare} draws scans: {why}")
    replaced = (given.out / "predictions").resolve()
    if replaced in (compare.resolve(), *compare.resolve().parents):
        raise ConfigError(f"--compare {compare}: this evaluation writes there; give it another --out")


def _typed(score: ScoreThresholds) -> str:
    """As a user would type it, the first one of several."""
    return next(f"{name}={value:g}" for name, value in score.items()) if isinstance(score, Mapping) else f"{score:g}"
