"""Detector under evaluation, and its score thresholds."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec, ScoreThresholds

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
            raise ConfigError(f"--score {fixed:g}: no detection of a model has such a score; at most 1")
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
        raise ConfigError(f"--score {unknown[0]}: no such class; there are {', '.join(defaults)}")
    return dict(defaults) | dict(stated)
