"""A detector under evaluation, and the scores from which its detections count."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec, ScoreThresholds

MIN_SCORE = 0.05
"""Lowest score that a model is evaluated with, unless another is given."""


@dataclass(frozen=True)
class Model:
    """A detector and what is to be known about it.

    Attributes:
        name: of the model.
        detect: (N, 4) points -> detections, from `min_score` on.
        spec: as the model was made, with its own thresholds.
        camera_view: whether it expects only the points in the image.
        about: where it comes from and where it runs, for the report.
        input_warnings: for each scan that does not look like those of the training, the first reason.
    """

    name: str
    detect: Callable[[NDArray[np.float32]], Detections]
    spec: DetectorSpec
    camera_view: bool
    about: dict[str, Any]
    input_warnings: list[str] = field(default_factory=list)


OpenModel: TypeAlias = Callable[[float | None], Model]
"""Opens the model to evaluate for scans of a sensor of this height, metres; None: as high as in the training."""


def model_scores(model: Model, score: ScoreThresholds | None, min_score: float) -> dict[str, float]:
    """For each of the model's classes the score from which on detections count for precision and recall.

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


def scores_by_class(stated: ScoreThresholds | None, defaults: Mapping[str, float]) -> dict[str, float]:
    """The score of each class of `defaults`: as stated, else that one.

    Raises:
        ConfigError: a stated class is none of them.
    """
    if not isinstance(stated, Mapping):
        return dict(defaults) if stated is None else dict.fromkeys(defaults, stated)
    if unknown := [name for name in stated if name not in defaults]:
        raise ConfigError(f"--score {unknown[0]}: no such class; there are {', '.join(defaults)}")
    return dict(defaults) | dict(stated)
