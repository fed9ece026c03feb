"""Waymo's open dataset in its parquet form (v2): lidar/, lidar_box/, lidar_calibration/ with a file for each segment.

Its scans are range images inside those files, so points are written: a .npy for each frame, all sensors and returns, in
the vehicle's frame (x forward, y left, z up, z = 0 on the ground). If lidar_pose/ and vehicle_pose/ are present,
points are moved to the time of the labels. Columns: https://github.com/waymo-research/waymo-open-dataset,
v2/perception.

Waymo's range images as points in the vehicle's frame, by the formulas of its published tools (v2, `lidar_utils`).

A row is a laser, from the highest down; a column is an azimuth, the first one behind the sensor, turning clockwise. A
pixel holds range (m), intensity, elongation and whether it is in a no-label zone; a range of 0 means no return.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import AscaError, DatasetError
from asca_pillars.base.files import atomic_path, portable_name, require_content, write_text
from asca_pillars.base.installation import install_command
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import BoxRecords, records_from
from asca_pillars.data.boxes.box_split import DATASET_FILE, BoxDataset
from asca_pillars.data.importing.imported import (
    MARKER,
    Imported,
    ImportedFrame,
    SkippedEntries,
    numbers,
    require_own_dataset,
    text_of,
    whole_number,
)
from asca_pillars.geometry.frame_change import is_rigid, rotations_from_roll_pitch_yaw
from asca_pillars.scans.find_scans import visible_files

Doubles = NDArray[np.float64]
_CHANNELS = 2
"""Channels used: range and intensity."""
_FAR_M = 1000.0
"""Larger ranges are invalid."""


class LidarCalibration(NamedTuple):
    """Calibration of one sensor."""

    vehicle_from_lidar: Doubles
    """(4, 4) extrinsics."""
    inclinations_rad: Doubles | None
    """(H,) elevation of the lasers from the lowest up; None: evenly spaced."""
    lowest_rad: float
    highest_rad: float


def range_image_points(
    image: NDArray[np.float32],
    calibration: LidarCalibration,
    pixel_poses: NDArray[np.float32] | None = None,
    world_from_vehicle: Doubles | None = None,
) -> NDArray[np.float32]:
    """Return points (N, 4) x, y, z in metres, vehicle's frame at the label time, and intensity mapped to 0..1 by tanh.

    Args:
        image: (H, W, 4).
        calibration: calibration of the sensor.
        pixel_poses: (H, W, 6) roll, pitch, yaw, x, y, z of the vehicle in the world when a pixel was measured; None:
            it did not move.
        world_from_vehicle: (4, 4) at the label time; with `pixel_poses`.

    Raises:
        ValueError: the image has other channels, or another number of rows than the sensor has lasers, or than the
            poses.
    """
    height, width, channels = image.shape
    lasers = height if calibration.inclinations_rad is None else len(calibration.inclinations_rad)
    if channels < _CHANNELS or height != lasers:
        raise ValueError(f"a range image of shape {list(image.shape)} for {lasers} lasers")
    if pixel_poses is not None and pixel_poses.shape != (height, width, 6):
        raise ValueError(f"poses of shape {list(pixel_poses.shape)} for a range image of {list(image.shape)}")
    rows, columns = np.nonzero((image[..., 0] > 0) & (image[..., 0] < _FAR_M))
    extrinsic = calibration.vehicle_from_lidar
    upwards = calibration.inclinations_rad
    if upwards is None:
        span = calibration.highest_rad - calibration.lowest_rad
        upwards = (np.arange(height) + 0.5) / height * span + calibration.lowest_rad
    inclination = upwards[::-1][rows]
    turned = np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    azimuth = (2 * (width - columns - 0.5) / width - 1) * np.pi - turned
    distance = image[rows, columns, 0].astype(np.float64)
    flat = np.cos(inclination) * distance
    points = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(inclination) * distance], axis=1)
    points = points @ extrinsic[:3, :3].T + extrinsic[:3, 3]
    if pixel_poses is not None and world_from_vehicle is not None:
        poses = pixel_poses[rows, columns].astype(np.float64)
        world = np.einsum("nij,nj->ni", rotations_from_roll_pitch_yaw(poses[:, :3]), points) + poses[:, 3:]
        points = (world - world_from_vehicle[:3, 3]) @ world_from_vehicle[:3, :3]
    reflectance = np.tanh(np.maximum(image[rows, columns, 1], 0))
    cloud = np.column_stack([points, reflectance])
    return cloud[(np.abs(cloud) < np.finfo(np.float32).max).all(axis=1)].astype(np.float32)


TOP = 1
"""Number of the roof's sensor."""
TYPES = {1: "Vehicle", 2: "Pedestrian", 3: "Sign", 4: "Cyclist"}
_TIME, _LASER = "key.frame_timestamp_micros", "key.laser_name"
_OBJECT = "key.laser_object_id"
_BOX = "[LiDARBoxComponent]"
_BOX_COLUMNS = tuple(
    f"{_BOX}.box.{name}" for name in ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
)
_EXTRINSIC = "[LiDARCalibrationComponent].extrinsic.transform"
_INCLINATION = "[LiDARCalibrationComponent].beam_inclination"
_IMAGES = tuple(f"[LiDARComponent].range_image_return{number}" for number in (1, 2))
_PIXEL_POSE = "[LiDARPoseComponent].range_image_return1"
_VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
_BATCH = 8  # rows in memory at once: a range image has millions of numbers


