"""KITTI objects for tests of the protocol: one at a time for its rules, and random sets full of hard cases."""

from dataclasses import replace
from typing import Any

import numpy as np

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.average_precision import KittiResults, evaluate
from asca_pillars.evaluation.kitti.objects import FrameObjects, frame_objects

# 60 pixels high, unoccluded: counted at every difficulty.
CAR = KittiObject("Car", 0.0, 0, 0.3, (100.0, 100.0, 200.0, 160.0), 1.5, 1.6, 3.9, 2.0, 1.7, 20.0, 0.4)
DONT_CARE = KittiObject("DontCare", -1, -1, -10, (100.0, 100.0, 200.0, 160.0), -1, -1, -1, -1000, -1000, -1000, -10)
EVERY = ("bbox", "bev", "3d")
CLASSES = ("Car", "Pedestrian", "Cyclist")
Frame = list[KittiObject]

TYPES = ("Car", "car", "Pedestrian", "CYCLIST", "Van", "Person_sitting", "Truck", "DontCare")
_SHARES = np.array([5, 1, 3, 1, 1, 1, 0.5, 1]) / 13.5


def beside(item: KittiObject, places: int, **changes: object) -> KittiObject:
    """The object some places further to the right, where it overlaps nothing of the first place."""
    x1, y1, x2, y2 = item.bbox
    moved = (x1 + 110 * places, y1, x2 + 110 * places, y2)
    return replace(item, **{"bbox": moved, "x_m": item.x_m + 6 * places} | changes)  # type: ignore[arg-type]


def as_frames(truth: list[Frame], found: list[Frame]) -> tuple[list[FrameObjects], list[FrameObjects]]:
    """Labels and detections, a list of objects for each frame, as what the metrics take."""
    labels, detections = ([frame_objects(str(i), frame) for i, frame in enumerate(side)] for side in (truth, found))
    return labels, detections


def results(truth: Frame, found: Frame, *more: tuple[Frame, Frame]) -> KittiResults:
    """Of one frame, or of several."""
    frames = [(truth, found), *more]
    return evaluate(*as_frames([t for t, _ in frames], [f for _, f in frames]), CLASSES).overall


def counts(truth: Frame, found: Frame, metric: str = "bbox", difficulty: str = "easy", name: str = "Car") -> list[Any]:
    """Counted objects, and the true, false and missed ones at the lowest threshold; no threshold, only the first."""
    curve = results(truth, found).curve(name, metric, difficulty)
    assert curve is not None
    return [curve.counted, *(int(values[-1]) for values in (curve.tp, curve.fp, curve.fn) if len(values))]


def hit(item: KittiObject = CAR, score: float = 0.5, **changes: Any) -> KittiObject:
    return replace(item, score=score, **changes)


def shifted(item: KittiObject, share: float, **changes: Any) -> KittiObject:
    """Moved to the right in the image by a share of the width: IoU (1 - share) / (1 + share). The 3D box stays."""
    x1, y1, x2, y2 = item.bbox
    return replace(item, bbox=(x1 + share * (x2 - x1), y1, x2 + share * (x2 - x1), y2), **changes)


def random_frames(seed: int, frames: int, detections: int) -> tuple[list[FrameObjects], list[FrameObjects]]:
    """Ground truth and detections: crowded, with ties, duplicates, tiny boxes, and limits that are exactly met."""
    rng = np.random.default_rng(seed)
    truth, found = [], []
    for number in range(frames):
        labels = [_random_label(rng) for _ in range(rng.integers(0, 9))]
        truth.append(frame_objects(f"{number:06d}", labels))
        reported = [_random_detection(rng, labels) for _ in range(rng.integers(0, detections + 1))]
        copies = [item for item in reported if rng.random() < 0.1]
        found.append(frame_objects(f"{number:06d}", reported + copies))
    return truth, found


def _random_label(rng: np.random.Generator) -> KittiObject:
    name = str(rng.choice(TYPES, p=_SHARES))
    # Whole and half numbers make heights of exactly 25 and 40 pixels.
    left, top = rng.integers(0, 300) / 2, rng.integers(0, 80) / 2
    bbox = (left, top, left + rng.uniform(20, 120), top + float(rng.choice([10, 24.5, 25, 39, 40, 60, 90])))
    if name == "DontCare":
        return replace(DONT_CARE, bbox=bbox)
    return KittiObject(
        type=name,
        truncated=float(rng.choice([0, 0.15, 0.16, 0.3, 0.5, 0.9])),
        occluded=int(rng.choice([-1, 0, 0, 1, 2, 3])),
        alpha=rng.uniform(-np.pi, np.pi),
        bbox=bbox,
        height_m=rng.uniform(1.4, 2),
        width_m=rng.uniform(1, 2),
        length_m=rng.uniform(1, 4),
        x_m=rng.uniform(-3, 3),
        y_m=rng.uniform(1.5, 1.8),
        z_m=float(rng.choice([20, 30, 45])) + rng.uniform(-2, 2),
        rotation_y=rng.uniform(-np.pi, np.pi),
    )


def _random_detection(rng: np.random.Generator, labels: list[KittiObject]) -> KittiObject:
    """Mostly a label that was moved a little, with one of a few scores that may be negative."""
    model = labels[rng.integers(len(labels))] if labels and rng.random() < 0.8 else _random_label(rng)
    noise = rng.normal(size=10) * rng.choice([0.0, 0.05, 0.2])
    left, top, right, bottom = np.array(model.bbox) + 30 * noise[:4]
    flat = replace(
        model,
        type=model.type if rng.random() < 0.8 else str(rng.choice(TYPES)),
        bbox=(float(left), float(top), float(max(right, left + 1)), float(max(bottom, top + 1))),
        alpha=rng.uniform(-np.pi, np.pi),
        truncated=-1,
        occluded=-1,
        score=float(rng.integers(-8, 8)) / 4,
    )
    if flat.height_m < 0:
        return flat
    return replace(
        flat,
        height_m=flat.height_m * (1 + noise[4] / 3),
        width_m=flat.width_m * (1 + noise[5] / 3),
        x_m=flat.x_m + noise[6],
        y_m=flat.y_m + noise[7],
        z_m=flat.z_m + noise[8],
        rotation_y=flat.rotation_y + noise[9],
    )
