"""The result type: lengths, parts, and what it refuses."""

import copy
import json
from typing import Any

import numpy as np
import pytest

from asca_pillars.detection.detections import Detection, Detections
from tests.helpers.sent import sent

THREE = Detections(
    boxes=np.array([[3.0, -4.0, 0, 4, 2, 1.5, 0], [8, 6, 0, 1, 1, 2, 1], [-5, 12, 0, 2, 1, 2, 2]], np.float32),
    scores=np.array([0.9, 0.6, 0.3], np.float32),
    labels=np.array([0, 2, 1]),
    class_names=("Car", "Pedestrian", "Cyclist"),
)


def test_names_distances_and_plain_values() -> None:
    assert len(THREE) == 3
    assert THREE.names == ["Car", "Cyclist", "Pedestrian"]
    np.testing.assert_allclose(THREE.distances_m, [5, 10, 13])
    first = THREE.to_dicts()[0]
    place = {"x_m": 3.0, "y_m": -4.0, "z_m": 0.0}
    size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5}
    assert first == {"class": "Car", "score": 0.9, **place, **size, "yaw_rad": 0.0}
    assert json.loads(THREE.to_json()) == THREE.to_dicts()


@pytest.mark.parametrize(
    ("index", "names"),
    [
        (THREE.scores > 0.5, ["Car", "Cyclist"]),
        (slice(1, None), ["Cyclist", "Pedestrian"]),
        (np.array([2, 0]), ["Pedestrian", "Car"]),
        ([1], ["Cyclist"]),
        (np.zeros(3, bool), []),
    ],
)
def test_parts(index: Any, names: list[str]) -> None:
    part = THREE[index]
    assert part.names == names
    assert part.boxes.shape == (len(names), 7)
    assert part.class_names == THREE.class_names


def test_empty_and_arrays_of_different_lengths() -> None:
    empty = Detections.empty(("Car",))
    assert len(empty) == 0 and empty.names == list(empty) == []
    assert empty.boxes.shape == (0, 7) and empty.distances_m.shape == (0,)
    assert (empty.boxes.dtype, empty.scores.dtype, empty.labels.dtype) == (np.float32, np.float32, np.int64)
    assert len(empty[empty.scores > 0.5]) == 0
    with pytest.raises(ValueError, match=r"\(3, 7\), \(2,\) and \(3,\)"):
        Detections(THREE.boxes, THREE.scores[:2], THREE.labels, THREE.class_names)


def test_one_number_is_one_detection() -> None:
    found = THREE[1]
    assert found == Detection("Cyclist", pytest.approx(0.6), 8, 6, 0, 1, 1, 2, 1)  # type: ignore[arg-type]
    assert found.distance_m == 10 and THREE[-1].class_name == "Pedestrian" == THREE[np.int64(2)].class_name
    np.testing.assert_array_equal(found.box, THREE.boxes[1])
    with pytest.raises(IndexError):
        THREE[3]


def test_they_can_be_copied_and_sent_to_other_processes() -> None:
    for other in (sent(THREE), copy.deepcopy(THREE)):
        assert list(other) == [THREE[0], THREE[1], THREE[2]] and other.class_names == THREE.class_names
