"""nuScenes: the tables of v1.0-*/ and the key frames of samples/LIDAR_TOP/.

A box is given in the world and goes through the vehicle's pose at the scan's time into the sensor's frame, which is x
right, y forward, z up (`axes: y-forward`). The sensor's height is that above the vehicle's frame, whose origin lies on
the ground.
Tables by their published schema, https://www.nuscenes.org/nuscenes#data-format: a rotation is a quaternion w, x, y, z,
a size width, length, height. Categories of the detection task get its class names, others keep their own.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.boxes.box_records import BoxRecords, records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame
from asca_pillars.errors import DatasetError
from asca_pillars.geometry.rotations import of_quaternions
from asca_pillars.input_files import read_text

CHANNEL = "LIDAR_TOP"
DETECTION_CLASSES = {
    "movable_object.barrier": "barrier",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}

_Table = dict[str, dict[str, Any]]
_Doubles = NDArray[np.float64]


def read_nuscenes(root: Path) -> Imported:
    """The key frames of LIDAR_TOP that are there.

    Args:
        root: the folder with samples/ and one v1.0-*/, or that v1.0-*/.

    Raises:
        DatasetError: a table is missing or not of this format.
    """
    tables = _tables_folder(root)
    data = tables.absolute().parent.resolve()
    try:
        height_m = _sensor_height_m(tables)
        frames = _frames(tables, data)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DatasetError(f"{tables}: the tables do not fit together (at {error}); download them again") from None
    settings = BoxDataset(sensor_height=height_m, axes="y-forward", reflectance_scale=255.0, columns=5, scans=str(data))
    return Imported(settings, frames)


def _sensor_height_m(tables: Path) -> float | None:
    """The median over the vehicles' calibrations; None without any."""
    channels = {token: row["channel"] for token, row in _table(tables, "sensor").items()}
    sensors = _table(tables, "calibrated_sensor").values()
    heights = [row["translation"][2] for row in sensors if channels[row["sensor_token"]] == CHANNEL]
    return round(float(np.median(heights)), 3) if heights else None


def _frames(tables: Path, data: Path) -> list[ImportedFrame]:
    poses, sensors = _table(tables, "ego_pose"), _table(tables, "calibrated_sensor")
    samples, scenes = _table(tables, "sample"), _table(tables, "scene")
    channels = {token: row["channel"] for token, row in _table(tables, "sensor").items()}
    types = {token: row["name"] for token, row in _table(tables, "category").items()}
    kinds = {token: types[row["category_token"]] for token, row in _table(tables, "instance").items()}
    labels: dict[str, list[dict[str, Any]]] = {}
    for row in _table(tables, "sample_annotation").values():
        labels.setdefault(row["sample_token"], []).append(row)
    frames = []
    for row in _table(tables, "sample_data").values():
        sensor = sensors[row["calibrated_sensor_token"]]
        scan = data / row["filename"]
        if not row["is_key_frame"] or channels[sensor["sensor_token"]] != CHANNEL or not scan.is_file():
            continue
        records = _records(labels.get(row["sample_token"], []), poses[row["ego_pose_token"]], sensor, kinds)
        if not (np.isfinite(records.boxes).all() and (records.boxes[:, 3:6] > 0).all()):
            raise ValueError(f"sample {row['sample_token']}: a box with a number that is not finite or no size")
        frames.append(ImportedFrame(scan, records, scenes[samples[row["sample_token"]]["scene_token"]]["name"]))
    return frames


def _records(
    labels: list[dict[str, Any]], pose: dict[str, Any], sensor: dict[str, Any], kinds: dict[str, str]
) -> BoxRecords:
    boxes, types, tracks = [], [], []
    for label in labels:
        center, turn = np.array(label["translation"], np.float64), _rotation(label["rotation"])
        for frame in (pose, sensor):
            back = _rotation(frame["rotation"]).T
            center, turn = back @ (center - frame["translation"]), back @ turn
        width, length, height = label["size"]
        boxes.append([*center, length, width, height, np.arctan2(turn[1, 0], turn[0, 0])])
        kind = kinds[label["instance_token"]]
        types.append(DETECTION_CLASSES.get(kind, kind))
        tracks.append(label["instance_token"])
    return records_from(np.array(boxes).reshape(-1, 7), types, None, tracks)


def _rotation(quaternion: list[float]) -> _Doubles:
    turn = of_quaternions(np.array(quaternion))
    if not np.isfinite(turn).all():
        raise ValueError(f"rotation {quaternion}")
    return turn


def _tables_folder(root: Path) -> Path:
    if (root / "sample_data.json").is_file():
        return root
    found = sorted(path.parent for path in root.glob("v1.0-*/sample_data.json"))
    if len(found) != 1:
        there = ", ".join(path.name for path in found) or "none"
        raise DatasetError(f"{root}: one v1.0-*/ with nuScenes' tables is needed, there is {there}; give its path")
    return found[0]


def _table(folder: Path, name: str) -> _Table:
    path = folder / f"{name}.json"
    try:
        return {row["token"]: row for row in json.loads(read_text(path, DatasetError))}
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); nuScenes' metadata has this table") from None
    except (ValueError, TypeError, KeyError):
        raise DatasetError(f"{path}: no table of nuScenes, a list of rows with a token; download it again") from None
