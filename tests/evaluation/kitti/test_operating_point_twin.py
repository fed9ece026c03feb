"""Counts at a fixed score against a slow twin."""

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.score_threshold import operating_points
from asca_pillars.geometry.overlap import bev_iou, iou_3d
from tests.evaluation.kitti.scored_frames import NAMES, frame, item


def camera_boxes(objects: list[KittiObject]) -> np.ndarray:
    """(N, 7) with z up: x right, y = z forward, z = -y; rotation_y about the downward axis is -yaw."""
    rows = [(o.x_m, o.z_m, o.height_m / 2 - o.y_m, o.length_m, o.width_m, o.height_m, -o.rotation_y) for o in objects]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def naive(
    frames: list[tuple[list[KittiObject], list[KittiObject]]], name: str, metric: str, band: tuple[float, float]
) -> tuple[int, ...]:
    """found, objects; true, detections; ignored: one object and one detection after the other, from score 0.3 on."""
    totals = np.zeros(5, dtype=int)

    def inside(one: KittiObject) -> bool:
        return band[0] <= math.hypot(one.x_m, one.z_m) < band[1]

    for labels, seen in frames:
        left = [o for o in labels if o.type in (name, {"Car": "Van", "Pedestrian": "Person_sitting"}.get(name))]
        counts = {
            o: o.type == name and o.bbox[3] - o.bbox[1] >= 25 and o.occluded <= 1 and o.truncated <= 0.3 for o in left
        }
        totals[1] += sum(counts[o] and inside(o) for o in left)
        for score, detection in sorted(((d.score or 0, d) for d in seen if d.type == name), key=lambda pair: -pair[0]):
            if score < 0.3:
                continue
            overlap = (iou_3d if metric == "3d" else bev_iou)(camera_boxes([detection]), camera_boxes(left))[0]
            if overlap.max(initial=0) > (0.7 if name == "Car" else 0.5):
                best = left.pop(int(overlap.argmax()))
                totals[0] += counts[best] and inside(best)
                totals[2:4] += counts[best] and inside(detection)
                totals[4] += inside(detection) and not counts[best]
            else:
                low = detection.bbox[3] - detection.bbox[1] < 25
                totals[3:] += inside(detection) * np.array([not low, low])
    return tuple(totals.tolist())


KINDS = ["Car", "Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck"]


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["3d", "bev"]))
def test_slow_twin(seed: int, metric: Literal["3d", "bev"]) -> None:
    rng = np.random.default_rng(seed)

    def image() -> tuple[float, ...]:
        return (0.0, 0.0, 50.0, float(rng.uniform(15, 60)))

    frames = []
    for _ in range(3):
        labels = []
        for _ in range(int(rng.integers(0, 8))):
            hidden, turn = int(rng.integers(0, 3)), float(rng.uniform(-3, 3))
            changes: dict[str, Any] = {"occluded": hidden, "rotation_y": turn, "bbox": image()}
            labels.append(item(str(rng.choice(KINDS)), *rng.uniform((-2, 8), (2, 12)), **changes))
        seen = []
        for o in labels * 2:
            kind = {"Van": "Car", "Person_sitting": "Pedestrian"}.get(o.type, o.type)
            x, y = (place + float(rng.normal(0, 0.1)) for place in (o.x_m, o.y_m))
            seen.append(replace(o, type=kind, x_m=x, y_m=y, bbox=image(), score=float(rng.random())))  # type: ignore[arg-type]
        frames.append((labels, seen))
    truth, found = ([frame(*side, name=str(i)) for i, side in enumerate(sides)] for sides in zip(*frames, strict=True))
    for made in operating_points(truth, found, NAMES, scores=0.3, metric=metric, bands_m=[(0.0, 10.0)]):
        expected = naive(frames, made.class_name, metric, made.band_m or (0.0, math.inf))
        assert (made.found, made.objects, made.true_positives, made.detections, made.ignored) == expected
