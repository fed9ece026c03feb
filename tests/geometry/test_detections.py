"""The result type: lengths, parts, and what it refuses."""

import numpy as np
import pytest

from asca_pillars.geometry.detections import Detections

THREE = Detections(
    boxes=np.array([[3.0, -4.0, 0, 4, 2, 1.5, 0], [8, 6, 0, 1, 1, 2, 1], [-5, 12, 0, 2, 1, 2, 2]], np.float32),
    scores=np.array([0.9, 0.6, 0.3], np.float32),
    labels=np.array([0, 2, 1]),
    class_names=("Car", "Pedestrian", "Cyclist"),
)


def test_names_and_distances() -> None:
    assert len(THREE) == 3
    assert THREE.names == ["Car", "Cyclist", "Pedestrian"]
    np.testing.assert_allclose(THREE.distances_m, [5, 10, 13])


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
def test_parts(index: object, names: list[str]) -> None:
    part = THREE[index]  # type: ignore[index]
    assert part.names == names
    assert part.boxes.shape == (len(names), 7)
    assert part.class_names == THREE.class_names


def test_empty() -> None:
    empty = Detections.empty(("Car",))
    assert len(empty) == 0 and empty.names == []
    assert empty.boxes.shape == (0, 7) and empty.distances_m.shape == (0,)
    assert (empty.boxes.dtype, empty.scores.dtype, empty.labels.dtype) == (np.float32, np.float32, np.int64)
    assert len(empty[empty.scores > 0.5]) == 0


def test_one_number_is_not_a_part() -> None:
    with pytest.raises(ValueError, match="shapes"):
        THREE[0]  # type: ignore[index]


def test_arrays_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(3, 7\), \(2,\) and \(3,\)"):
        Detections(THREE.boxes, THREE.scores[:2], THREE.labels, THREE.class_names)
