"""Statistics of scans: number of returns, their positions, fraction of ground, and reflectance."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject, KittiSplit, boxes_from_objects, in_image, objects_3d
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.report.label_statistics import object_fits
from asca_pillars.sim.report.reference import (
    BAND_M,
    BANDS,
    CAR_FIT_RANGE_M,
    NEAR_CARS_M,
    RANGE_BINS,
    REFLECTANCES,
    SECTORS,
    Band,
    CarFit,
    Reflectance,
    ScanStatistics,
    Sensor,
)

_GROUND_M = 0.15  # largest distance of ground from the local height
_PLANE_REACH_M = 20.0
_SECTORS = 72  # of 5 degrees
_STEP_M = 2.0
_REACH_M = 80.0
_SEARCH_M = 0.3  # largest change of the local height from one cell to the next
_MIN_POINTS = 3  # fewer in a cell do not determine its height
_MAX_SLOPE = 0.15
_TRIALS = 150
_SAMPLE = 2000

_Floats = NDArray[np.floating[Any]]


def ground_mask(points: _Floats) -> NDArray[np.bool_]:
    """Return the mask (N,) of the ground points among (N, >=3), LiDAR frame in metres; all False without a plane."""
    x, y, z = points[:, :3].astype(np.float32).T
    radius = np.hypot(x, y)
    plane = most_common_ground(points[radius < _PLANE_REACH_M])
    if plane is None:
        return np.zeros(len(points), bool)
    above = z - (plane[0] * x + plane[1] * y + plane[2])
    sector = np.minimum(((np.arctan2(y, x) + np.pi) * (_SECTORS / (2 * np.pi))).astype(np.int16), _SECTORS - 1)
    step = np.minimum(radius / _STEP_M, _REACH_M / _STEP_M - 1).astype(np.int16)
    # Cells in the order of tracking the heights; small integers are sorted by radix.
    order = np.argsort(step * _SECTORS + sector, kind="stable")
    starts = np.searchsorted(step[order], np.arange(int(_REACH_M / _STEP_M) + 1))
    above, sector = above[order], sector[order]
    ground = np.zeros(len(points), bool)
    height = np.zeros(_SECTORS)
    for first, last in pairwise(starts):
        cell, dz = sector[first:last], above[first:last]
        height = _track(height, cell, dz)
        ground[order[first:last]] = np.abs(dz - height[cell]) < _GROUND_M
    return ground


def most_common_ground(points: _Floats) -> NDArray[np.float64] | None:
    """Fit a RANSAC plane (3,) a, b, c of z = a x + b y + c, metres, to points (N, >=3); None if all are too steep.

    The samples are seeded: the same points give the same plane.
    """
    if len(points) < _SECTORS:
        return None
    rng = np.random.default_rng(0)
    sample = points[rng.integers(len(points), size=min(_SAMPLE, len(points))), :3].astype(np.float64)
    corners = sample[rng.integers(len(sample), size=(_TRIALS, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal[:, 2] = np.where(np.abs(normal[:, 2]) < 1e-6, np.nan, normal[:, 2])
    slope = -normal[:, :2] / normal[:, 2:]
    planes = np.column_stack([slope, corners[:, 0, 2] - (slope * corners[:, 0, :2]).sum(axis=1)])
    planes = planes[np.abs(slope).max(axis=1) < _MAX_SLOPE]
    if len(planes) == 0:
        return None
    lifted = np.column_stack([sample[:, :2], np.ones(len(sample))])
    inliers_of = np.abs(sample[:, 2:] - lifted @ planes.T) < _GROUND_M
    inliers = inliers_of[:, inliers_of.sum(axis=0).argmax()]
    return np.asarray(np.linalg.lstsq(lifted[inliers], sample[inliers, 2], rcond=None)[0])


def _track(height: NDArray[np.float64], cell: NDArray[np.int16], above: _Floats) -> NDArray[np.float64]:
    """Return the local heights (S,) of the next ring of cells, from those of the previous ring."""
    candidate = np.abs(above - height[cell]) < _SEARCH_M
    count = np.bincount(cell[candidate], minlength=_SECTORS)
    total = np.bincount(cell[candidate], above[candidate], minlength=_SECTORS)
    return np.where(count >= _MIN_POINTS, total / np.maximum(count, 1), height)


OBJECTS = ("car", "pedestrian", "cyclist", "van")
MATERIALS = ("overall", "ground", "non_ground", *OBJECTS)
_ABOVE_BOTTOM_M = 0.1  # an object's points begin so far above its box's bottom: lower ones may be ground
_CAMERA_VIEW_SHARE = 0.9  # of a scan's points; a whole revolution has about 0.16 of them in the image
_MIN_CARS = 5
_LAYERS = range(8, 161)  # plausible numbers of rings in a stored scan

_Counts = NDArray[np.int64]


@dataclass(frozen=True)
class ScanRecord:
    """Contribution of one scan to the statistics.

    Attributes:
        points, in_camera, ground, ground_in_camera: numbers of returns.
        rings: (rings,) returns of each, from the top.
        sectors: (SECTORS,) returns of each, counter-clockwise from straight ahead.
        ranges: (RANGE_BINS,) returns per metre.
        ground_sums: (3, 2, BANDS) number, sum and sum of squares of z and of reflectance of ground returns.
        reflectance: by material, (units, REFLECTANCES) counts of the scan or of each object in it.
        cars: (C, 2) range and points of its unoccluded, untruncated cars.
        fits: by class, from `fit_statistics.object_fits`.
    """

    points: int
    in_camera: int
    ground: int
    ground_in_camera: int
    rings: _Counts
    sectors: _Counts
    ranges: _Counts
    ground_sums: NDArray[np.float64]
    reflectance: dict[str, _Counts]
    cars: NDArray[np.float64]
    fits: dict[str, NDArray[np.float64]]


def measure_scan(split: KittiSplit, frame_id: str, sensor: Sensor) -> ScanRecord:
    """Read and measure one scan and the labelled objects in it.

    Raises:
        DatasetError: its calibration or labels are missing or damaged.
        ScanError: the scan is damaged.
    """
    points = read_scan(split.scan_path(frame_id)).points
    camera = in_image(points, split.calibration(frame_id), split.image_size_wh(frame_id))
    ground = ground_mask(points)
    slant = np.linalg.norm(points[:, :3], axis=1)
    value = np.clip(np.rint(points[:, 3] * REFLECTANCES), 0, REFLECTANCES - 1).astype(np.int64)
    band = np.minimum(slant[ground] / BAND_M, BANDS - 1).astype(np.int64)
    quantities = (points[ground, 2].astype(np.float64), points[ground, 3].astype(np.float64))
    sums = [[np.bincount(band, q**power, BANDS)[:BANDS] for q in quantities] for power in (0, 1, 2)]
    reflectance = {"overall": _histogram(value)[None], "ground": _histogram(value[ground])[None]}
    reflectance["non_ground"] = reflectance["overall"] - reflectance["ground"]
    objects = objects_3d(split.objects(frame_id))
    boxes = boxes_from_objects(objects, split.calibration(frame_id))
    of_objects, cars = _objects(objects, boxes, points, value)
    return ScanRecord(
        len(points),
        int(camera.sum()),
        int(ground.sum()),
        int((ground & camera).sum()),
        ring_counts(points, sensor),
        np.bincount((_azimuth(points) * (SECTORS / (2 * np.pi))).astype(np.int64), minlength=SECTORS)[:SECTORS],
        np.bincount(np.minimum(slant, RANGE_BINS).astype(np.int64), minlength=RANGE_BINS)[:RANGE_BINS],
        np.array(sums),
        reflectance | of_objects,
        cars,
        object_fits(points, objects, boxes),
    )


def is_camera_view(records: Sequence[ScanRecord]) -> bool:
    """Return whether any of the scans was cropped to the camera's field of view."""
    return any(record.in_camera > _CAMERA_VIEW_SHARE * record.points for record in records)


