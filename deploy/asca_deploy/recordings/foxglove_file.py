"""Boxes as an MCAP that Foxglove shows: `foxglove.SceneUpdate` in JSON, one message for each scan.

Foxglove identifies the schema by its name (docs.foxglove.dev, Message schemas); the part that is used is defined here.
Each message deletes the boxes of the scan before and adds its own, so that jumping in time shows one scan's boxes.
Opened beside the recording, they lie in its 3D panel: frame and times are those of the scans.
"""

import json
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.recordings.results import FrameResult
from asca_pillars.pictures.colors import class_shares

TOPIC = "/asca/boxes"
LIBRARY = "asca-pillars boxes"
_ARROW_S = 1.0  # an arrow is as long as the way of so many seconds
_MOVES_MPS = 0.5


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _list_of(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": item}


_NUMBER, _TEXT, _BOOL, _WHOLE = ({"type": kind} for kind in ("number", "string", "boolean", "integer"))
_TIME = _object("time", sec=_WHOLE, nsec=_WHOLE)
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LENGTHS = dict.fromkeys(("shaft_length", "shaft_diameter", "head_length", "head_diameter"), _NUMBER)
SCHEMA = _object(
    "foxglove.SceneUpdate",
    deletions=_list_of(_object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_WHOLE, id=_TEXT)),
    entities=_list_of(
        _object(
            "foxglove.SceneEntity",
            timestamp=_TIME,
            frame_id=_TEXT,
            id=_TEXT,
            lifetime=_object("duration", sec=_WHOLE, nsec=_WHOLE),
            frame_locked=_BOOL,
            metadata=_list_of(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
            arrows=_list_of(_object("foxglove.ArrowPrimitive", pose=_POSE, **_LENGTHS, color=_COLOR)),
            cubes=_list_of(_object("foxglove.CubePrimitive", pose=_POSE, size=_VECTOR, color=_COLOR)),
            spheres=_list_of({"type": "object"}),
            cylinders=_list_of({"type": "object"}),
            lines=_list_of({"type": "object"}),
            triangles=_list_of({"type": "object"}),
            texts=_list_of(
                _object(
                    "foxglove.TextPrimitive",
                    pose=_POSE,
                    billboard=_BOOL,
                    font_size=_NUMBER,
                    scale_invariant=_BOOL,
                    color=_COLOR,
                    text=_TEXT,
                )
            ),
            models=_list_of({"type": "object"}),
        )
    ),
)


def is_own_mcap(path: Path) -> bool:
    """Return whether it is an MCAP that a `FoxgloveFile` wrote, and no recording."""
    with path.open("rb") as file:
        start = file.read(100)  # magic, then a header with the name of what wrote the file
    return start.startswith(b"\x89MCAP") and LIBRARY.encode() in start


class FoxgloveFile:
    """Writes an MCAP; `finish` completes it."""

    def __init__(self, file: IO[bytes]) -> None:
        from mcap.writer import Writer

        self._writer = Writer(file)
        self._writer.start(profile="", library=LIBRARY)
        schema = self._writer.register_schema("foxglove.SceneUpdate", "jsonschema", json.dumps(SCHEMA).encode())
        self._channel = self._writer.register_channel(TOPIC, "json", schema)

    def write(self, result: FrameResult, points: NDArray[np.float32] | None = None) -> None:
        """Write one message."""
        data = json.dumps(scene_update(result)).encode()
        self._writer.add_message(self._channel, result.time_ns, data, result.time_ns, result.number)

    def finish(self) -> None:
        """Write the index and the end."""
        self._writer.finish()


def scene_update(result: FrameResult) -> dict[str, Any]:
    """Return a scan's boxes as the fields of foxglove.SceneUpdate."""
    time = {"sec": result.time_ns // 10**9, "nsec": result.time_ns % 10**9}
    entities = []
    for row, box in enumerate(result.detections):
        x, y, z, length, width, height, yaw = box[2:]
        red, green, blue = class_shares(box.class_name)
        color = {"r": red, "g": green, "b": blue, "a": 0.4}
        pose = {"position": {"x": x, "y": y, "z": z}, "orientation": _about_z(yaw)}
        above = {"position": {"x": x, "y": y, "z": z + height / 2 + 0.4}, "orientation": _about_z(0.0)}
        name, text, arrows = f"box-{row}", f"{box.class_name} {box.score:.2f}", []
        metadata = [{"key": "class", "value": box.class_name}, {"key": "score", "value": f"{box.score:.3f}"}]
        if result.tracks is not None:
            number = int(result.tracks.track_ids[row])
            vx, vy = result.tracks.velocities_mps[row].tolist()
            speed = float(np.hypot(vx, vy))
            name, text = f"track-{number}", f"{box.class_name} {number}"
            metadata += [{"key": "track_id", "value": str(number)}, {"key": "speed_mps", "value": f"{speed:.2f}"}]
            if speed > _MOVES_MPS:
                arrows.append(_arrow(pose["position"], float(np.arctan2(vy, vx)), speed * _ARROW_S, color))
        entities.append(
            {
                "timestamp": time,
                "frame_id": result.frame_id,
                "id": name,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": True,
                "metadata": metadata,
                "arrows": arrows,
                "cubes": [{"pose": pose, "size": {"x": length, "y": width, "z": height}, "color": color}],
                **{kind: [] for kind in ("spheres", "cylinders", "lines", "triangles", "models")},
                "texts": [
                    {
                        "pose": above,
                        "billboard": True,
                        "font_size": 12.0,
                        "scale_invariant": True,
                        "color": color | {"a": 1.0},
                        "text": text,
                    }
                ],
            }
        )
    everything = 1  # SceneEntityDeletion.ALL
    return {"deletions": [{"timestamp": time, "type": everything, "id": ""}], "entities": entities}


def _arrow(position: dict[str, float], heading_rad: float, length_m: float, color: dict[str, float]) -> dict[str, Any]:
    return {
        "pose": {"position": position, "orientation": _about_z(heading_rad)},
        "shaft_length": length_m,
        "shaft_diameter": 0.1,
        "head_length": 0.4,
        "head_diameter": 0.25,
        "color": color | {"a": 1.0},
    }


def _about_z(yaw_rad: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": float(np.sin(yaw_rad / 2)), "w": float(np.cos(yaw_rad / 2))}
