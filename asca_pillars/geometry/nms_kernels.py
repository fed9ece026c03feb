"""Loops of `rotated_nms` and `vote_boxes`, compiled; tests/ops/numpy_kernels.py has the first one's NumPy version.

The cosine of the angle between two boxes is computed from their own sines and cosines, so overlaps differ in their
last digits: the same boxes are kept unless an overlap is within 1e-12 or so of the threshold.
"""

import math

import numpy as np
from numba import types

from asca_pillars.base.compiling import compiled, in_array, inner, out_array
from asca_pillars.geometry.boxes import Floats, Ints


def nms(boxes: Floats, iou_threshold: float, limit: int) -> Ints:
    """Suppress boxes one by one, as `numpy_kernels._nms`: boxes (N, 7), best first -> indices (K,) of those kept."""
    kept = np.empty(len(boxes), np.int64)
    count = _nms(boxes, iou_threshold, limit, np.empty((len(boxes), 3)), np.empty((len(boxes), 5)), kept)
    return kept[:count]


def vote(boxes: Floats, weights: Floats, labels: Ints, kept: Ints, iou_threshold: float) -> Floats:
    """Average boxes (N, 7) as `vote_boxes` -> (K, 7) for the rows `kept` (K,) of them."""
    voted = np.empty((len(kept), 7))
    _vote(boxes, weights, labels, kept, iou_threshold, voted)
    return voted


@inner
def _within(value: float, limit: float) -> float:
    return -limit if value < -limit else (limit if value > limit else value)


@inner
def _share(part: float, whole: float) -> float:
    share = part / whole if abs(part) < abs(whole) else 1.0
    return share if share > 0.0 else 0.0


@inner
def _shared_area(x: float, y: float, cos: float, sin: float, al: float, aw: float, bl: float, bw: float) -> float:
    """Return `paired_bev_intersection` of a with half extents al, aw in the frame of b with half extents bl, bw."""
    cos_abs, sin_abs = abs(cos), abs(sin)
    if (
        abs(x) >= bl + cos_abs * al + sin_abs * aw
        or abs(y) >= bw + sin_abs * al + cos_abs * aw
        or abs(cos * x + sin * y) >= al + cos_abs * bl + sin_abs * bw
        or abs(cos * y - sin * x) >= aw + sin_abs * bl + cos_abs * bw
    ):
        return 0.0
    area = 0.0
    along, across = al, aw
    x0, y0 = x + cos * along - sin * across, y + sin * along + cos * across
    for corner in range(4):
        if corner % 2 == 0:
            along = -along
        else:
            across = -across
        x1, y1 = x + cos * along - sin * across, y + sin * along + cos * across
        left, right = _within(x0, bl), _within(x1, bl)
        y_left = y0 + (y1 - y0) * _share(left - x0, x1 - x0)
        y_right = y1 - (y1 - y0) * _share(x1 - right, x1 - x0)
        low, high = _within(y_left, bw), _within(y_right, bw)
        before = _share(abs(y_left - low), abs(y_right - y_left))
        after = _share(abs(y_right - high), abs(y_right - y_left))
        area -= (right - left) * ((low + high) / 2 + (before - after) * (low - high) / 2)
        x0, y0 = x1, y1
    return min(max(area, 0.0), 4 * min(al * aw, bl * bw))


@compiled(
    *(in_array(types.float64, 2), types.float64, types.int64),
    *(out_array(types.float64, 2), out_array(types.float64, 2), out_array(types.int64)),
)
def _nms(boxes: Floats, iou_threshold: float, limit: int, circles: Floats, shapes: Floats, kept: Ints) -> int:
    """Write the indices of kept boxes and return their number.

    `circles` holds x, y and radius of the kept boxes; `shapes` half length, half width, area, cosine and sine.
    """
    count = 0
    for i in range(len(boxes)):
        if count == limit:
            break
        x, y, bl, bw, area = boxes[i, 0], boxes[i, 1], boxes[i, 3] / 2, boxes[i, 4] / 2, boxes[i, 3] * boxes[i, 4]
        cos, sin, reach = math.cos(boxes[i, 6]), math.sin(boxes[i, 6]), math.hypot(bl, bw)
        clash = False
        for k in range(count):
            dx, dy, reaches = circles[k, 0] - x, circles[k, 1] - y, circles[k, 2] + reach
            if dx * dx + dy * dy < reaches * reaches:
                al, aw, a_cos, a_sin = shapes[k, 0], shapes[k, 1], shapes[k, 3], shapes[k, 4]
                turn_cos, turn_sin = a_cos * cos + a_sin * sin, a_sin * cos - a_cos * sin
                shared = _shared_area(cos * dx + sin * dy, cos * dy - sin * dx, turn_cos, turn_sin, al, aw, bl, bw)
                union = shapes[k, 2] + area - shared
                if union > 0 and shared / union > iou_threshold:
                    clash = True
                    break
        if not clash:
            circles[count, 0], circles[count, 1], circles[count, 2] = x, y, reach
            shapes[count, 0], shapes[count, 1], shapes[count, 2] = bl, bw, area
            shapes[count, 3], shapes[count, 4] = cos, sin
            kept[count] = i
            count += 1
    return count


@compiled(
    *(in_array(types.float64, 2), in_array(types.float64), in_array(types.int64), in_array(types.int64)),
    *(types.float64, out_array(types.float64, 2)),
)
def _vote(boxes: Floats, weights: Floats, labels: Ints, kept: Ints, iou_threshold: float, voted: Floats) -> None:
    for row in range(len(kept)):
        best = kept[row]
        al, aw, yaw = boxes[best, 3] / 2, boxes[best, 4] / 2, boxes[best, 6]
        cos, sin, reach = math.cos(yaw), math.sin(yaw), math.hypot(al, aw)
        total = weights[best]
        voted[row] = 0.0  # sums of weighted differences from the kept box
        for k in range(len(boxes)):
            bl, bw = boxes[k, 3] / 2, boxes[k, 4] / 2
            dx, dy, reaches = boxes[k, 0] - boxes[best, 0], boxes[k, 1] - boxes[best, 1], math.hypot(bl, bw) + reach
            if k == best or labels[k] != labels[best] or dx * dx + dy * dy >= reaches * reaches:
                continue
            turn = boxes[k, 6] - yaw
            # The other box in the frame of the kept one.
            x, y = cos * dx + sin * dy, cos * dy - sin * dx
            shared = _shared_area(x, y, math.cos(turn), math.sin(turn), bl, bw, al, aw)
            union = 4 * (al * aw + bl * bw) - shared
            if not (union > 0 and shared / union >= iou_threshold):
                continue
            weight = weights[k] * shared / union
            total += weight
            for axis in range(6):
                voted[row, axis] += weight * (boxes[k, axis] - boxes[best, axis])
            # Half a turn does not change a footprint: the kept box alone says which end is the front.
            voted[row, 6] += weight * (turn - math.pi * math.floor(turn / math.pi + 0.5))
        for axis in range(7):
            voted[row, axis] = boxes[best, axis] + (voted[row, axis] / total if total > 0 else 0.0)
