"""Statistics of scans and labels that the comparison with real ones reads.

Of scans: number of returns, their positions, fraction of ground, and reflectance. Of labels: number, size, position,
yaw and occlusion of objects, and the fit of boxes to points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject, KittiSplit, boxes_from_objects, in_image, objects_3d
from asca_pillars.evaluation.errors.label_fit import STATISTICS, label_fit, view_angle_deg
from asca_pillars.geometry.boxes import Floats, Ints, Singles, points_in_boxes
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.report.reference import (
    BAND_M,
    BANDS,
    CAR_FIT_RANGE_M,
    CLASSES,
    LABEL_RANGE_BINS,
    MAX_PER_FRAME,
    NEAR_CARS_M,
    PERCENTILES,
    RANGE_BINS,
    REFLECTANCES,
    SECTORS,
    TRUNCATION_EDGES,
    YAW_BINS,
    Band,
    CarFit,
    Fit,
    LabelStatistics,
    Reflectance,
    ScanStatistics,
    Sensor,
    Spread,
)

_LABEL_STEP_M = 5.0
_ASIDE_RAD = np.pi / 12


def label_statistics(split: KittiSplit, frame_ids: Sequence[str]) -> tuple[dict[str, LabelStatistics], float]:
    """Return the label statistics of each of CLASSES that occurs in the frames, and the DontCare areas per frame.

    KITTI labels objects in the image; in a set labelled in every direction, the others are left out.

    Raises:
        DatasetError: a label or calibration file is missing or damaged.
    """
    per_frame = {name: np.zeros(len(frame_ids), np.int64) for name in CLASSES}
    objects: dict[str, list[KittiObject]] = {name: [] for name in CLASSES}
    boxes: dict[str, list[Singles]] = {name: [] for name in CLASSES}
    dont_care = 0
    for index, frame_id in enumerate(frame_ids):
        everything = split.objects(frame_id)
        dont_care += sum(item.type == "DontCare" for item in everything)
        calibration = split.calibration(frame_id)
        for name in CLASSES:
            mine = objects_3d(item for item in everything if item.type == name and item.bbox[2] > item.bbox[0])
            per_frame[name][index] = len(mine)
            objects[name] += mine
            boxes[name].append(boxes_from_objects(mine, calibration))
    of_class = {
        name: _of_class(objects[name], np.concatenate(boxes[name]).astype(np.float64), per_frame[name])
        for name in CLASSES
        if objects[name]
    }
    return of_class, dont_care / len(frame_ids)


def _of_class(objects: Sequence[KittiObject], boxes: Floats, per_frame: Ints) -> LabelStatistics:
    x, y, z, length, width, height, yaw = boxes.T
    range_m = np.hypot(x, y)
    truncated = np.array([item.truncated for item in objects])
    occluded = np.clip([item.occluded for item in objects], 0, 3)
    return LabelStatistics(
        count=len(objects),
        per_frame=_counts(np.minimum(per_frame, MAX_PER_FRAME), MAX_PER_FRAME + 1),
        height_m=_spread(height),
        width_m=_spread(width),
        length_m=_spread(length),
        left_m=_spread(y),
        range_counts=_counts(np.minimum(range_m // _LABEL_STEP_M, LABEL_RANGE_BINS - 1), LABEL_RANGE_BINS),
        bottom_z_m=tuple(_band_or_none((z - height / 2)[range_m // BAND_M == band]) for band in range(BANDS)),
        yaw_counts=tuple(np.histogram(yaw, YAW_BINS, (-np.pi, np.pi))[0].tolist()),
        yaw_same=float(np.mean(np.abs(yaw) < _ASIDE_RAD)),
        yaw_oncoming=float(np.mean(np.abs(yaw) > np.pi - _ASIDE_RAD)),
        yaw_across=float(np.mean(np.abs(np.abs(yaw) - np.pi / 2) < _ASIDE_RAD)),
        occlusion=_counts(occluded, 4),
        truncation=_counts(np.searchsorted(TRUNCATION_EDGES, truncated), len(TRUNCATION_EDGES) + 1),
    )


def _counts(values: NDArray[np.number], bins: int) -> tuple[int, ...]:
    return tuple(np.bincount(values.astype(np.int64), minlength=bins).tolist())


def _spread(values: Floats) -> Spread:
    percentiles = tuple(np.percentile(values, PERCENTILES).tolist())
    return Spread(float(values.mean()), float(values.std()), percentiles)


def _band_or_none(values: Floats) -> Band | None:
    return Band(float(values.mean()), float(values.std())) if len(values) else None


WINDOW_RETURNS = "window_returns"
"""Points per height on side windows over those on the doors below them; cars neither end-on nor side-on."""
DOOR_ZEROS, UPPER_ZEROS = "door_zeros", "upper_zeros"
"""Share of points without a reflectance on doors or tail, and above them: windows, their frames, pillars; any view."""
SHOWN: Mapping[str, tuple[str, ...]] = {
    "Car": (
        "flank_end",
        "upper_end",
        "roof_end",
        "roof_length",
        "nearest_point",
        "rear_width",
        "top_97",
        "top",
        "low_inside",
        WINDOW_RETURNS,
        DOOR_ZEROS,
        UPPER_ZEROS,
    ),
    "Pedestrian": ("range_5", "range_50", "range_95", "range_spread"),
    "Cyclist": ("range_5", "range_50", "range_95", "range_spread"),
}
OF_CARS = (WINDOW_RETURNS, DOOR_ZEROS, UPPER_ZEROS)
COLUMNS = (*STATISTICS, *OF_CARS)
MEANS = ("low_inside",)  # fractions of objects, for which a median is meaningless
MIN_OBJECTS = 2
_MAX_TRUNCATION = 0.1
_WINDOW_RANGE_M = 25.0
_WINDOW_VIEW_DEG = 10.0, 73.0
_WINDOWS, _DOORS = (0.68, 0.82), (0.35, 0.55)  # fractions of the height
_BESIDE_FRONT_SEATS = -0.25, 0.05  # fractions of the length ahead of the center
_FLANK_M = 0.3
_MIN_DOOR_POINTS = 9
_ZEROS_RANGE_M = 40.0
_UPPER = 0.65, 0.85  # fractions of the height; the doors are those of the windows
_MIN_BAND_POINTS = 5
_LEAST_REFLECTANCE = 0.01  # KITTI's step
_AROUND_M = 0.1  # points so far beside a label are its car's, too


def object_fits(
    points: NDArray[np.floating], objects: Sequence[KittiObject], boxes: NDArray[np.floating]
) -> dict[str, Floats]:
    """Return `COLUMNS` of the unoccluded, untruncated objects of each class, (objects, len(COLUMNS)).

    Args:
        points: (N, >=4) points of the scan, metres and reflectance.
        objects: M labels with a 3D box.
        boxes: (M, 7) their boxes in the frame of the points.
    """
    whole = np.array([item.occluded == 0 and item.truncated <= _MAX_TRUNCATION for item in objects], bool)
    names = np.array([item.type for item in objects])
    samples = {}
    for name in CLASSES:
        of_class = boxes[whole & (names == name)] if len(objects) else boxes[:0]
        of_cars = np.full((len(of_class), len(OF_CARS)), np.nan)
        if name == "Car":
            for row, box in zip(of_cars, of_class.astype(np.float64), strict=True):
                row[:] = window_returns(points, box), *zero_shares(points, box)
        samples[name] = np.column_stack([label_fit(points, of_class), of_cars])
    return samples


def zero_shares(points: NDArray[np.floating], box: Floats) -> tuple[float, float]:
    """Return `DOOR_ZEROS` and `UPPER_ZEROS` of a car's box (7,) from points (N, >=4); NaN where there are too few."""
    if np.hypot(box[0], box[1]) > _ZEROS_RANGE_M:
        return float("nan"), float("nan")
    along, across, up = _in_box(points, box)
    on_car = (np.abs(along) < box[3] / 2 + _AROUND_M) & (np.abs(across) < box[4] / 2 + _AROUND_M)
    bands = [points[on_car & (up > low) & (up < high), 3] for low, high in (_DOORS, _UPPER)]
    doors, upper = (
        float((of < _LEAST_REFLECTANCE).mean()) if len(of) >= _MIN_BAND_POINTS else float("nan") for of in bands
    )
    return doors, upper


