"""Which boxes of the first stage the second looks at."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import HeadMaps, PostProcess, decode_candidates, suppress
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec


@dataclass(frozen=True)
class ProposalSettings(Strict):
    """How a first stage's head maps become proposals."""

    score_threshold: float = 0.05
    """Of every class: the second stage judges again, and cannot bring back what is not proposed."""
    nms_iou: float = 0.7
    """Boxes of a class that overlap less are both proposed."""
    candidates: int = 300
    """Best boxes of each class that enter the suppression."""
    quotas: tuple[int, ...] = (20, 20, 10)
    """Proposals of each class at most, so that classes with low scores are not crowded out."""

    def __post_init__(self) -> None:
        for name, value in (("score_threshold", self.score_threshold), ("nms_iou", self.nms_iou)):
            if not 0 <= value <= 1:
                raise ConfigError(f"{name} {value:g} of the proposals must lie between 0 and 1")
        for name, values in (("candidates", (self.candidates,)), ("quotas", self.quotas)):
            if min(values, default=0) < 1:
                raise ConfigError(f"{name} {list(values)} of the proposals must be at least 1")


def propose(
    maps: HeadMaps[NDArray[np.float32]],
    spec: DetectorSpec,
    settings: ProposalSettings,
    cells: NDArray[np.integer[Any]] | None = None,
) -> Detections:
    """Proposals of one scan, best first.

    Args:
        maps: logits and residuals (channels, H, W) of the detector that `spec` describes; its thresholds and
            suppression give way to those of `settings`.
        cells: (M,) flat index of the head cell of each row, if the maps are rows (M, channels).

    Raises:
        ValueError: not one quota for each class.
    """
    classes = tuple(replace(item, score_threshold=settings.score_threshold) for item in spec.classes)
    # Room for every candidate: the quotas choose, not a common limit.
    post = PostProcess(settings.nms_iou, settings.candidates, settings.candidates * len(classes))
    candidates = decode_candidates(maps, spec.anchors, classes, post, cells, spec.direction_offset_rad)
    return best_of_each_class(suppress(candidates, classes, post, max(settings.quotas)), settings.quotas)


def best_of_each_class(detections: Detections, quotas: Sequence[int]) -> Detections:
    """The best `quotas[label]` detections of each class, in the order in which they come.

    Raises:
        ValueError: not one quota for each class.
    """
    if len(quotas) != len(detections.class_names):
        raise ValueError(f"{len(quotas)} quotas for the {len(detections.class_names)} classes {detections.class_names}")
    kept: list[NDArray[np.int64]] = []
    for label, quota in enumerate(quotas):
        own = np.flatnonzero(detections.labels == label)
        kept.append(own[np.argsort(-detections.scores[own], kind="stable")[:quota]])
    return detections[np.sort(np.concatenate(kept))]
