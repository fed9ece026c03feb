"""labelCloud's labels: a JSON for each scan, degrees (centroid_abs) or radians (centroid_rel) by its _classes.json.

Boxes have a centroid, length, width and height, and rotations that are counter-clockwise from x. Format:
https://github.com/ch-sa/labelCloud, docs/documentation.md
"""

import json
import math
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
    xyz,
)
from asca_pillars.scans.scan_settings import ScanSettings

_CLASSES = "_classes.json"
_DEGREES, _RADIANS = "centroid_abs", "centroid_rel"
_TURN_DEG = 360.0


def read_labelcloud(source: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every label file below `source`; see `read_tool_labels`."""
    path = (source if source.is_dir() else source.parent) / _CLASSES
    unit = _unit(path) if path.is_file() else _DEGREES

    def parse(text: str) -> Iterable[ToolBox]:
        content = json_of(text)
        for item in entry(content, "objects"):
            if "vertices" in item:
                raise ValueError(f"has vertices; set the label format {_DEGREES} in labelCloud and save again")
            angles = xyz(item, "rotations").tolist()
            if unit == _DEGREES:
                if min(angles) < 0 or max(angles) > _TURN_DEG:
                    raise ValueError(
                        f"a rotation of {min(angles):g}, and {_DEGREES} has 0 to 360 degrees; of labels in radians "
                        f'put labelCloud\'s {_CLASSES} beside them, which states "format": "{_RADIANS}"'
                    )
                angles = [math.radians(angle) for angle in angles]
            tilt = max(abs(math.remainder(angle, 2 * math.pi)) for angle in angles[:2])
            size = xyz(item, "dimensions", ("length", "width", "height"))
            yield ToolBox(entry(item, "name"), xyz(item, "centroid"), size, angles[2], tilt)

    return read_tool_labels(source, scans, settings, ".json", parse)


def write_labelcloud(frames: Sequence[ScanLabels]) -> Mapping[str, str]:
    """Return files by relative paths: a JSON for each scan in degrees, and _classes.json."""
    names = class_names(frames)
    classes = {
        "classes": [
            {"name": name, "id": number, "color": COLORS[number % len(COLORS)]} for number, name in enumerate(names)
        ],
        "default": 0,
        "type": "object_detection",
        "format": _DEGREES,
        "created_with": {"name": "labelCloud", "version": "1.1.1"},
    }
    files = {_CLASSES: json.dumps(classes, indent=1)}
    for frame in frames:
        content = {
            "folder": frame.scan.parent.name,
            "filename": frame.scan.name,
            "path": str(frame.scan),
            "objects": [
                {
                    "name": kind,
                    "centroid": dict(zip("xyz", rounded(box[:3]), strict=True)),
                    "dimensions": dict(zip(("length", "width", "height"), rounded(box[3:6]), strict=True)),
                    "rotations": {"x": 0, "y": 0, "z": rounded_angle(math.degrees(yaw) % _TURN_DEG)},
                }
                for box, kind in zip(frame.records.boxes, frame.records.types, strict=True)
                for yaw in rounded(box[6:])
            ],
        }
        files[f"{frame.name.as_posix()}.json"] = json.dumps(content, indent=1)
    return files


def _unit(path: Path) -> str:
    try:
        unit = entry(json_of(read_text(path, DatasetError)), "format")
    except ValueError as reason:
        raise DatasetError(f"{path}: {reason}") from None
    if unit not in (_DEGREES, _RADIANS):
        raise DatasetError(f"{path}: the format {str(unit)[:40]}; set {_DEGREES} in labelCloud and save again")
    return str(unit)