def read_waymo(root: Path, out: Path, reporter: Reporter = SILENT) -> Imported:
    """Read every frame of every segment; scans are written to out/scans/<segment>/, existing ones are kept.

    Args:
        root: the folder with lidar/, lidar_box/ and lidar_calibration/ (training/ or validation/).
        out: output folder of the dataset.
        reporter: told of each segment.

    Raises:
        DatasetError: a file is missing or not of this format.
        OutputError: `out` has other contents.
        AscaError: pyarrow is not installed.
    """
    segments = visible_files(root / "lidar", "*.parquet")
    if not segments:
        raise DatasetError(f"{root}: no lidar/*.parquet there; give a folder of Waymo's parquet form")
    require_own_dataset(out)
    if not (out / DATASET_FILE).exists():
        # Written first, so that an interrupted import can be repeated.
        write_text(out / DATASET_FILE, MARKER)
    scans, skipped = out.resolve() / "scans", SkippedEntries()
    frames: list[ImportedFrame] = []
    for path in reporter.track(segments, "Reading segments"):
        labels = _labels(root / "lidar_box" / path.name, skipped)
        nothing = records_from(np.zeros((0, 7)), ())
        folder = scans / portable_name(path.stem)
        times = _write_scans(root, path, folder, skipped)
        frames += [ImportedFrame(_scan_path(folder, time), labels.get(time, nothing), path.stem) for time in times]
    top = _calibrations(root / "lidar_calibration" / segments[0].name, SkippedEntries()).get(TOP)
    x, y, z = np.zeros(3) if top is None else np.round(top.vehicle_from_lidar[:3, 3], 3).tolist()
    settings = BoxDataset(sensor_height=0.0, reflectance_scale=1.0, scans=str(scans), sensor_position=(x, y, z))
    return Imported(settings, frames, skipped)


def _scan_path(folder: Path, time: int) -> Path:
    return folder / f"{portable_name(str(time))}.npy"


