"""What the node publishes fits ROS' definitions, in CDR bytes too, and says what the boxes say."""

from math import cos, sin
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_deploy import Detections
from asca_deploy.ros2 import messages
from asca_deploy.ros2.messages import Stamp, detection_array, diagnostic_array, filled, marker_array
from asca_deploy.tracker import Tracks
from asca_pillars.pictures.colors import class_shares
from tests.deploy.ros2.ros_messages import built, store

STAMP = Stamp(12, 345, "lidar_top")
BOXES = np.array([[10, -2, -0.5, 4, 1.8, 1.5, 0.3], [5, 1, -0.7, 0.8, 0.6, 1.7, -2.0]], np.float32)
FOUND = Detections(BOXES, np.array([0.9, 0.5], np.float32), np.array([0, 1]), ("Car", "Pedestrian"))
TRACKS = Tracks(FOUND, np.array([7, 3]), np.array([[3.0, -4.0], [0.1, 0.0]]))


def read_back(kind: str, fields: dict[str, Any]) -> Any:
    one = store()
    return one.deserialize_cdr(one.serialize_cdr(built(one, kind, fields), kind), kind)


def test_markers_delete_what_was_before_and_show_each_box() -> None:
    array = read_back("visualization_msgs/msg/MarkerArray", marker_array(STAMP, FOUND))
    first, *others = array.markers
    assert first.action == 3 and [marker.type for marker in others] == [1, 9, 1, 9]
    assert all((m.header.stamp.sec, m.header.stamp.nanosec, m.header.frame_id) == tuple(STAMP) for m in array.markers)
    assert len({(marker.ns, marker.id) for marker in others}) == len(others)
    cube, text = others[:2]
    assert (cube.scale.x, cube.scale.y, cube.scale.z) == pytest.approx((4, 1.8, 1.5))
    assert (cube.pose.position.x, cube.pose.position.y, cube.pose.position.z) == pytest.approx((10, -2, -0.5))
    assert (cube.pose.orientation.z, cube.pose.orientation.w) == pytest.approx((sin(0.15), cos(0.15)))
    assert (cube.color.r, cube.color.g, cube.color.b) == pytest.approx(class_shares("Car"))
    assert text.text == "Car 0.90" and text.pose.position.z > -0.5 + 0.75


def test_markers_of_tracks_have_identities_and_arrows_of_those_that_move() -> None:
    array = read_back("visualization_msgs/msg/MarkerArray", marker_array(STAMP, TRACKS))
    assert [marker.text for marker in array.markers if marker.type == 9] == ["7 Car 0.90", "3 Pedestrian 0.50"]
    (arrow,) = (marker for marker in array.markers if marker.type == 0 and marker.action == 0)
    half = np.arctan2(-4, 3) / 2
    assert arrow.scale.x == pytest.approx(5)
    assert (arrow.pose.orientation.z, arrow.pose.orientation.w) == pytest.approx((sin(half), cos(half)))


@pytest.mark.parametrize(("found", "ids"), [(FOUND, ["", ""]), (TRACKS, ["7", "3"])])
def test_detections_of_vision_msgs(found: Detections | Tracks, ids: list[str]) -> None:
    array = read_back("vision_msgs/msg/Detection3DArray", detection_array(STAMP, found))
    assert (array.header.stamp.sec, array.header.frame_id) == (12, "lidar_top")
    assert [one.id for one in array.detections] == ids
    car, walker = array.detections
    assert (car.results[0].hypothesis.class_id, walker.results[0].hypothesis.class_id) == ("Car", "Pedestrian")
    assert car.results[0].hypothesis.score == pytest.approx(0.9)
    assert (walker.bbox.center.position.x, walker.bbox.size.x, walker.bbox.size.z) == pytest.approx((5, 0.8, 1.7))
    assert walker.bbox.center.orientation.z == pytest.approx(sin(-1))
    assert walker.results[0].pose.pose.position.x == pytest.approx(5)


def test_no_boxes_delete_those_before() -> None:
    empty = Detections.empty(("Car",))
    assert len(read_back("visualization_msgs/msg/MarkerArray", marker_array(STAMP, empty)).markers) == 1
    assert read_back("vision_msgs/msg/Detection3DArray", detection_array(STAMP, empty)).detections == []


def test_diagnostics() -> None:
    fields = diagnostic_array(1, 2, level=messages.WARN, message="slow", hardware_id="model", values={"dropped": 3})
    status = read_back("diagnostic_msgs/msg/DiagnosticArray", fields).status[0]
    assert (status.level, status.message, status.hardware_id) == (1, "slow", "model")
    assert [(pair.key, pair.value) for pair in status.values] == [("dropped", "3")]


class Inner:
    def __init__(self) -> None:
        self.level, self.name = b"\0", ""

    def get_fields_and_field_types(self) -> dict[str, str]:
        return {"level": "octet", "name": "string"}


class Outer:
    def __init__(self) -> None:
        self.one, self.kept = Inner(), 4.0
        self.many: list[Inner] = []

    def get_fields_and_field_types(self) -> dict[str, str]:
        return {"one": "a_msgs/Inner", "many": "sequence<a_msgs/Inner, 5>", "kept": "double"}


def test_messages_are_filled_by_their_own_types(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(messages, "message_type", lambda kind: asked.append(kind) or Inner)
    message = filled(Outer(), {"one": {"level": 2}, "many": [{"name": "a"}, {"name": "b"}]})
    assert message.one.level == b"\2" and [one.name for one in message.many] == ["a", "b"] and message.kept == 4.0
    assert asked == ["sequence<a_msgs/Inner, 5>"]


def test_types_are_found_by_their_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.import_module", lambda name: type("module", (), {"Inner": name}))
    for kind in ("a_msgs/Inner", "sequence<a_msgs/Inner>", "sequence<a_msgs/Inner, 5>"):
        assert messages.message_type(kind) == "a_msgs.msg"
    with pytest.raises(ValueError, match="no type"):
        messages.message_type("double")
