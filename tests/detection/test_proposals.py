"""Quotas of proposals."""

from dataclasses import replace

import numpy as np
import pytest

from asca_pillars.detection.decode import HeadMaps, PostProcess, decode
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.proposals import ProposalSettings, best_of_each_class, propose
from tests.helpers.scenes import SPEC


def found(labels: list[int], scores: list[float]) -> Detections:
    boxes = np.arange(len(labels), dtype=np.float32)[:, None] * np.ones(7, np.float32)
    return Detections(boxes, np.array(scores, np.float32), np.array(labels, np.int64), ("Car", "Cyclist"))


def test_each_class_has_its_own_quota() -> None:
    kept = best_of_each_class(found([0, 0, 1, 0, 1, 1], [0.9, 0.8, 0.7, 0.6, 0.1, 0.2]), (2, 2))
    assert kept.boxes[:, 0].tolist() == [0, 1, 2, 5]


def test_nothing_and_less_than_the_quota() -> None:
    assert len(best_of_each_class(Detections.empty(("Car", "Cyclist")), (5, 5))) == 0
    assert len(best_of_each_class(found([1], [0.1]), (5, 5))) == 1


def test_one_quota_for_each_class() -> None:
    with pytest.raises(ValueError, match="1 quotas for the 2 classes"):
        best_of_each_class(found([1], [0.1]), (5,))


def test_suppression_that_stops_at_the_quotas_proposes_the_same() -> None:
    height, width, count, _ = SPEC.anchors.shape
    rng = np.random.default_rng(0)
    maps = HeadMaps(*(rng.normal(0, 0.3, (n * count, height, width)).astype(np.float32) for n in (1, 7, 2)))
    settings = ProposalSettings(score_threshold=0.3, candidates=200, quotas=(7, 3, 5))
    classes = tuple(replace(item, score_threshold=0.3) for item in SPEC.classes)
    everything = decode(maps, SPEC.anchors, classes, PostProcess(settings.nms_iou, 200, 600))
    expected, found = best_of_each_class(everything, settings.quotas), propose(maps, SPEC, settings)
    assert len(everything) > 100 and np.bincount(found.labels).tolist() == [7, 3, 5]
    assert found.boxes.tobytes() == expected.boxes.tobytes() and found.scores.tobytes() == expected.scores.tobytes()
