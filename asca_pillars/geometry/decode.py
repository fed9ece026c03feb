"""Head maps -> Detections: threshold, decode, non-maximum suppression. The last stop of every runtime."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ConfigError
from asca_pillars.geometry.anchors import ANCHOR_YAWS_RAD, ClassSpec, decode_boxes
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.overlap import rotated_nms


@dataclass(frozen=True)
class PostProcess:
    """How head maps become detections."""

    nms_iou: float = 0.01
    """Of two boxes of a class whose footprints overlap more than this, the better one stays."""
    candidates: int = 1000
    """Best boxes of each class that enter the suppression."""
    max_detections: int = 100
    """Best boxes of a scan that are reported."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not 0 <= self.nms_iou <= 1:
            raise ConfigError(f"nms_iou {self.nms_iou:g} must lie between 0 and 1")
        for name in ("candidates", "max_detections"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} {getattr(self, name)} must be at least 1")


Map = TypeVar("Map")


class HeadMaps(NamedTuple, Generic[Map]):
    """What the head says of one scan (NumPy arrays) or of a batch of them (tensors, with a leading axis B).

    Channels are anchor-major, A anchors as in `make_anchors`.
    """

    scores: Map
    """(A, H, W) logits; an anchor belongs to one class, so it has one."""
    boxes: Map
    """(7A, H, W) residuals; those of anchor a are channels 7a..7a+6."""
    directions: Map
    """(2A, H, W) logits of the direction bins; those of anchor a are channels 2a and 2a+1."""


def decode(
    maps: HeadMaps[NDArray[np.float32]],
    anchors: NDArray[np.float32],
    classes: tuple[ClassSpec, ...],
    post: PostProcess,
) -> Detections:
    """Detections of one scan, best first.

    Per class: the anchors whose score reaches the class's threshold, the best `candidates` of them, decoded,
    rotated NMS seen from above. Then the best `max_detections` of all classes. Boxes that are not finite,
    from a network whose numbers overflowed, are left out: nobody can use them.

    Args:
        maps: logits and residuals on the head's map.
        anchors: (H, W, A, 7) from `make_anchors` for the same grid and classes.

    Raises:
        ValueError: if maps, anchors and classes do not belong together.
    """
    height, width, count, _ = anchors.shape
    expected = tuple((channels * count, height, width) for channels in (1, 7, 2))
    if tuple(m.shape for m in maps) != expected or count != len(classes) * len(ANCHOR_YAWS_RAD):
        raise ValueError(
            f"head maps of {len(classes)} classes on anchors {anchors.shape} must have shapes {expected}, "
            f"not {tuple(m.shape for m in maps)}"
        )
    names = tuple(spec.name for spec in classes)
    found = [_decode_class(maps, anchors, label, spec, post) for label, spec in enumerate(classes)]
    boxes = np.concatenate([boxes for boxes, _ in found])
    logits = np.concatenate([logits for _, logits in found])
    labels = np.repeat(np.arange(len(classes), dtype=np.int64), [len(logits) for _, logits in found])
    best = np.argsort(-logits, kind="stable")[: post.max_detections]
    return Detections(boxes[best], _sigmoid(logits[best]), labels[best], names)


def _decode_class(
    maps: HeadMaps[NDArray[np.float32]],
    anchors: NDArray[np.float32],
    label: int,
    spec: ClassSpec,
    post: PostProcess,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n, 7) boxes and (n,) logits of one class after suppression, best first."""
    height, width, count, _ = anchors.shape
    yaws = len(ANCHOR_YAWS_RAD)
    first = label * yaws
    # Logits are compared rather than scores: the sigmoid is monotonic, and few anchors ever need it.
    logits = maps.scores[first : first + yaws].reshape(-1)
    survivors = np.flatnonzero(logits >= _logit(spec.score_threshold))
    survivors = survivors[np.argsort(-logits[survivors], kind="stable")[: post.candidates]]

    yaw, cell = np.divmod(survivors, height * width)
    anchor = first + yaw
    residuals = maps.boxes.reshape(count, 7, -1)[anchor, :, cell]
    direction = maps.directions.reshape(count, 2, -1)[anchor, :, cell].argmax(axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is left out below
        boxes = decode_boxes(residuals, direction, anchors.reshape(-1, count, 7)[cell, anchor])
    usable = np.isfinite(boxes).all(axis=1)
    boxes, logits = boxes[usable], logits[survivors[usable]]
    kept = rotated_nms(boxes, logits, post.nms_iou)
    return boxes[kept], logits[kept]


def _logit(probability: float) -> float:
    if probability <= 0:
        return -math.inf
    return math.inf if probability >= 1 else math.log(probability / (1 - probability))


def _sigmoid(logits: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    return np.exp(-np.logaddexp(0.0, -logits.astype(np.float64))).astype(np.float32)
