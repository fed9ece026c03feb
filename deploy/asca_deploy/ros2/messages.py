"""Messages of the node, as dicts with the fields of ROS messages; independent of ROS.

`filled` makes messages of them. Every box keeps the stamp and the frame of its scan. A field that a dict leaves out has
the message's own default.
"""

import importlib
import re
from collections.abc import Mapping, Sequence
from math import atan2, cos, hypot, sin
from typing import Any, NamedTuple, TypeAlias

from asca_deploy.tracker import Tracks
from asca_pillars.detection.detections import Detection, Detections
from asca_pillars.pictures.colors import class_shares

Fields: TypeAlias = dict[str, Any]

_CUBE, _ARROW, _TEXT, _DELETE_ALL = 1, 0, 9, 3  # visualization_msgs/Marker
OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
_ARROW_S = 1.0  # an arrow is as long as the way of so many seconds
_MOVES_MPS = 0.5
_TEXT_M = 0.8
_NESTED = re.compile(r"(?:sequence<)?(?P<package>\w+)/(?P<name>\w+)(?:, \d+)?>?")


class Stamp(NamedTuple):
    """Header of a scan and of all messages published for it."""

    sec: int
    nanosec: int
    frame_id: str

    @property
    def seconds(self) -> float:
        """The time stamp in seconds."""
        return self.sec + self.nanosec * 1e-9

    def header(self) -> Fields:
        """Return a `std_msgs/Header`."""
        return {"stamp": {"sec": self.sec, "nanosec": self.nanosec}, "frame_id": self.frame_id}


def stamp_of(header: Any) -> Stamp:
    """Return the stamp and frame of a `std_msgs/Header`."""
    return Stamp(int(header.stamp.sec), int(header.stamp.nanosec), str(header.frame_id))


def marker_array(stamp: Stamp, detections: Detections | Tracks, *, lifetime_s: float = 0.5) -> Fields:
    """Return a `visualization_msgs/MarkerArray`: deletion of the earlier boxes, then this scan's.

    A box is a cube and a text with class and score; of a track the text has the identity, and an arrow says where it
    will be in a second.

    Args:
        stamp: of the scan.
        detections: boxes in its frame, metres, with identities and velocities if they were tracked.
        lifetime_s: after which RViz removes them if no further scan comes.
    """
    lifetime = {"sec": int(lifetime_s), "nanosec": round(lifetime_s % 1 * 1e9)}
    common: Fields = {"header": stamp.header(), "lifetime": lifetime}
    markers: list[Fields] = [{"header": stamp.header(), "action": _DELETE_ALL}]
    for number, (box, track) in enumerate(_with_tracks(detections)):
        red, green, blue = class_shares(box.class_name)
        common |= {"id": number, "color": {"r": red, "g": green, "b": blue, "a": 0.4}}
        size = {"x": box.length_m, "y": box.width_m, "z": box.height_m}
        markers.append(common | {"ns": "boxes", "type": _CUBE, "pose": _pose(box), "scale": size})
        text = f"{box.class_name} {box.score:.2f}"
        above = _pose(box, lift_m=box.height_m / 2 + _TEXT_M)
        white = {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}
        if track is not None:
            text = f"{track[0]} {text}"
            if (speed := hypot(*track[1])) > _MOVES_MPS:
                arrow = _pose(box, yaw_rad=atan2(track[1][1], track[1][0]))
                solid = {"r": red, "g": green, "b": blue, "a": 1.0}
                shape = {"x": speed * _ARROW_S, "y": 0.2, "z": 0.2}
                markers.append(
                    common | {"ns": "velocities", "type": _ARROW, "pose": arrow, "scale": shape, "color": solid}
                )
        label = {"ns": "texts", "type": _TEXT, "pose": above, "scale": {"z": _TEXT_M}, "color": white, "text": text}
        markers.append(common | label)
    return {"markers": markers}


def detection_array(stamp: Stamp, boxes: Detections | Tracks) -> Fields:
    """Return a `vision_msgs/Detection3DArray`: a detection with class and score for each box, identities of tracks.

    Args:
        stamp: of the scan.
        boxes: boxes in its frame, metres.
    """
    header = stamp.header()
    detections = [
        {
            "header": header,
            "results": [
                {
                    "hypothesis": {"class_id": box.class_name, "score": float(box.score)},
                    "pose": {"pose": _pose(box)},
                }
            ],
            "bbox": {"center": _pose(box), "size": {"x": box.length_m, "y": box.width_m, "z": box.height_m}},
            "id": "" if track is None else str(track[0]),
        }
        for box, track in _with_tracks(boxes)
    ]
    return {"header": header, "detections": detections}


def diagnostic_array(
    sec: int, nanosec: int, *, level: int, message: str, hardware_id: str, values: Mapping[str, object]
) -> Fields:
    """Return a `diagnostic_msgs/DiagnosticArray` of one status.

    Args:
        sec: when, seconds.
        nanosec: and nanoseconds.
        level: OK, WARN or ERROR.
        message: a sentence.
        hardware_id: what it is about: the model.
        values: figures by their names.
    """
    pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
    status = {"level": level, "name": "asca: detector", "message": message, "hardware_id": hardware_id, "values": pairs}
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}}, "status": [status]}


def filled(message: Any, fields: Mapping[str, Any]) -> Any:
    """Return a message of ROS 2's Python, with these fields set; the others keep their values."""
    kinds = message.get_fields_and_field_types()
    for name, value in fields.items():
        if isinstance(value, Mapping):
            filled(getattr(message, name), value)
        elif isinstance(value, Sequence) and value and isinstance(value[0], Mapping):
            kind = message_type(kinds[name])
            setattr(message, name, [filled(kind(), item) for item in value])
        else:
            setattr(message, name, bytes([value]) if kinds[name] == "octet" else value)
    return message


def message_type(kind: str) -> Any:
    """Return the class of a type as ROS 2 writes it: `visualization_msgs/Marker`, or a sequence of these."""
    match = _NESTED.fullmatch(kind)
    if match is None:
        raise ValueError(f"{kind}: no type of messages")
    return getattr(importlib.import_module(f"{match['package']}.msg"), match["name"])


def _with_tracks(detections: Detections | Tracks) -> list[tuple[Detection, tuple[int, tuple[float, float]] | None]]:
    if isinstance(detections, Tracks):
        return [(track.detection, (track.track_id, (track.vx_mps, track.vy_mps))) for track in detections]
    return [(box, None) for box in detections]


def _pose(box: Detection, *, lift_m: float = 0.0, yaw_rad: float | None = None) -> Fields:
    """Return a `geometry_msgs/Pose` of a box's center, or above it; turned about z."""
    half = (box.yaw_rad if yaw_rad is None else yaw_rad) / 2
    return {
        "position": {"x": box.x_m, "y": box.y_m, "z": box.z_m + lift_m},
        "orientation": {"x": 0.0, "y": 0.0, "z": sin(half), "w": cos(half)},
    }