def scan_statistics(records: Sequence[ScanRecord]) -> ScanStatistics:
    """Return the statistics of at least one scan; of those cropped to the camera's view, only the available ones."""
    whole = not is_camera_view(records)
    materials = MATERIALS if whole else OBJECTS
    stacks = {name: stack for name in materials if len(stack := unit_histograms(records, name))}
    sums = np.sum([record.ground_sums for record in records], axis=0)
    z, reflectance = (_bands(sums[:, index]) for index in range(2))
    cars = np.concatenate([record.cars for record in records])
    agree = len({len(record.rings) for record in records}) == 1
    return ScanStatistics(
        scans=len(records),
        camera_points=_band([record.in_camera for record in records]),
        camera_ground_share=_band([r.ground_in_camera / max(r.in_camera, 1) for r in records]),
        reflectance={
            name: Reflectance(tuple(stack.sum(axis=0).tolist()), len(stack)) for name, stack in stacks.items()
        },
        car_fit=fit_cars(cars, CAR_FIT_RANGE_M),
        near_car_fit=fit_cars(cars, NEAR_CARS_M),
        points=_band([record.points for record in records]) if whole else None,
        ground_share=_band([r.ground / max(r.points, 1) for r in records]) if whole else None,
        points_per_ring=_mean([record.rings for record in records]) if whole and agree else None,
        sector_points=_mean([record.sectors for record in records]) if whole else None,
        range_points=_mean([record.ranges for record in records]) if whole else None,
        ground_z_m=z if whole else None,
        ground_reflectance=reflectance if whole else None,
    )


