"""Messages of ROS 2 made of dicts by the definitions of rosbags, and those of vision_msgs, which it has not."""

from collections.abc import Mapping
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

# vision_msgs 4 (ROS 2 Humble and later), without comments.
_VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}


def store() -> Any:
    one = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in _VISION.items():
        types |= get_types_from_msg(text, f"vision_msgs/msg/{name}")
    one.register(types)
    return one


def built(one: Any, kind: str, fields: Mapping[str, Any]) -> Any:
    """A message with these fields, and 0 or nothing in the others; KeyError for a field that it does not have."""
    _, definitions = one.fielddefs[kind]
    names = {name for name, _ in definitions}
    if unknown := fields.keys() - names:
        raise KeyError(f"{kind} has no {unknown}")
    return one.types[kind](**{name: _value(one, what, fields.get(name)) for name, what in definitions})


def _value(one: Any, what: Any, value: Any) -> Any:
    node, detail = what
    if node.name == "NAME":
        return built(one, detail, value or {})
    if node.name == "BASE":
        kind = detail[0]
        return value if value is not None else "" if kind == "string" else False if kind == "bool" else 0
    item, length = detail
    if node.name == "ARRAY":
        import numpy as np

        return np.zeros(length) if value is None else value
    if item[0].name == "NAME":
        return [built(one, item[1], entry) for entry in value or ()]
    import numpy as np

    return np.zeros(0, np.uint8) if value is None else value
