"""Waymo's open dataset in its parquet form (v2): lidar/, lidar_box/, lidar_calibration/ with a file for each segment.

Its scans are range images inside those files, so points are written: a .npy for each frame, all sensors and returns, in
the vehicle's frame (x forward, y left, z up, z = 0 on the ground). Where lidar_pose/ and vehicle_pose/ are there too,
points are moved to the time of the labels. Columns: https://github.com/waymo-research/waymo-open-dataset,
v2/perception.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from asca_pillars.data.boxes.box_frames import DATASET_FILE
from asca_pillars.data.boxes.box_records import BoxRecords, records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import MARKER, Imported, ImportedFrame, require_own_dataset
from asca_pillars.data.importing.parquet_rows import parquet_rows
from asca_pillars.data.importing.waymo_range_image import Doubles, LidarCalibration, range_image_points
from asca_pillars.data.scans.find_scans import visible_files
from asca_pillars.errors import DatasetError
from asca_pillars.files import atomic_path, write_text

TOP = 1
"""The roof's sensor."""
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


def read_waymo(root: Path, out: Path) -> Imported:
    """Every frame of every segment; scans are written to out/scans/<segment>/, those that are there are kept.

    Args:
        root: the folder with lidar/, lidar_box/ and lidar_calibration/ (training/ or validation/).
        out: folder of the new dataset.

    Raises:
        DatasetError: a file is missing or not of this format.
        OutputError: `out` holds something else.
        AscaError: pyarrow is not installed.
    """
    segments = visible_files(root / "lidar", "*.parquet")
    if not segments:
        raise DatasetError(f"{root}: no lidar/*.parquet there; give a folder of Waymo's parquet form")
    require_own_dataset(out)
    if not (out / DATASET_FILE).exists():
        # It marks the folder from the start, so that an import that was killed can be given again.
        write_text(out / DATASET_FILE, MARKER)
    bar = track(segments, "Reading segments", transient=True)
    frames = [frame for path in bar for frame in _frames(root, path, out.resolve() / "scans")]
    top = _calibrations(root / "lidar_calibration" / segments[0].name).get(TOP)
    x, y, z = np.zeros(3) if top is None else np.round(top.vehicle_from_lidar[:3, 3], 3).tolist()
    settings = BoxDataset(
        sensor_height=0.0, reflectance_scale=1.0, scans=str(out.resolve() / "scans"), sensor_position=(x, y, z)
    )
    return Imported(settings, frames)


def _frames(root: Path, lidar: Path, scans: Path) -> Iterator[ImportedFrame]:
    labels = _labels(root / "lidar_box" / lidar.name)
    nothing = records_from(np.zeros((0, 7)), ())
    for time in _write_scans(root, lidar, scans / lidar.stem):
        yield ImportedFrame(scans / lidar.stem / f"{time}.npy", labels.get(time, nothing), lidar.stem)


def _write_scans(root: Path, lidar: Path, folder: Path) -> list[int]:
    """Write the scans of a segment that are not there yet; the times of all of them."""
    missing = Counter(row[_TIME] for row in parquet_rows(lidar, (_TIME,)))
    times = sorted(missing)
    missing = Counter({time: rows for time, rows in missing.items() if not (folder / f"{time}.npy").exists()})
    if not missing:
        return times
    calibrations = _calibrations(root / "lidar_calibration" / lidar.name)
    vehicle_poses = _vehicle_poses(root / "vehicle_pose" / lidar.name)
    pixel_poses = _pixel_poses(root / "lidar_pose" / lidar.name) if vehicle_poses else iter(())
    early: dict[int, NDArray[np.float32]] = {}
    points: dict[int, list[NDArray[np.float32]]] = defaultdict(list)
    columns = (_TIME, _LASER, *(f"{image}.{part}" for image in _IMAGES for part in ("values", "shape")))
    for row in parquet_rows(lidar, columns):
        time, laser = row[_TIME], row[_LASER]
        if time not in missing:
            continue
        if laser not in calibrations:
            raise DatasetError(f"{lidar}: sensor {laser} has no calibration; download lidar_calibration/ again")
        if laser == TOP:  # the only one whose pixels have poses
            while time not in early and (other := next(pixel_poses, None)) is not None:
                early |= {other[0]: other[1]} if other[0] in missing else {}
        poses = early.pop(time, None) if laser == TOP else None
        for image in (_image(row, name, lidar) for name in _IMAGES):
            if image is not None:
                points[time].append(range_image_points(image, calibrations[laser], poses, vehicle_poses.get(time)))
        missing[time] -= 1
        if not missing[time]:  # all sensors of the frame
            with atomic_path(folder / f"{time}.npy") as temporary, temporary.open("wb") as file:
                np.save(file, np.concatenate([*points.pop(time, []), np.zeros((0, 4), np.float32)]))
    return times


def _labels(path: Path) -> dict[int, BoxRecords]:
    """The boxes of each frame."""
    own: dict[int, list[dict[str, Any]]] = defaultdict(list)
    for row in parquet_rows(path, (_TIME, _OBJECT, f"{_BOX}.type", *_BOX_COLUMNS)):
        own[row[_TIME]].append(row)
    return {
        time: records_from(
            np.array([[row[name] for name in _BOX_COLUMNS] for row in rows], np.float64),
            [TYPES.get(row[f"{_BOX}.type"], "Unknown") for row in rows],
            None,
            [row[_OBJECT] for row in rows],
        )
        for time, rows in own.items()
    }


def _calibrations(path: Path) -> dict[int, LidarCalibration]:
    """Of each sensor, by its number."""
    columns = (_LASER, _EXTRINSIC, *(f"{_INCLINATION}.{part}" for part in ("values", "min", "max")))
    found = {}
    for row in parquet_rows(path, columns):
        inclinations = row[f"{_INCLINATION}.values"]
        found[row[_LASER]] = LidarCalibration(
            np.reshape(row[_EXTRINSIC], (4, 4)),
            inclinations if inclinations is not None and len(inclinations) else None,
            row[f"{_INCLINATION}.min"],
            row[f"{_INCLINATION}.max"],
        )
    return found


def _vehicle_poses(path: Path) -> dict[int, Doubles]:
    """(4, 4) of each frame from the vehicle to the world; empty where they were not downloaded."""
    if not path.is_file():
        return {}
    return {row[_TIME]: np.reshape(row[_VEHICLE_POSE], (4, 4)) for row in parquet_rows(path, (_TIME, _VEHICLE_POSE))}


def _pixel_poses(path: Path) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Time and (H, W, 6) of each frame, of the sensor that has them; nothing where they were not downloaded."""
    if not path.is_file():
        return
    columns = (_TIME, _LASER, f"{_PIXEL_POSE}.values", f"{_PIXEL_POSE}.shape")
    for row in parquet_rows(path, columns):
        image = _image(row, _PIXEL_POSE, path) if row[_LASER] == TOP else None
        if image is not None:
            yield row[_TIME], image


def _image(row: dict[str, Any], name: str, path: Path) -> NDArray[np.float32] | None:
    """A range image (H, W, C); None where the sensor has none."""
    values, shape = row[f"{name}.values"], row[f"{name}.shape"]
    if values is None or shape is None or not len(values):
        return None
    if len(shape) != 3 or int(np.prod(shape)) != len(values):
        raise DatasetError(f"{path}: {name} has {len(values)} values for the shape {list(shape)}; copy the file again")
    return np.asarray(values, np.float32).reshape(shape)