def _write_scans(root: Path, lidar: Path, folder: Path, skipped: SkippedEntries) -> list[int]:
    """Write the scans of a segment that are not there yet; the times of all that are there then."""
    missing = _images_of_times(lidar, skipped)
    times = sorted(missing)
    missing = Counter({time: rows for time, rows in missing.items() if not _scan_path(folder, time).exists()})
    if not missing:
        return times
    calibrations = _calibrations(root / "lidar_calibration" / lidar.name, skipped)
    vehicle_poses = _vehicle_poses(root / "vehicle_pose" / lidar.name, skipped)
    pixel_poses = _pixel_poses(root / "lidar_pose" / lidar.name, skipped) if vehicle_poses else iter(())
    early: dict[int, NDArray[np.float32]] = {}
    points: dict[int, list[NDArray[np.float32]]] = defaultdict(list)
    columns = (_TIME, _LASER, *(f"{image}.{part}" for image in _IMAGES for part in ("values", "shape")))
    for number, row in enumerate(_parquet_rows(lidar, columns)):
        time = row[_TIME]
        if not isinstance(time, int) or time not in missing:
            continue
        poses = None
        if _is_top(row):  # the only one whose pixels have poses
            while time not in early and (other := next(pixel_poses, None)) is not None:
                early |= {other[0]: other[1]} if other[0] in missing else {}
            poses = early.pop(time, None)
        try:
            points[time] += _points(row, calibrations, poses, vehicle_poses.get(time))
        except ValueError as reason:  # a scan without one of its sensors would look complete
            skipped.add("frames", f"{lidar}, row {number}", reason)
            del missing[time], points[time]
            times.remove(time)
            continue
        missing[time] -= 1
        if not missing[time]:  # all sensors of the frame
            with atomic_path(_scan_path(folder, time)) as temporary, temporary.open("wb") as file:
                np.save(file, np.concatenate([*points.pop(time), np.zeros((0, 4), np.float32)]))
    return times


def _images_of_times(lidar: Path, skipped: SkippedEntries) -> Counter[int]:
    """Return the number of rows, one for each sensor, of each frame of a segment."""
    rows: Counter[int] = Counter()
    for number, row in enumerate(_parquet_rows(lidar, (_TIME,))):
        try:
            rows[whole_number(row[_TIME], _TIME)] += 1
        except ValueError as reason:
            skipped.add("range images", f"{lidar}, row {number}", reason)
    return rows


def _points(
    row: dict[str, Any],
    calibrations: Mapping[int, LidarCalibration],
    poses: NDArray[np.float32] | None,
    world_from_vehicle: Doubles | None,
) -> list[NDArray[np.float32]]:
    """Return the points of each return of one sensor; ValueError if they cannot be computed."""
    laser = row[_LASER]
    if not isinstance(laser, int) or laser not in calibrations:
        raise ValueError(f"sensor {str(laser)[:40]} has no usable calibration")
    images = (_image(row, name) for name in _IMAGES)
    return [
        range_image_points(image, calibrations[laser], poses, world_from_vehicle)
        for image in images
        if image is not None
    ]


def _labels(path: Path, skipped: SkippedEntries) -> dict[int, BoxRecords]:
    """Read the boxes of each frame."""
    boxes: dict[int, list[NDArray[np.float64]]] = defaultdict(list)
    types: dict[int, list[str]] = defaultdict(list)
    objects: dict[int, list[str | None]] = defaultdict(list)
    for number, row in enumerate(_parquet_rows(path, (_TIME, _OBJECT, f"{_BOX}.type", *_BOX_COLUMNS))):
        try:
            time = whole_number(row[_TIME], _TIME)
            kind = whole_number(row[f"{_BOX}.type"], f"{_BOX}.type")
            box = numbers([row[name] for name in _BOX_COLUMNS], 7, "the box")
            identity = None if row[_OBJECT] is None else text_of(row[_OBJECT], _OBJECT)
        except ValueError as reason:
            skipped.add("boxes", f"{path}, row {number}", reason)
            continue
        boxes[time].append(box)
        types[time].append(TYPES.get(kind, "Unknown"))
        objects[time].append(identity)
    return {time: records_from(np.array(rows), types[time], None, objects[time]) for time, rows in boxes.items()}


def _calibrations(path: Path, skipped: SkippedEntries) -> dict[int, LidarCalibration]:
    """Read the calibration of each sensor, by its number."""
    columns = (_LASER, _EXTRINSIC, *(f"{_INCLINATION}.{part}" for part in ("values", "min", "max")))
    calibrations = {}
    for number, row in enumerate(_parquet_rows(path, columns)):
        try:
            stated = row[f"{_INCLINATION}.values"]
            given = isinstance(stated, np.ndarray) and len(stated) > 0
            ends = [row[f"{_INCLINATION}.{end}"] for end in ("min", "max")]
            lowest, highest = (0.0, 0.0) if given else numbers(ends, 2, "the inclination's ends").tolist()
            calibrations[whole_number(row[_LASER], _LASER)] = LidarCalibration(
                _rigid(row[_EXTRINSIC], _EXTRINSIC),
                numbers(stated, None, "the inclinations") if given else None,
                lowest,
                highest,
            )
        except ValueError as reason:
            skipped.add("calibrations", f"{path}, row {number}", reason)
    return calibrations


