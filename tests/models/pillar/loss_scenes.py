"""Head maps and targets of a small scene."""

import numpy as np
import torch
from torch import Tensor

from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.targets import Targets, assign_targets
from asca_pillars.models.pillar.loss import TargetBatch
from tests.helpers.scenes import SPEC, make_scene

ROWS, COLUMNS, COUNT, _ = SPEC.anchors.shape
NO_TARGETS = Targets(
    np.zeros((ROWS, COLUMNS, COUNT), np.int8),
    np.empty(0, np.int64),
    np.empty((0, 7), np.float32),
    np.empty((0, 7), np.float32),
    np.empty(0, np.int64),
    np.empty(0, np.int64),
)


def scene_targets(seed: int) -> tuple[np.ndarray, np.ndarray, Targets]:
    """Boxes, labels and targets of a made-up scene."""
    _, boxes, names = make_scene(seed)
    labels = np.array([SPEC.class_names.index(name) for name in names])
    return boxes, labels, assign_targets(SPEC.anchors, SPEC.classes, boxes, labels)


def batched(frames: list[Targets]) -> TargetBatch:
    """Stacked by hand, frame after frame."""
    positives = [index + ROWS * COLUMNS * COUNT * i for i, frame in enumerate(frames) for index in frame.positives]
    return TargetBatch(
        state=torch.tensor(np.stack([frame.state for frame in frames])),
        positives=torch.tensor(positives, dtype=torch.int64),
        anchors=torch.tensor(np.concatenate([frame.anchors for frame in frames])),
        residuals=torch.tensor(np.concatenate([frame.residuals for frame in frames])),
        directions=torch.tensor(np.concatenate([frame.directions for frame in frames])),
    )


def perfect_maps(frames: list[Targets], margin: float = 30.0) -> HeadMaps[Tensor]:
    """Maps that say of each anchor what its target is, written channel by channel as `HeadMaps` describes them."""
    scores = np.full((len(frames), COUNT, ROWS, COLUMNS), -margin, np.float32)
    boxes = np.zeros((len(frames), 7 * COUNT, ROWS, COLUMNS), np.float32)
    directions = np.zeros((len(frames), 2 * COUNT, ROWS, COLUMNS), np.float32)
    for i, frame in enumerate(frames):
        found = np.argwhere(frame.state == 1)
        for (row, column, anchor), residual, direction in zip(found, frame.residuals, frame.directions, strict=True):
            scores[i, anchor, row, column] = margin
            boxes[i, 7 * anchor : 7 * anchor + 7, row, column] = residual
            directions[i, 2 * anchor + direction, row, column] = margin
    return HeadMaps(torch.from_numpy(scores), torch.from_numpy(boxes), torch.from_numpy(directions))


def noisy_maps(frames: int) -> HeadMaps[Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = [(frames, values * COUNT, ROWS, COLUMNS) for values in (1, 7, 2)]
    return HeadMaps(*(torch.randn(shape, generator=generator).requires_grad_() for shape in shapes))
