"""What a second stage changes of a proposal, as seven residuals; an inverse pair (PV-RCNN, section 3.4)."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import decode_boxes, direction_bins, encode_boxes, wrap_angle
from asca_pillars.ops.two_stage.roi_grid import boxes_from_frames, boxes_in_frames


def encode_refinement(boxes: NDArray[np.floating[Any]], proposals: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Residuals of boxes[k] against proposals[k], metres and radians: (R, 7), (R, 7) -> (R, 7) float32.

    As an anchor's (`encode_boxes`), the proposal moved to the origin being the anchor; the heading difference lies in
    [-pi/2, pi/2), because refinement leaves it to the proposal which end is the front.
    """
    frames = proposals.astype(np.float64)
    seen = boxes_in_frames(boxes.astype(np.float64), frames)
    seen[:, 6] = wrap_angle(seen[:, 6], math.pi)
    return encode_boxes(seen, _at_origin(frames))[0]


def decode_refinement(
    residuals: NDArray[np.floating[Any]], proposals: NDArray[np.floating[Any]]
) -> NDArray[np.float32]:
    """Inverse of `encode_refinement`, up to half a turn: (R, 7), (R, 7) -> boxes (R, 7) float32.

    Boxes in metres and radians, in the frame of the proposals. Size ratios are held within 1/100 and 100.
    """
    frames = proposals.astype(np.float64)
    seen = decode_boxes(residuals, direction_bins(residuals[:, 6].astype(np.float64)), _at_origin(frames))
    return boxes_from_frames(seen.astype(np.float64), frames).astype(np.float32)


def _at_origin(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = boxes.copy()
    moved[:, [0, 1, 2, 6]] = 0
    return moved
