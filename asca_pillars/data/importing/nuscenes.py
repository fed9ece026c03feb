"""nuScenes: the tables of v1.0-*/ and the key frames of samples/LIDAR_TOP/.

A box is given in the world and goes through the vehicle's pose at the scan's time into the sensor's frame, which is x
right, y forward, z up (`axes: y-forward`). The sensor's height is that above the vehicle's frame, whose origin lies on
the ground.

Tables by their published schema, https://www.nuscenes.org/nuscenes#data-format: a rotation is a quaternion w, x, y, z,
a size width, length, height. Categories of the detection task get its class names, others keep their own.
"""

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import file_inside, read_text
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import BoxRecords, records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame, SkippedEntries, entry, numbers, text_of
from asca_pillars.geometry.frame_change import rotations_from_quaternions

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

_Row = dict[str, Any]
_Table = dict[str, _Row]
_Doubles = NDArray[np.float64]


def read_nuscenes(root: Path, reporter: Reporter = SILENT) -> Imported:
    """Read the available key frames of LIDAR_TOP.

    Args:
        root: the folder with samples/ and one v1.0-*/, or that v1.0-*/.
        reporter: told of each row of sample_data.

    Raises:
        DatasetError: a table is missing or not of this format.
    """
    tables = _tables_folder(root)
    data = tables.absolute().parent.resolve()
    skipped = SkippedEntries()
    names = ("sensor", "calibrated_sensor", "ego_pose", "sample", "scene", "category", "instance", "sample_annotation")
    read = {name: _table(tables, name, skipped) for name in (*names, "sample_data")}
    frames = _frames(read, tables, data, skipped, reporter)
    settings = BoxDataset(
        sensor_height=_sensor_height_m(read), axes="y-forward", reflectance_scale=255.0, columns=5, scans=str(data)
    )
    return Imported(settings, frames, skipped)


def _sensor_height_m(tables: Mapping[str, _Table]) -> float | None:
    """Return the median over the vehicles' calibrations; None without any."""
    heights = []
    for row in tables["calibrated_sensor"].values():
        with contextlib.suppress(ValueError):  # reported where a frame needs it
            if _channel(row, tables) == CHANNEL:
                heights.append(numbers(entry(row, "translation"), 3, "translation")[2])
    return round(float(np.median(heights)), 3) if heights else None


def _frames(
    tables: Mapping[str, _Table], folder: Path, data: Path, skipped: SkippedEntries, reporter: Reporter
) -> list[ImportedFrame]:
    labels: dict[str, list[_Row]] = {}
    for token, row in tables["sample_annotation"].items():
        try:
            labels.setdefault(text_of(entry(row, "sample_token"), "sample_token"), []).append(row)
        except ValueError as reason:
            skipped.add("boxes", f"{folder}/sample_annotation.json, {token}", reason)
    frames = []
    for token, row in reporter.track(tables["sample_data"].items(), "Reading frames"):
        try:
            sensor = _linked(row, "calibrated_sensor", tables)
            if row.get("is_key_frame") is not True or _channel(sensor, tables) != CHANNEL:
                continue
            sample = _linked(row, "sample", tables)
            scene = text_of(entry(_linked(sample, "scene", tables), "name"), "the scene's name")
            filename = entry(row, "filename")
            scan = file_inside(data, filename) if isinstance(filename, str) else None
            if scan is None:
                if isinstance(filename, str) and ".." not in Path(filename).parts and not Path(filename).is_absolute():
                    continue  # only a part of the dataset may have been downloaded
                raise ValueError(f"filename is {str(filename)[:80]!r}, not a file below {data}")
            changes = [_change(frame) for frame in (_linked(row, "ego_pose", tables), sensor)]
            annotations = labels.get(row["sample_token"], [])
            frames.append(ImportedFrame(scan, _records(annotations, changes, tables, folder, skipped), scene))
        except ValueError as reason:
            skipped.add("frames", f"{folder}/sample_data.json, {token}", reason)
    return frames


def _records(
    labels: list[_Row],
    changes: list[tuple[_Doubles, _Doubles]],
    tables: Mapping[str, _Table],
    folder: Path,
    skipped: SkippedEntries,
) -> BoxRecords:
    boxes, types, tracks = [], [], []
    for label in labels:
        try:
            turn, center = _change(label)
            for back, origin in changes:
                center, turn = back.T @ (center - origin), back.T @ turn
            width, length, height = numbers(entry(label, "size"), 3, "size")
            kind = text_of(
                entry(_linked(_linked(label, "instance", tables), "category", tables), "name"), "the category"
            )
        except ValueError as reason:
            skipped.add("boxes", f"{folder}/sample_annotation.json, {label['token']}", reason)
            continue
        boxes.append([*center, length, width, height, np.arctan2(turn[1, 0], turn[0, 0])])
        types.append(DETECTION_CLASSES.get(kind, kind))
        tracks.append(label["instance_token"])
    return records_from(np.array(boxes).reshape(-1, 7), types, None, tracks)


def _change(row: _Row) -> tuple[_Doubles, _Doubles]:
    """Return the rotation (3, 3) and translation (3,), metres, of a row, to its parent frame."""
    turn = rotations_from_quaternions(numbers(entry(row, "rotation"), 4, "rotation"))
    if not np.isfinite(turn).all():
        raise ValueError(f"rotation is {row['rotation']}, not a quaternion")
    return turn, numbers(entry(row, "translation"), 3, "translation")


def _channel(sensor: _Row, tables: Mapping[str, _Table]) -> str:
    return text_of(entry(_linked(sensor, "sensor", tables), "channel"), "channel")


def _linked(row: _Row, name: str, tables: Mapping[str, _Table]) -> _Row:
    """Return the row of the table `name` that a row refers to; ValueError if there is none."""
    token = entry(row, f"{name}_token")
    if not isinstance(token, str) or token not in tables[name]:
        raise ValueError(f"{name}.json has no row {str(token)[:80]!r}")
    return tables[name][token]


def _tables_folder(root: Path) -> Path:
    if (root / "sample_data.json").is_file():
        return root
    folders = sorted(path.parent for path in root.glob("v1.0-*/sample_data.json"))
    if len(folders) != 1:
        names = ", ".join(path.name for path in folders) or "none"
        raise DatasetError(f"{root}: one v1.0-*/ with nuScenes' tables is needed, found {names}; give its path")
    return folders[0]


def _table(folder: Path, name: str, skipped: SkippedEntries) -> _Table:
    """Read the rows of a table by their tokens."""
    path = folder / f"{name}.json"
    try:
        rows = json.loads(read_text(path, DatasetError))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); nuScenes' metadata has this table") from None
    except (ValueError, RecursionError):
        rows = None
    if not isinstance(rows, list):
        raise DatasetError(f"{path}: not a nuScenes table (a list of rows with a token); download it again")
    table = {}
    for number, row in enumerate(rows):
        try:
            table[text_of(entry(row, "token"), "token")] = row
        except ValueError as reason:
            skipped.add("rows", f"{path}, row {number}", reason)
    return table
