"""Made-up scans with known statistics: a ring of walls about flat ground, and blocks of points for cars."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject, KittiSplit, in_image, objects_from_boxes, write_calibration
from asca_pillars.data.kitti import write_labels as write_label_file
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.sim.report.reference import Sensor
from tests.helpers.scenes import CALIBRATION

GROUND_Z_M, WALL_M, COLUMNS = -1.70, 30.0, 360
SENSOR = Sensor(tuple(np.linspace(2.0, -24.0, 64).tolist()), (0.2,) * 32 + (0.12,) * 32, COLUMNS)
CAR_LAW = (13.0, -2.6)


def rings(rng: np.random.Generator, slope: float = 0.0) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Points (N, 4), ring after ring from azimuth 0 on, and which are ground; the ground rises by `slope` along x."""
    elevation = np.tan(np.deg2rad(SENSOR.elevation_deg))[:, None]
    azimuth = (np.arange(COLUMNS) + 0.5) * (2 * np.pi / COLUMNS)
    origin = np.array(SENSOR.origin_z_m)[:, None]
    closing = slope * np.cos(azimuth) - elevation  # of beam and ground, per metre
    to_ground = np.where(closing > 0, (origin - GROUND_Z_M) / np.where(closing > 0, closing, 1.0), np.inf)
    rho = np.minimum(to_ground, WALL_M)
    ground = to_ground < WALL_M
    reflectance = np.where(ground, rng.choice([0.0, 0.2, 0.3], rho.shape), 0.5)
    columns = (rho * np.cos(azimuth), rho * np.sin(azimuth), origin + rho * elevation, reflectance)
    return np.stack([np.broadcast_to(c, rho.shape).ravel() for c in columns], axis=1).astype(np.float32), ground.ravel()


def write_set(root: Path, frames: int = 6, *, camera_view: bool = False, brighter: float = 0.0) -> Path:
    """A KITTI-layout folder; every frame has a car, one or two pedestrians and a DontCare area.

    Args:
        root: of the folder.
        frames: how many.
        camera_view: keep only the points in the image.
        brighter: added to the reflectance of all points but those at 0.
    """
    split = KittiSplit(root)
    rng = np.random.default_rng(1)
    for index in range(frames):
        range_m = 12.5 + 5 * index
        boxes = [[range_m, 0, -0.9, 4.0 + 0.1 * index, 1.6, 1.5, 0.1], [9, 3, -0.8, 0.8, 0.6, 1.7, 1.6]]
        boxes += [[9, -3, -0.8, 0.8, 0.6, 1.8, -3.1]] * (index % 2)
        types = ["Car", "Pedestrian", "Pedestrian"][: len(boxes)]
        objects = [
            replace(item, truncated=0.0, occluded=min(number, 2))
            for number, item in enumerate(objects_from_boxes(np.array(boxes), types, CALIBRATION))
        ]
        objects.append(KittiObject("DontCare", -1, -1, -10, (5, 5, 50, 50), -1, -1, -1, -1000, -1000, -1000, -10))
        background, _ = rings(rng)
        in_boxes = [_block(rng, box, count) for box, count in zip(boxes, (_car_points(range_m), 60, 40), strict=False)]
        # What stands in a box belongs to ring 0, in the order of its azimuth.
        first = np.concatenate([*in_boxes, background[:COLUMNS]])
        first = first[np.argsort(np.arctan2(first[:, 1], first[:, 0]) % (2 * np.pi))]
        points = np.concatenate([first, background[COLUMNS:]]).astype(np.float32)
        points[:, 3] += np.where(points[:, 3] > 0, np.float32(brighter), np.float32(0))
        if camera_view:
            points = points[in_image(points, CALIBRATION)]
        name = f"{index:06d}"
        write_scan(split.scan_path(name), points)
        write_calibration(split.calib_path(name), CALIBRATION)
        write_label_file(split.label_path(name), objects)
    return root


def _car_points(range_m: float) -> int:
    return round(np.exp(CAR_LAW[0]) * range_m ** CAR_LAW[1])


def _block(rng: np.random.Generator, box: list[float], count: int) -> NDArray[np.float64]:
    """Points (count, 4) in the upper part of a box."""
    x, y, z, _, _, height, _ = box
    return np.column_stack(
        [
            rng.uniform(x - 0.2, x + 0.2, count),
            rng.uniform(y - 0.2, y + 0.2, count),
            rng.uniform(z, z + height / 2 - 0.05, count),
            rng.choice([0.0, 0.1, 0.6], count),
        ]
    )
