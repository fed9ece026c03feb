"""SUSTechPOINTS' labels: a JSON list for each scan, with position, scale and rotation (radians) of each box.

Format: https://github.com/naurril/SUSTechPOINTS, a folder for each scene with lidar/ and label/.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from asca_pillars.data.importing.imported import Imported, entry
from asca_pillars.data.importing.tool_labels import (
    ScanLabels,
    ToolBox,
    json_of,
    read_tool_labels,
    rounded,
    track_numbers,
    xyz,
)
from asca_pillars.scans.scan_settings import ScanSettings


def read_sustechpoints(source: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every label file below `source`; see `read_tool_labels`."""
    return read_tool_labels(source, scans, settings, ".json", _parse)


def _parse(text: str) -> Iterable[ToolBox]:
    content = json_of(text)
    if not isinstance(content, list):
        raise ValueError("no list of boxes; give the folder label/ of a scene")
    for item in content:
        psr = entry(item, "psr")
        roll, pitch, yaw = xyz(psr, "rotation").tolist()
        track = item.get("obj_id")
        yield ToolBox(
            entry(item, "obj_type"),
            xyz(psr, "position"),
            xyz(psr, "scale"),
            yaw,
            max(abs(roll), abs(pitch)),
            None if track in (None, "") else str(track),
        )


def write_sustechpoints(frames: Sequence[ScanLabels]) -> Mapping[str, str]:
    """Return files by relative paths: a scene is a folder of scans, and has label/."""
    identities = track_numbers(frames)
    files = {}
    for number, frame in enumerate(frames):
        boxes, types = frame.records.boxes, frame.records.types
        content = [
            {
                "obj_id": identities[number, row],
                "obj_type": kind,
                "psr": {
                    "position": dict(zip("xyz", rounded(box[:3]), strict=True)),
                    "scale": dict(zip("xyz", rounded(box[3:6]), strict=True)),
                    "rotation": dict(zip("xyz", [0.0, 0.0, *rounded(box[6:])], strict=True)),
                },
            }
            for row, (box, kind) in enumerate(zip(boxes, types, strict=True))
        ]
        folder = frame.name.parent
        scene = folder.parent if folder.name == "lidar" else folder
        files[(scene / "label" / f"{frame.name.name}.json").as_posix()] = json.dumps(content, indent=1)
    return files
