"""Waymo's metric against a slow twin that tries every matching."""

from itertools import permutations, product
from math import ceil, pi

import numpy as np
import pytest

from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.waymo import (
    LEVELS,
    WaymoTruth,
)
from asca_pillars.geometry.overlap import iou_3d
from tests.evaluation.waymo_objects import NAMES, PEDESTRIAN, VEHICLE, box, score_of


def naive(truth: list[WaymoTruth], detections: list[Detections], name: str, level: int) -> tuple[float, float] | None:
    """AP and APH by doing for every cutoff and frame what the definition says, with every matching tried."""
    if not any(((t.labels == NAMES.index(name)) & (t.levels > 0) & (t.levels <= level)).any() for t in truth):
        return None
    points = []
    for cutoff in range(101):
        finds = false = missed = 0
        accuracy = 0.0
        for frame, seen in zip(truth, detections, strict=True):
            own = (frame.labels == NAMES.index(name)) & (frame.levels > 0)
            seen = seen[(seen.labels == NAMES.index(name)) & (seen.scores >= np.float32(cutoff * 0.01))]
            iou = iou_3d(seen.boxes, frame.boxes[own])
            iou[iou < (0.7 if name == "Vehicle" else 0.5)] = 0
            rows, columns = iou.shape
            padded = np.vstack([iou, np.zeros((columns, columns))])
            ways = permutations(range(rows + columns), columns)
            way = max(ways, key=lambda way: sum(padded[row, column] for column, row in enumerate(way)))
            pairs = [(row, column) for column, row in enumerate(way) if padded[row, column] > 0]
            finds += len(pairs)
            false += rows - len(pairs)
            for column, item_level in enumerate(frame.levels[own]):
                missed += item_level <= level and column not in [pair[1] for pair in pairs]
            for row, column in pairs:
                difference = abs(seen.boxes[row, 6] - frame.boxes[own][column, 6]) % (2 * pi)
                accuracy += 1 - min(difference, 2 * pi - difference) / pi
        if finds:
            points.append((finds / (finds + missed), finds / (finds + false), accuracy / (finds + false)))
    return area([point[:2] for point in points]), area([point[::2] for point in points])


def area(points: list[tuple[float, float]]) -> float:
    """Percent below the curve: precision on a fine staircase of recalls, each step judged at its middle."""
    recalls = sorted({recall for recall, _ in points})
    best = {recall: max(p for r, p in points if r >= recall) for recall in recalls}
    total = 0.0
    for lower, upper in zip([0.0, *recalls], recalls, strict=False):
        at_lower, at_upper = best.get(lower, best[recalls[0]]), best[upper]
        corner = upper - 0.05 * max(ceil((upper - lower - 1e-6) / 0.05) - 1, 0)
        for step in (np.arange(2000) + 0.5) / 2000:
            recall = lower + step * (upper - lower)
            slope = at_lower + (at_upper - at_lower) * (recall - lower) / (corner - lower)
            total += (upper - lower) / 2000 * (slope if recall < corner else at_upper)
    return 100 * total


def test_slow_twin() -> None:
    rng = np.random.default_rng(5)
    truth, detections = [], []
    for levels in ([1, 2, 1, 0], [2, 1, 1, 2], [1, 1, 2, 1]):
        labels = np.array([VEHICLE, VEHICLE, PEDESTRIAN, PEDESTRIAN])
        boxes = np.array([box(9, 0), box(9.2, 0.3), box(5, 5, PEDESTRIAN), box(5.2, 5, PEDESTRIAN)])
        boxes[:, 6] = rng.uniform(-pi, pi, 4)
        boxes[1, 6] = boxes[0, 6]
        truth.append(WaymoTruth(boxes.astype(np.float32), labels, np.array(levels)))
        copies = rng.integers(0, 4, 5)
        seen = boxes[copies] + rng.normal(0, 1, (5, 7)) * [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.2]
        detections.append(Detections(seen.astype(np.float32), rng.random(5).astype(np.float32), labels[copies], NAMES))
    for name, level in product(NAMES[:2], LEVELS):
        score = score_of(truth, detections, level, name=name)
        expected = naive(truth, detections, name, level)
        assert expected is not None and expected[0] > 5  # there is something to compare
        assert (score.ap, score.aph) == pytest.approx(expected, abs=0.01)