def unit_histograms(records: Sequence[ScanRecord], material: str) -> _Counts:
    """Return the reflectances (units, REFLECTANCES) of every scan or object of a material with returns."""
    parts = [record.reflectance[material] for record in records if material in record.reflectance]
    stack = np.concatenate(parts) if parts else np.zeros((0, REFLECTANCES), np.int64)
    return stack[stack.sum(axis=1) > 0]


def fit_cars(cars: NDArray[np.float64], span_m: tuple[float, float]) -> CarFit | None:
    """Fit a power law to ranges and points (C, 2) of cars within a span; None if it would be arbitrary.

    As in the reference, cars without points, which have no logarithm, are left out.
    """
    low_m, high_m = span_m
    cars = np.log(cars[(cars[:, 1] > 0) & (cars[:, 0] >= low_m) & (cars[:, 0] <= high_m)])
    if len(cars) < _MIN_CARS or np.ptp(cars[:, 0]) < np.log(2):
        return None
    b, a = np.polyfit(cars[:, 0], cars[:, 1], 1)
    residual = np.sqrt(np.sum((cars[:, 1] - a - b * cars[:, 0]) ** 2) / (len(cars) - 2))
    return CarFit(float(a), float(b), len(cars), float(residual), _band(cars[:, 0]))


def ring_counts(points: NDArray[np.floating[Any]], sensor: Sensor) -> _Counts:
    """Return the number of returns of each ring, counts (rings,) from the top, of a whole revolution (N, >=3).

    KITTI's files are ordered by ring, each from azimuth 0 on, counter-clockwise: where the azimuth decreases, the
    next ring begins. In files of another order a return is assigned to the ring of `sensor` with the nearest beam.
    """
    starts = np.flatnonzero(np.diff(_azimuth(points)) < -np.pi) + 1
    if len(starts) + 1 in _LAYERS:
        return np.diff(np.concatenate([[0], starts, [len(points)]]))
    rho = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-3)
    half = len(sensor.elevation_deg) // 2
    missed, ring = [], []
    # The halves have their own origins, close enough within each for one mean.
    for first, last in ((0, half), (half, len(sensor.elevation_deg))):
        slopes = np.tan(np.deg2rad(sensor.elevation_deg[first:last]))
        slope = (points[:, 2] - np.mean(sensor.origin_z_m[first:last])) / rho
        nearest = np.searchsorted(-(slopes[1:] + slopes[:-1]) / 2, -slope)
        missed.append(np.abs(slope - slopes[nearest]))
        ring.append(first + nearest)
    return np.bincount(np.where(missed[0] < missed[1], *ring), minlength=2 * half)


def _objects(
    objects: Sequence[KittiObject], boxes: NDArray[np.float32], points: NDArray[np.float32], value: _Counts
) -> tuple[dict[str, _Counts], NDArray[np.float64]]:
    """Return reflectances of the objects of a frame by type, and range and points of its unoccluded cars."""
    inside = points_in_boxes(points, boxes)
    body = inside & (points[:, None, 2] > boxes[:, 2] - boxes[:, 5] / 2 + _ABOVE_BOTTOM_M)
    types = np.array([item.type.lower() for item in objects])
    rows = np.array([_histogram(value[mask]) for mask in body.T]).reshape(-1, REFLECTANCES)
    plain = np.array([o.type == "Car" and o.occluded == 0 and o.truncated == 0 for o in objects], bool)
    cars = np.stack([np.hypot(boxes[:, 0], boxes[:, 1]), inside.sum(axis=0)], axis=1)[plain]
    return {name: rows[types == name] for name in OBJECTS}, cars


def _azimuth(points: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    return np.asarray(np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi), np.float64)


def _histogram(value: _Counts) -> _Counts:
    return np.bincount(value, minlength=REFLECTANCES)


def _band(values: Sequence[float] | NDArray[np.float64]) -> Band:
    return Band(float(np.mean(values)), float(np.std(values)))


def _mean(rows: Sequence[_Counts]) -> tuple[float, ...]:
    return tuple(np.mean(rows, axis=0).tolist())


def _bands(sums: NDArray[np.float64]) -> tuple[Band | None, ...]:
    """Return mean and deviation in each band from (3, BANDS) numbers, sums and sums of squares."""
    bands: list[Band | None] = []
    for number, total, squares in sums.T:
        mean = total / max(number, 1)
        deviation = float(np.sqrt(max(squares / max(number, 1) - mean**2, 0.0)))
        bands.append(Band(float(mean), deviation) if number else None)
    return tuple(bands)
