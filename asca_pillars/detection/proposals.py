"""Decoding of head maps to proposals for a second stage, with a quota for each class or regardless of class."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import HeadMaps, PostProcess, decode_candidates, rotated_nms, sigmoid, suppress
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import decode_boxes


@dataclass(frozen=True)
class ProposalSettings(Strict):
    """Settings for decoding a first stage's head maps into proposals."""

    score_threshold: float = 0.05
    """Score threshold of every class: the second stage rescores proposals, and cannot recover missing ones."""
    nms_iou: float = 0.7
    """BEV IoU of two boxes of a class up to which both are proposed."""
    candidates: int = 300
    """Best boxes of each class that enter the suppression."""
    quotas: tuple[int, ...] = (20, 20, 10)
    """Maximum of proposals for each class, so that classes with low scores are not crowded out."""

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
    """Return the proposals of one scan, best first.

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
    """Return the best `quotas[label]` detections of each class, in the order in which they come.

    Raises:
        ValueError: not one quota for each class.
    """
    if len(quotas) != len(detections.class_names):
        raise ValueError(f"{len(quotas)} quotas for the {len(detections.class_names)} classes {detections.class_names}")
    kept: list[NDArray[np.int64]] = []
    for label, quota in enumerate(quotas):
        of_class = np.flatnonzero(detections.labels == label)
        kept.append(of_class[np.argsort(-detections.scores[of_class], kind="stable")[:quota]])
    return detections[np.sort(np.concatenate(kept))]


@dataclass(frozen=True)
class AnchorProposals(Strict):
    """Settings for decoding head maps into proposals of any class; the defaults are PV-RCNN's at inference.

    Attributes:
        candidates: anchors that enter the suppression, by the best of their scores.
        nms_iou: BEV IoU of two boxes up to which both are proposed.
        count: of the proposals at most.
    """

    candidates: int = 1024
    nms_iou: float = 0.7
    count: int = 100

    def __post_init__(self) -> None:
        if not 0 <= self.nms_iou <= 1:
            raise ConfigError(f"nms_iou {self.nms_iou:g} of the proposals must lie between 0 and 1")
        if min(self.candidates, self.count) < 1:
            raise ConfigError(
                f"candidates {self.candidates} and count {self.count} of the proposals must be at least 1"
            )


def propose_anchors(maps: HeadMaps[NDArray[np.float32]], spec: DetectorSpec, settings: AnchorProposals) -> Detections:
    """Return the proposals of one scan, best first, each of the class of its anchor's best score.

    Anchors whose numbers are not finite are left out and counted.

    Args:
        maps: scores (A * classes, H, W) with the classes of an anchor side by side, boxes (7A, H, W), directions
            (2A, H, W).
        spec: anchors and classes.
        settings: how many.

    Raises:
        ValueError: the maps do not belong to these anchors and classes.
    """
    height, width, count, _ = spec.anchors.shape
    classes = len(spec.classes)
    expected = [(channels * count, height, width) for channels in (classes, 7, 2)]
    if [part.shape for part in maps] != expected:
        raise ValueError(f"head maps must have shapes {expected}, not {[part.shape for part in maps]}")
    scores, residuals, directions = (
        part.reshape(len(part), -1).T.reshape(-1, len(part) // count) for part in maps
    )  # (anchors, channels)
    best = scores.max(axis=1)
    finite = np.isfinite(best)
    chosen = _best(np.where(finite, best, -np.inf), min(settings.candidates, int(finite.sum())))
    with np.errstate(over="ignore", invalid="ignore"):  # overflows are left out below
        bins, anchors = directions[chosen].argmax(axis=1), spec.anchors.reshape(-1, 7)[chosen]
        boxes = decode_boxes(residuals[chosen], bins, anchors, spec.direction_offset_rad)
    usable = np.isfinite(boxes).all(axis=1) & np.isfinite(directions[chosen]).all(axis=1)
    lost = int((~finite).sum() + (~usable).sum())
    boxes, chosen = boxes[usable], chosen[usable]
    kept = rotated_nms(boxes, best[chosen], settings.nms_iou, settings.count)
    rows = chosen[kept]
    labels = scores[rows].argmax(axis=1)
    return Detections(boxes[kept], sigmoid(best[rows]), labels, spec.class_names, non_finite=lost)


def _best(scores: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Return rows of the `count` largest scores, best first; of equal ones the earlier."""
    if count == 0:
        return np.empty(0, np.int64)
    rows = np.flatnonzero(scores >= np.partition(scores, len(scores) - count)[len(scores) - count])
    return rows[np.argsort(-scores[rows], kind="stable")[:count]]
