"""Scans of made-up streets, ray by ray: a spinning sensor at the origin over a known ground, with boxes on it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from asca_pillars.data.kitti import KittiSplit, objects_from_boxes, write_calibration, write_image_set, write_labels
from asca_pillars.geometry.boxes import footprints
from asca_pillars.scans.scan_reader import write_scan
from tests.helpers.scenes import CALIBRATION, SIZES

# Never exactly level or straight ahead, so that no ray is parallel to the sides of a box.
ELEVATIONS_RAD = np.radians(np.concatenate([np.arange(-24, -9, 0.5), np.arange(-9, 2, 0.33)]) + 0.011)
AZIMUTHS_RAD = np.radians(np.arange(-38, 38, 0.25) + 0.0137)
LEVEL = (0.0, 0.0, -1.73)
TYPES = ("Car", "Pedestrian", "Cyclist")


def cast(plane: Sequence[float], boxes: NDArray[np.floating], reach_m: float = 60.0) -> NDArray[np.float32]:
    """First hits (N, 4) on the plane z = a x + b y + c and on boxes (M, 7)."""
    elevation, azimuth = (part.ravel() for part in np.meshgrid(ELEVATIONS_RAD, AZIMUTHS_RAD, indexing="ij"))
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    a, b, c = plane
    falling = ray[:, 2] - a * ray[:, 0] - b * ray[:, 1]
    hit = np.where(falling < 0, c / np.minimum(falling, -1e-9), np.inf)
    for box in boxes.astype(float):
        cos, sin = np.cos(box[6]), np.sin(box[6])
        turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        direction, center = ray @ turn.T, turn @ box[:3]
        sides = np.stack([(center - box[3:6] / 2) / direction, (center + box[3:6] / 2) / direction])
        enters, leaves = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        hit = np.where((enters <= leaves) & (enters > 0), np.minimum(hit, enters), hit)
    seen = hit < reach_m
    points = ray[seen] * (hit[seen, None] + 1e-3)  # a hair inside what was hit, as labels are a hair loose
    return np.column_stack([points, np.full(len(points), 0.3)]).astype(np.float32)


def stand(name: str, x: float, y: float, yaw: float = 0.0, plane: Sequence[float] = LEVEL) -> NDArray[np.float32]:
    """The box (7,) of an object on the plane."""
    length, width, height = SIZES[name]
    z = plane[0] * x + plane[1] * y + plane[2] + height / 2
    return np.array([x, y, z, length, width, height, yaw], np.float32)


def polygons(boxes: NDArray[np.floating]) -> list[Polygon]:
    """Their outlines from above."""
    return [Polygon(outline) for outline in footprints(boxes.astype(float))]


def street(seed: int, plane: Sequence[float] = LEVEL) -> tuple[NDArray[np.float32], NDArray[np.float32], list[str]]:
    """A scan, its boxes and their types: two cars, a pedestrian, a cyclist beside a road, and a wall without label."""
    rng = np.random.default_rng(seed)
    x = rng.permutation([8.0, 12.0, 16.0, 20.0]) + rng.uniform(-1, 1, 4)
    y = [rng.uniform(2.5, 5.0), rng.uniform(-4.5, -2.5), rng.uniform(-3, 3), rng.uniform(-3, 3)]
    names = ["Car", "Car", "Pedestrian", "Cyclist"]
    boxes = np.array([stand(*args, rng.uniform(-3, 3), plane) for args in zip(names, x, y, strict=True)])
    wall = np.array([[22.0, -9.0, -0.5, 30.0, 0.4, 3.0, 0.0]], np.float32)
    return cast(plane, np.concatenate([boxes, wall])), boxes, names


def write_streets(root: Path, frames: int) -> Path:
    """A KITTI-layout folder of streets, all of them in the lists `train` and `val`."""
    split = KittiSplit(root)
    ids = [f"{number:06d}" for number in range(frames)]
    for number, frame_id in enumerate(ids):
        points, boxes, names = street(number)
        write_scan(split.scan_path(frame_id), points)
        write_calibration(split.calib_path(frame_id), CALIBRATION)
        write_labels(split.label_path(frame_id), objects_from_boxes(boxes, names, CALIBRATION))
    for name in ("train", "val"):
        write_image_set(root, name, ids)
    return root
