"""Counts at a fixed score against a slow twin."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.operating_point import (
    operating_points,
)
from asca_pillars.geometry.overlap import bev_iou, iou_3d
from tests.evaluation.kitti.scored_frames import NAMES, frame, item


def camera_boxes(objects: list[KittiObject]) -> np.ndarray:
    """(N, 7) with z up: x right, y = z forward, z = -y; rotation_y about the downward axis is -yaw."""
    rows = [(o.x_m, o.z_m, o.height_m / 2 - o.y_m, o.length_m, o.width_m, o.height_m, -o.rotation_y) for o in objects]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def naive(
    frames: list[tuple[list[KittiObject], list[KittiObject]]],
    name: str,
    score: float,
    metric: str,
    band: tuple[float, float],
) -> tuple[int, int, int, int, int]:
    """found, objects; true, detections; ignored: one object and one detection after the other."""
    totals = np.zeros(5, dtype=int)
    neighbor = {"Car": "Van", "Pedestrian": "Person_sitting"}.get(name)
    for labels, seen in frames:
        candidates = [o for o in labels if o.type in (name, neighbor)]
        counted = [
            o.type == name and o.bbox[3] - o.bbox[1] >= 25 and o.occluded <= 1 and o.truncated <= 0.3
            for o in candidates
        ]
        taken: set[int] = set()
        near = [band[0] <= math.hypot(o.x_m, o.z_m) < band[1] for o in candidates]
        totals[1] += sum(c and n for c, n in zip(counted, near, strict=True))
        reported = sorted(
            (d for d in seen if d.type == name and (d.score or 0) >= score), key=lambda d: -(d.score or 0)
        )
        for detection in reported:
            inside = band[0] <= math.hypot(detection.x_m, detection.z_m) < band[1]
            overlap = (iou_3d if metric == "3d" else bev_iou)(camera_boxes([detection]), camera_boxes(candidates))
            best, most = -1, 0.7 if name == "Car" else 0.5
            for index in range(len(candidates)):
                if index not in taken and overlap[0, index] > most:
                    best, most = index, overlap[0, index]
            if best >= 0:
                taken.add(best)
                totals[0] += counted[best] and near[best]
                totals[2:4] += counted[best] and inside
                totals[4] += inside and not counted[best]
            else:
                low = detection.bbox[3] - detection.bbox[1] < 25
                totals[4] += inside and low
                totals[3] += inside and not low
    return tuple(totals.tolist())


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["3d", "bev"]))
def test_slow_twin(seed: int, metric: str) -> None:
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(3):
        labels = [
            item(
                str(rng.choice(["Car", "Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck"])),
                *rng.uniform((-2, 8), (2, 12)),
                occluded=int(rng.integers(0, 3)),
                rotation_y=float(rng.uniform(-3, 3)),
                bbox=(0.0, 0.0, 50.0, float(rng.uniform(15, 60))),
            )
            for _ in range(int(rng.integers(0, 8)))
        ]
        seen = [
            replace(
                o,
                type={"Van": "Car", "Person_sitting": "Pedestrian"}.get(o.type, o.type),
                x_m=o.x_m + float(rng.normal(0, 0.1)),
                y_m=o.y_m + float(rng.normal(0, 0.1)),
                bbox=(0.0, 0.0, 50.0, float(rng.uniform(15, 60))),
                score=float(rng.random()),
            )
            for o in labels * 2
        ]
        frames.append((labels, seen))
    truth = [frame(*labels, name=str(index)) for index, (labels, _) in enumerate(frames)]
    found = [frame(*seen, name=str(index)) for index, (_, seen) in enumerate(frames)]
    band = (0.0, 10.0)
    for made in operating_points(truth, found, NAMES, scores=0.3, metric=metric, bands_m=[band]):  # type: ignore[arg-type]
        expected = naive(frames, made.class_name, 0.3, metric, made.band_m or (0.0, math.inf))
        assert (made.found, made.objects, made.true_positives, made.detections, made.ignored) == expected