def _in_box(points: NDArray[np.floating], box: Floats) -> tuple[Floats, Floats, Floats]:
    """Return how far points are along and across a box (7,), metres from its center, and up, fraction of its height."""
    offset, yaw = points[:, :2].astype(np.float64) - box[:2], box[6]
    up = (points[:, 2] - box[2]) / box[5] + 0.5
    return offset @ (np.cos(yaw), np.sin(yaw)), offset @ (-np.sin(yaw), np.cos(yaw)), up


def window_returns(points: NDArray[np.floating], box: Floats) -> float:
    """Return `WINDOW_RETURNS` of a car's box (7,), or NaN if too little of its doors is visible."""
    view_deg = view_angle_deg(box[None])[0]
    if np.hypot(box[0], box[1]) > _WINDOW_RANGE_M or not _WINDOW_VIEW_DEG[0] < view_deg < _WINDOW_VIEW_DEG[1]:
        return float("nan")
    along, across, up = _in_box(points, box)
    first, last = np.multiply(_BESIDE_FRONT_SEATS, box[3])
    flank = (along > first) & (along < last) & (np.abs(np.abs(across) - box[4] / 2) < _FLANK_M)
    windows, doors = (int((flank & (up > low) & (up < high)).sum()) for low, high in (_WINDOWS, _DOORS))
    if doors < _MIN_DOOR_POINTS:
        return float("nan")
    return windows / doors * (_DOORS[1] - _DOORS[0]) / (_WINDOWS[1] - _WINDOWS[0])


def fits_of(rows: Mapping[str, Floats], source: str) -> dict[str, tuple[Fit, ...]]:
    """Return one `Fit` for each shown statistic, by "Car flank_end" and the like, of MIN_OBJECTS or more.

    Args:
        rows: by class, from `object_fits`, of one drive or folder.
        source: its name.
    """
    result: dict[str, tuple[Fit, ...]] = {}
    for name, statistics in SHOWN.items():
        for statistic in statistics:
            values = rows[name][:, COLUMNS.index(statistic)]
            values = values[np.isfinite(values)]
            if len(values) < MIN_OBJECTS:
                continue
            middle = float(values.mean() if statistic in MEANS else np.median(values))
            low, high = np.percentile(values, (10, 90)).tolist()
            result[f"{name} {statistic}"] = (Fit(source, len(values), middle, low, high),)
    return result


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
        fits: by class, from `object_fits`.
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
