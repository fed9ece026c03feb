"""Clusters without a label, and whether a detector fires at them."""

import numpy as np
import pytest

from asca_pillars.detection.detections import Detections
from asca_pillars.sim.report.like_for_like import connected, find_clusters, firing_rows

NAMES = ("Car", "Pedestrian", "Cyclist")
NONE = np.zeros((0, 7), np.float32)


def post(x: float, y: float, height: float, width: float, reflectance: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = 200
    xy = rng.uniform(-width / 2, width / 2, (count, 2)) * (0.7, 0.7) + (x, y)
    return np.column_stack([xy, rng.uniform(-1.7, -1.7 + height, count), np.full(count, reflectance)])


@pytest.fixture
def scan() -> np.ndarray:
    """Flat ground with a person-sized bright post, a tall thin one, and a wall."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(3, 40, 20_000), rng.uniform(-15, 15, 20_000)
    ground = np.column_stack([x, y, rng.normal(-1.7, 0.01, 20_000), np.full(20_000, 0.2)])
    wall = np.column_stack(
        [rng.uniform(10, 20, 2000), np.full(2000, 12.0), rng.uniform(-1.7, 1.3, 2000), np.full(2000, 0.3)]
    )
    parts = [ground, post(15, -5, 1.5, 0.6, 0.8), post(25, 5, 4.0, 0.4, 0.2), wall]
    return np.concatenate(parts).astype(np.float32)


def detections(x: float, y: float, score: float, label: int) -> Detections:
    box = np.array([[x, y, -1.0, 0.8, 0.6, 1.7, 0.0]], np.float32)
    return Detections(box, np.array([score], np.float32), np.array([label]), NAMES)


def kinds(scan: np.ndarray, found: Detections, labelled: np.ndarray = NONE, ignored: np.ndarray | None = None) -> dict:
    ignored = np.zeros(len(scan), bool) if ignored is None else ignored
    rows = firing_rows(find_clusters(scan, ignored, labelled, found), 1)
    return {row.kind: (row.clusters, row.share) for row in rows}


def test_clusters_are_connected_cells_told_by_size_and_brightness(scan: np.ndarray) -> None:
    found = kinds(scan, Detections.empty(NAMES))
    assert found["person"] == (1, 0.0) and found["tall"] == (1, 0.0) and found["bright"] == (1, 0.0)
    label = np.array([[15, -5, -0.9, 0.8, 0.8, 1.7, 0]], np.float32)
    assert kinds(scan, Detections.empty(NAMES), label)["person"][0] == 0
    assert kinds(scan, Detections.empty(NAMES), ignored=scan[:, 1] < 0)["person"][0] == 0
    xy = np.array([[0.1, 0.1], [0.3, 0.3], [0.6, 0.3], [2.0, 2.0], [2.1, 2.2]], np.float32)
    groups = connected(xy)
    assert groups[0] == groups[1] == groups[2] != groups[3] == groups[4]


@pytest.mark.parametrize(
    ("x", "score", "label", "share"),
    [(15.3, 0.5, 1, 1.0), (15.3, 0.5, 2, 1.0), (15.3, 0.3, 1, 0.0), (17.0, 0.9, 1, 0.0)],
)
def test_a_person_or_cyclist_of_enough_score_near_its_middle_fires(
    scan: np.ndarray, x: float, score: float, label: int, share: float
) -> None:
    assert kinds(scan, detections(x, -5.0, score, label))["person"] == (1, share)
    assert kinds(scan, detections(x, -5.0, score, 0))["person"] == (1, 0.0), "cars are another matter"
