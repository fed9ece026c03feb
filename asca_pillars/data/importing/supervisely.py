"""Supervisely's point cloud projects, and CVAT's Sly Point Cloud Format 1.0, which has the same files.

    meta.json                     the classes
    key_id_map.json               numbers of objects
    <dataset>/ann/<scan>.pcd.json objects, and a figure (cuboid_3d) for each box; radians

Their forward axes differ: a box of Supervisely with yaw 0 faces y and `dimensions` are width, length and
height; one of CVAT faces x, and they are length, width and height. Formats: https://docs.supervisely.com (point
cloud annotation) and https://docs.cvat.ai (formats).
"""

import json
import math
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import read_text
from asca_pillars.data.importing.imported import Imported, entry
from asca_pillars.data.importing.tool_labels import (
    COLORS,
    ScanLabels,
    ToolBox,
    class_names,
    json_of,
    read_tool_labels,
    rounded,
    rounded_angle,
    track_numbers,
    xyz,
)
from asca_pillars.data.yaw_units import yaw_error
from asca_pillars.scans.find_scans import files_below
from asca_pillars.scans.scan_settings import ScanSettings

_META, _KEYS = "meta.json", "key_id_map.json"
_SHAPE = "cuboid_3d"
_QUARTER = math.pi / 2
_NAMESPACE = uuid.UUID("6c1de7d4-3f0e-4c52-9a2b-4f4d0c3e8a11")
"""Namespace of keys, so that the same boxes always get the same keys."""


def read_supervisely(source: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every annotation of a project; see `read_tool_labels`."""
    return _read(source, scans, settings, along_y=True)


def read_cvat(source: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every annotation of an export; see `read_tool_labels`."""
    return _read(source, scans, settings, along_y=False)


def write_supervisely(frames: Sequence[ScanLabels]) -> Mapping[str, str]:
    """Return files by relative paths: a project whose datasets are the folders of the scans."""
    return _write(frames, along_y=True)


def write_cvat(frames: Sequence[ScanLabels]) -> Mapping[str, str]:
    """Return files by relative paths; CVAT imports them in a .zip as annotations of a task."""
    return _write(frames, along_y=False)


def _read(source: Path, scans: Path, settings: ScanSettings, *, along_y: bool) -> Imported:
    if any(path.name == "tracklet_labels.xml" for path in files_below(source)):
        raise DatasetError(f"{source}: tracklets; export as Sly Point Cloud Format 1.0, which names the scans")
    identities: dict[str, object] = {}
    path = source / _KEYS
    if path.is_file():
        try:
            identities = dict(entry(json_of(read_text(path, DatasetError)), "objects"))
        except (ValueError, TypeError) as reason:
            raise DatasetError(f"{path}: {reason}") from None

    def parse(text: str) -> Iterable[ToolBox]:
        content = json_of(text)
        kinds = {entry(item, "key"): entry(item, "classTitle") for item in entry(content, "objects")}
        for figure in entry(content, "figures"):
            if entry(figure, "geometryType") != _SHAPE:
                continue  # points and masks are not boxes
            key, geometry = entry(figure, "objectKey"), entry(figure, "geometry")
            pitch, roll, yaw = xyz(geometry, "rotation").tolist()
            if (reason := yaw_error(yaw)) is not None:  # before the quarter turn is added
                raise ValueError(f"a yaw {reason}")
            size = xyz(geometry, "dimensions")
            if along_y:
                size, yaw = size[[1, 0, 2]], math.remainder(yaw + _QUARTER, 2 * math.pi)
            tilt = max(abs(pitch), abs(roll))
            yield ToolBox(kinds.get(key), xyz(geometry, "position"), size, yaw, tilt, str(identities.get(key, key)))

    return read_tool_labels(source, scans, settings, ".json", parse, left=frozenset({_META, _KEYS}))


def _write(frames: Sequence[ScanLabels], *, along_y: bool) -> Mapping[str, str]:
    classes = [
        {"title": name, "shape": _SHAPE, "color": COLORS[number % len(COLORS)], "geometry_config": {}}
        for number, name in enumerate(class_names(frames))
    ]
    files = {_META: json.dumps({"classes": classes, "tags": [], "projectType": "point_clouds"}, indent=1)}
    identities = track_numbers(frames)
    keys: dict[str, dict[str, int]] = {"tags": {}, "objects": {}, "figures": {}, "videos": {}}
    for number, frame in enumerate(frames):
        frame_key = _key("scan", frame.name.as_posix())
        keys["videos"][frame_key] = number
        objects, figures = {}, []
        for row, (box, kind) in enumerate(zip(frame.records.boxes, frame.records.types, strict=True)):
            identity = identities[number, row]
            object_key, figure_key = _key("object", identity), _key("box", f"{frame.name.as_posix()} {row}")
            keys["objects"].setdefault(object_key, int(identity) if identity.isdecimal() else len(keys["objects"]) + 1)
            keys["figures"][figure_key] = len(keys["figures"]) + 1
            objects[object_key] = {"key": object_key, "classTitle": kind, "tags": []}
            *size, yaw = rounded(box[3:7])
            if along_y:
                size, yaw = [size[1], size[0], size[2]], rounded_angle(math.remainder(yaw - _QUARTER, 2 * math.pi))
            geometry = {
                "position": dict(zip("xyz", rounded(box[:3]), strict=True)),
                "rotation": dict(zip("xyz", [0, 0, yaw], strict=True)),
                "dimensions": dict(zip("xyz", size, strict=True)),
            }
            figures.append({"key": figure_key, "objectKey": object_key, "geometryType": _SHAPE, "geometry": geometry})
        content = {"description": "", "key": frame_key, "tags": [], "objects": [*objects.values()], "figures": figures}
        dataset = "_".join(frame.name.parent.parts) or "ds0"
        files[f"{dataset}/ann/{frame.name.name}.pcd.json"] = json.dumps(content, indent=1)
    files[_KEYS] = json.dumps(keys, indent=1)
    return files


def _key(kind: str, name: str) -> str:
    return uuid.uuid5(_NAMESPACE, f"{kind} {name}").hex
