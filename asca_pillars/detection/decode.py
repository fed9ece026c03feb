"""Decoding of head maps to Detections: thresholds, box decoding, non-maximum suppression."""

import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.base.strict import Strict
from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD, ClassSpec
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import DIRECTION_OFFSET_RAD, decode_boxes, wrap_angle

KERNELS = "asca_pillars.geometry.nms_kernels"

LEAST_LOGIT = -1e3
"""Least logit of a detection; its score is 0 in every type. A masked neck's inactive cells lie below."""

VOTE_SCORE = 0.1
"""Score from which on a box votes, reported or not, so that score thresholds do not move boxes."""

MOST = 2**31 - 1
"""Upper bound of counts in settings: the largest 32-bit index."""


@dataclass(frozen=True)
class PostProcess(Strict):
    """Settings for decoding head maps into detections."""

    nms_iou: float = 0.01
    """BEV IoU of two boxes of a class above which NMS keeps only the better one."""
    candidates: int = 1000
    """Best boxes of each class that enter the suppression."""
    max_detections: int = 100
    """Best boxes of a scan that are reported."""
    vote_iou: float | None = None
    """BEV IoU from which on a suppressed box has a vote on the one that is kept, see `vote_boxes`; None: none has."""

    def __post_init__(self) -> None:
        for name in ("nms_iou", "vote_iou"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise ConfigError(f"{name} {value:g} must lie between 0 and 1")
        for name in ("candidates", "max_detections"):
            if not 1 <= getattr(self, name) <= MOST:
                raise ConfigError(f"{name} {reprlib.repr(getattr(self, name))} must lie between 1 and {MOST}")


Map = TypeVar("Map")


class HeadMaps(NamedTuple, Generic[Map]):
    """Outputs of the head for one scan (NumPy arrays), or for a batch (tensors, with a leading axis B).

    Channels are anchor-major, A anchors as in `make_anchors`. Where the head computes at active cells alone, there
    are rows (M, channels) instead of maps (channels, H, W), one for each of these cells.
    """

    scores: Map
    """(A, H, W) logits: an anchor belongs to one class, so it has one. Where it has one for each of C classes,
    (A * C, H, W), those of an anchor side by side."""
    boxes: Map
    """(7A, H, W) residuals; those of anchor a are channels 7a..7a+6."""
    directions: Map
    """(2A, H, W) logits of the direction bins; those of anchor a are channels 2a and 2a+1."""


class Candidates(NamedTuple):
    """Decoded boxes that enter suppression, class by class, the best of each class first.

    Where boxes vote, those from VOTE_SCORE on are among them.
    """

    boxes: NDArray[np.float32]
    """(n, 7), LiDAR frame."""
    logits: NDArray[np.float32]
    """(n,)"""
    labels: NDArray[np.int64]
    """(n,) indices into the classes."""
    non_finite: int
    """Anchors that were left out because their numbers are not finite."""


def decode(
    maps: HeadMaps[NDArray[np.float32]],
    anchors: NDArray[np.float32],
    classes: tuple[ClassSpec, ...],
    post: PostProcess,
    cells: NDArray[np.integer[Any]] | None = None,
    direction_offset_rad: float = DIRECTION_OFFSET_RAD,
) -> Detections:
    """Decode the detections of one scan, best first.

    Per class: the anchors whose score reaches the class's threshold, the best `candidates` of them, decoded, rotated
    BEV NMS. With `vote_iou` anchors from VOTE_SCORE on take part, too, and vote on the boxes. Then the best
    `max_detections` of all classes. Anchors whose numbers are not finite, from a network that overflowed, are left out
    and counted (`Detections.non_finite`).

    Args:
        maps: logits and residuals on the head's map.
        anchors: (H, W, A, 7) from `make_anchors` for the same grid and classes.
        cells: (M,) flat index of the head cell of each of the maps' rows, ascending; None if they are maps.
        direction_offset_rad: where direction bin 0 begins, see `DetectorSpec`.

    Raises:
        ValueError: if maps, anchors and classes do not belong together.
    """
    return suppress(decode_candidates(maps, anchors, classes, post, cells, direction_offset_rad), classes, post)


def decode_candidates(
    maps: HeadMaps[NDArray[np.float32]],
    anchors: NDArray[np.float32],
    classes: tuple[ClassSpec, ...],
    post: PostProcess,
    cells: NDArray[np.integer[Any]] | None = None,
    direction_offset_rad: float = DIRECTION_OFFSET_RAD,
) -> Candidates:
    """Return candidates that reach their class's threshold, or VOTE_SCORE where boxes vote, for `suppress`.

    Raises:
        ValueError: if maps, anchors and classes do not belong together.
    """
    height, width, count, _ = anchors.shape
    per_anchor = len(classes) if maps.scores.shape[0 if cells is None else 1] > count else 1
    expected = tuple(
        (channels * count, height, width) if cells is None else (len(cells), channels * count)
        for channels in (per_anchor, 7, 2)
    )
    if tuple(m.shape for m in maps) != expected or count != len(classes) * len(ANCHOR_YAWS_RAD):
        raise ValueError(
            f"head maps of {len(classes)} classes on anchors {anchors.shape} must have shapes {expected}, "
            f"not {tuple(m.shape for m in maps)}"
        )
    rows = maps if cells is not None else HeadMaps(*(part.reshape(len(part), -1).T for part in maps))
    scores, labels = rows.scores, None
    if per_anchor > 1:
        every = scores.reshape(-1, count, per_anchor)
        scores, labels = every.max(axis=2), every.argmax(axis=2)  # one that is not a number stays so
    least = [class_spec.score_threshold for class_spec in classes]
    if post.vote_iou is not None:
        least = [min(score, VOTE_SCORE) for score in least]
    anchor, row = _candidates(scores, labels, least, post.candidates)
    cell = row if cells is None else cells[row]
    logits = scores[row, anchor]
    residuals = rows.boxes.reshape(-1, count, 7)[row, anchor]
    directions = rows.directions.reshape(-1, count, 2)[row, anchor]
    with np.errstate(over="ignore", invalid="ignore"):  # overflows are left out below
        chosen_anchors = anchors.reshape(-1, count, 7)[cell, anchor]
        boxes = decode_boxes(residuals, directions.argmax(axis=-1), chosen_anchors, direction_offset_rad)
    usable = np.isfinite(boxes).all(axis=1) & np.isfinite(directions).all(axis=1) & np.isfinite(logits)
    dropped = np.count_nonzero(~usable & np.isfinite(logits))
    return Candidates(
        boxes[usable],
        logits[usable],
        _labels(anchor, row, labels)[usable],
        int(maps.scores.size - np.count_nonzero(np.isfinite(maps.scores)) + dropped),
    )


def suppress(
    candidates: Candidates, classes: tuple[ClassSpec, ...], post: PostProcess, most: int | None = None
) -> Detections:
    """Suppress (n, 7) candidates by the rotated NMS of their class, the second half of `decode`; best first.

    At most `most` of each class are kept. With `post.vote_iou` the others vote on their boxes; those below their
    class's threshold only do that.
    """
    boxes, logits, labels, non_finite = candidates
    limit = post.max_detections if most is None else min(most, post.max_detections)
    survivors = nms_by_class(boxes, logits, labels, post.nms_iou, limit)
    thresholds = np.array([_logit(spec.score_threshold) for spec in classes])
    survivors = survivors[logits[survivors] >= thresholds[labels[survivors]]]
    best = survivors[np.argsort(-logits[survivors], kind="stable")[: post.max_detections]]
    scores = sigmoid(logits)
    return Detections(
        vote_boxes(boxes, scores, labels, best, post.vote_iou),
        scores[best],
        labels[best],
        tuple(spec.name for spec in classes),
        non_finite=non_finite,
    )


def nms_by_class(
    boxes: NDArray[np.floating[Any]],
    scores: NDArray[np.floating[Any]],
    labels: NDArray[np.int64],
    iou_threshold: float,
    limit: int | None = None,
) -> NDArray[np.int64]:
    """Apply `rotated_nms` within each class: (N, 7), (N,), (N,) -> indices of the kept boxes, class after class."""
    kept = [np.empty(0, np.int64)]
    for label in np.unique(labels):
        of_class = np.flatnonzero(labels == label)
        kept.append(of_class[rotated_nms(boxes[of_class], scores[of_class], iou_threshold, limit)])
    return np.concatenate(kept)


def rotated_nms(
    boxes: NDArray[np.floating[Any]], scores: NDArray[np.floating[Any]], iou_threshold: float, limit: int | None = None
) -> NDArray[np.int64]:
    """Return indices of the boxes that greedy NMS by `bev_iou` keeps, by descending score, at most `limit`.

    A box is dropped if a kept, better one overlaps it by more than `iou_threshold`. Of equal scores the
    earlier goes first.

    Args:
        boxes: (N, 7), LiDAR frame; N may be 0.
        scores: (N,), any monotonic measure.
    """
    order = np.argsort(-scores, kind="stable")
    nms = load_kernels(KERNELS).nms
    return order[nms(boxes[order].astype(np.float64, order="C"), iou_threshold, len(boxes) if limit is None else limit)]


def vote_boxes(
    boxes: NDArray[np.float32],
    scores: NDArray[np.float32],
    labels: NDArray[np.int64],
    kept: NDArray[np.int64],
    iou_threshold: float | None,
) -> NDArray[np.float32]:
    """Return the kept boxes (K, 7), each the weighted mean of the boxes of its class that overlap it (box voting).

    A box votes from a BEV IoU of `iou_threshold` with the kept one on, with the square of its score times this IoU
    (Gidaris and Komodakis, arXiv 1505.01749, where the score alone is the weight). Headings are averaged modulo
    half a turn: which end is the front stays.

    Args:
        boxes: (N, 7), LiDAR frame, finite.
        scores: (N,) in [0, 1].
        labels: (N,) indices into the classes.
        kept: (K,) rows of `boxes` that suppression kept.
        iou_threshold: None leaves the boxes as they are.
    """
    if iou_threshold is None or not len(kept):
        return boxes[kept]
    vote = load_kernels(KERNELS).vote
    weights = scores.astype(np.float64) ** 2
    voted = vote(boxes.astype(np.float64), weights, labels, kept, iou_threshold).astype(np.float32)
    voted[:, 6] = wrap_angle(voted[:, 6])
    return voted  # type: ignore[no-any-return]


def _candidates(
    scores: NDArray[np.float32], labels: NDArray[np.int64] | None, least: Sequence[float], limit: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return anchor (n,) and row (n,) in scores (M, A) of the best anchors of each class, class by class, best first.

    `labels` (M, A) are the classes of the scores; None: each anchor's class. `least` is the lowest score of each class.

    Of equal scores that of the earlier anchor goes first, and among those that of the earlier row.
    """
    count = scores.shape[1]
    # The backbone's maps lie in memory with the channels last: no copy, and one look at every logit. Logits are
    # compared rather than scores: the sigmoid is monotonic, and few anchors ever need it.
    logits = scores.reshape(-1)
    floors = [_logit(score) for score in least]
    above = np.flatnonzero(logits >= min(floors))
    logits = logits[above]
    row, anchor = np.divmod(above, count)
    own_class, chosen = _labels(anchor, row, labels), []
    for label, floor in enumerate(floors):
        of_class = np.flatnonzero((own_class == label) & (logits >= floor))
        if len(of_class) > limit:
            of_class = of_class[logits[of_class] >= np.partition(logits[of_class], -limit)[-limit]]
        chosen.append(of_class[np.lexsort((row[of_class], anchor[of_class], -logits[of_class]))[:limit]])
    best = np.concatenate(chosen)
    return anchor[best], row[best]


def _labels(anchor: NDArray[np.int64], row: NDArray[np.int64], labels: NDArray[np.int64] | None) -> NDArray[np.int64]:
    """Return the classes (n,) in `labels` (M, A) of anchors (n,) in rows (n,), see `_candidates`."""
    return anchor // len(ANCHOR_YAWS_RAD) if labels is None else labels[row, anchor]


def _logit(probability: float) -> float:
    if probability <= 0:
        return LEAST_LOGIT
    return math.inf if probability >= 1 else math.log(probability / (1 - probability))


def sigmoid(logits: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return scores in [0, 1] from logits of any shape."""
    return np.exp(-np.logaddexp(0.0, -logits.astype(np.float64))).astype(np.float32)
