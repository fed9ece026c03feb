"""Farthest-point sampling against its definition, and points near boxes against shapely."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.ops.points.sampling import farthest_points, points_near_boxes
from tests.ops.numpy_kernels import both_forms, by_numpy
from tests.ops.points.clouds import CLOUDS, cloud


def plain(points: np.ndarray, count: int) -> list[int]:
    """PointNet++'s sampling, one loop inside the other."""
    chosen = [0][: min(len(points), count)]
    while chosen and len(chosen) < count:
        away = np.min([((points[:, :3] - points[i, :3]) ** 2).astype(np.float32) @ np.ones(3) for i in chosen], axis=0)
        if away.max() == 0:
            break
        chosen.append(int(away.argmax()))
    return chosen


@given(CLOUDS, st.integers(0, 40))
def test_both_forms_take_the_same_points(points: np.ndarray, count: int) -> None:
    compiled, in_numpy = both_forms(farthest_points, points, count)
    assert compiled.dtype == in_numpy.dtype == np.int32
    assert compiled.tolist() == in_numpy.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_is_plain_sampling(seed: int) -> None:
    points = cloud(seed, 200, 8.0, coarse=True)  # a lattice: sums are exact in any order, and many are equal
    assert farthest_points(points, 60).tolist() == plain(points, 60)


def test_takes_every_position_once() -> None:
    points = np.repeat(cloud(0, 30, 5.0, coarse=False), 3, axis=0)
    chosen = farthest_points(points, 1000)
    assert sorted(chosen.tolist()) == list(range(0, 90, 3))


def test_covers_better_with_each_sample() -> None:
    points = cloud(1, 2000, 10.0, coarse=False)
    chosen = farthest_points(points, 256)
    away = np.linalg.norm(points[:, None, :3] - points[None, chosen, :3], axis=2)
    # No point is farther from the samples than the last sample was from those before it.
    last = away[chosen[-1], :-1].min()
    assert away[:, :-1].min(axis=1).max() == pytest.approx(last)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_refuses_what_has_no_place(bad: float) -> None:
    points = cloud(0, 5, 1.0, coarse=False)
    points[3, 1] = bad
    with pytest.raises(ValueError, match="finite"):
        farthest_points(points, 2)
    with pytest.raises(ValueError, match="shape"):
        farthest_points(points[:, :2], 2)


def test_a_stray_point_costs_no_memory() -> None:
    points = cloud(2, 100, 5.0, coarse=False)
    points[50, :2] = 3e7, -2e7
    assert farthest_points(points, 20).tolist() == by_numpy(farthest_points, points, 20).tolist()


@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.floats(0, 5), st.sampled_from([0.0, 60.0, 3e4, 1e7]))
def test_points_near_boxes(seed: int, count: int, margin_m: float, offset_m: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (200, 4)).astype(np.float32)
    boxes = rng.uniform([-20, -20, 0, 0.5, 0.5, 1, -3], [20, 20, 1, 5, 2, 2, 3], (count, 7)).astype(np.float32)
    points[:, :2] += offset_m
    boxes[:, :2] += offset_m
    points[0, :2] = -3e7  # a stray one
    compiled, in_numpy = both_forms(points_near_boxes, points, boxes, margin_m)
    assert compiled.tobytes() == in_numpy.tobytes() and compiled.shape == in_numpy.shape
    if offset_m > 60:  # float32 rounds too much for shapely's answer
        return
    reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2 + margin_m
    disks = [(shapely.Point(box[:2]), r) for box, r in zip(boxes, reach, strict=True)]
    found = {row.tobytes() for row in compiled}
    for point in points:
        away = [center.distance(shapely.Point(point[:2])) - r for center, r in disks]
        if not any(abs(gap) < 1e-4 for gap in away):
            assert (point.tobytes() in found) == any(gap < 0 for gap in away)


def test_points_near_circles_of_any_size() -> None:
    """Cells that a circle covers, reaches or leaves out, and points on their borders."""
    rng = np.random.default_rng(0)
    points = (rng.integers(-400, 400, (20000, 4)) / 8).astype(np.float32)
    sizes = [0.01, 0.5, 3.0, 40.0]
    boxes = np.array([[x, 10 - x, 0, size, size, 1, 0] for x, size in zip((-30, 20, 3, 5), sizes, strict=True)])
    for some in (boxes[:2], boxes[1:3], boxes):
        compiled, in_numpy = both_forms(points_near_boxes, points, some, 0.25)
        assert 0 < len(compiled) < len(points) and compiled.tobytes() == in_numpy.tobytes()