def _rigid(values: Any, name: str) -> Doubles:
    """Return a rigid transform (4, 4) of 16 numbers."""
    matrix = numbers(values, 16, name).reshape(4, 4)
    if not is_rigid(matrix):
        raise ValueError(f"{name} is not a rotation and a translation")
    return matrix


def _vehicle_poses(path: Path, skipped: SkippedEntries) -> dict[int, Doubles]:
    """Read the transform (4, 4) of each frame from the vehicle to the world; empty if it was not downloaded."""
    poses: dict[int, Doubles] = {}
    for number, row in enumerate(_parquet_rows(path, (_TIME, _VEHICLE_POSE)) if path.is_file() else ()):
        try:
            poses[whole_number(row[_TIME], _TIME)] = _rigid(row[_VEHICLE_POSE], _VEHICLE_POSE)
        except ValueError as reason:
            skipped.add("poses", f"{path}, row {number}", reason)
    return poses


def _pixel_poses(path: Path, skipped: SkippedEntries) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield time and poses (H, W, 6) of each frame, of the sensor that has them; nothing if not downloaded."""
    columns = (_TIME, _LASER, f"{_PIXEL_POSE}.values", f"{_PIXEL_POSE}.shape")
    for number, row in enumerate(_parquet_rows(path, columns) if path.is_file() else ()):
        try:
            image = _image(row, _PIXEL_POSE) if _is_top(row) else None
            if image is not None:
                yield whole_number(row[_TIME], _TIME), image
        except ValueError as reason:
            skipped.add("poses", f"{path}, row {number}", reason)


def _is_top(row: dict[str, Any]) -> bool:
    laser = row[_LASER]  # may be an array, which has no truth value
    return isinstance(laser, int) and laser == TOP


def _image(row: dict[str, Any], name: str) -> NDArray[np.float32] | None:
    """Return a range image (H, W, C); None if the sensor has none, ValueError if it is damaged."""
    values, shape = row[f"{name}.values"], row[f"{name}.shape"]
    if values is None or shape is None:
        return None
    if not isinstance(values, np.ndarray) or (len(values) and values.dtype.kind not in "iuf"):
        raise ValueError(f"{name} has no numbers")
    if not len(values):
        return None
    sizes = [int(size) for size in numbers(shape, 3, f"{name}.shape").tolist()]
    if min(sizes) <= 0 or math.prod(sizes) != len(values):
        raise ValueError(f"{name} has {len(values)} values for the shape {sizes}")
    return values.astype(np.float32).reshape(sizes)


def _parquet_rows(path: Path, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file by column: numbers and texts unchanged, lists as NumPy arrays, missing values as None.

    None also stands for a value that Python cannot represent, such as a date in the year 300,000.

    Raises:
        DatasetError: not a parquet file, or one without these columns.
        AscaError: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise AscaError(f"{path}: pyarrow not installed: {install_command('import')}") from None
    try:
        require_content(path, DatasetError)
        with parquet.ParquetFile(path) as file:
            names = file.schema_arrow.names
            if missing := [name for name in columns if name not in names]:
                raise DatasetError(f"{path}: no column `{missing[0]}`; give a file of Waymo's parquet form")
            for batch in file.iter_batches(_BATCH, columns=list(columns)):
                for row in range(batch.num_rows):
                    yield {name: _plain(batch.column(name)[row]) for name in columns}
    except (pyarrow.ArrowException, OSError, KeyError) as reason:  # KeyError: two columns of one name
        text = " ".join(str(reason).split())[:100]
        raise DatasetError(f"{path}: not a readable parquet file ({text}); copy it again") from None


def _plain(value: Any) -> Any:
    items: Any = getattr(value, "values", None)  # of a list; None for a null list
    try:
        return value.as_py() if not hasattr(items, "to_numpy") else items.to_numpy(zero_copy_only=False)
    except (ValueError, TypeError, LookupError, OverflowError, NotImplementedError):  # includes Arrow's own
        return None
