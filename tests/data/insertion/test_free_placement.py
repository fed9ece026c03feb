"""Where an object may be put, and what it hides there."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.data.insertion.free_placement import MARGIN_M, Scene, is_clear, move_to_free_position, rays_entering
from asca_pillars.data.insertion.free_space import FreeSpace, find_free_space
from asca_pillars.data.insertion.gt_database import StoredObject
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.geometry.boxes import footprints, points_in_boxes, wrap_angle
from asca_pillars.ops.pillar.grid import PillarGrid
from tests.data.insertion.simple_streets import LEVEL, cast, stand, street

GRID = PillarGrid(x_range_m=(0, 40.96), y_range_m=(-20.48, 20.48), v_max_m=0.32, zones=1).ranges
NO_BOXES = np.zeros((0, 7), np.float32)


def frame_of(points: np.ndarray, boxes: np.ndarray, labels: list[int]) -> LabeledFrame:
    return LabeledFrame("made", points.astype(np.float32), boxes.astype(np.float32), np.array(labels, np.int64))


def scanned(box: np.ndarray, label: int = 0) -> StoredObject:
    """An object as the database has it: alone on the street."""
    points = cast(LEVEL, box[None])
    return StoredObject(box, label, points[points_in_boxes(points, box[None])[:, 0]])


coordinates = st.floats(-30, 30)


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(coordinates, coordinates, st.floats(-3, 3)),
    st.tuples(coordinates, coordinates, st.floats(-2, 2)),
    st.tuples(st.floats(0.5, 6), st.floats(0.5, 4), st.floats(0.5, 3)),
    st.floats(-3.1, 3.1),
)
def test_rays_are_cut_where_dense_samples_of_them_are_inside(
    point: tuple[float, ...], center: tuple[float, ...], size: tuple[float, ...], yaw: float
) -> None:
    box = np.array([[*center, *size, yaw]], np.float32)
    points = np.array(
        [point, (0.7 * center[0], 0.7 * center[1], center[2]), tuple(1.5 * c for c in center)], np.float32
    )
    hit = rays_entering(points, box)
    along = np.linspace(0, 1, 2000)[:, None, None] * points[None].astype(float)
    for margin_m, expected in ((-0.02, True), (0.02, False)):
        inside = points_in_boxes(along.reshape(-1, 3), box, margin_m=margin_m).reshape(2000, -1).any(axis=0)
        assert (hit[inside == expected] == expected).all()


def test_rays_of_several_boxes_and_of_none() -> None:
    points = street(0)[0]
    boxes = np.array([stand("Car", 10, 3, 1), stand("Pedestrian", 8, -2), stand("Car", -10, 3)])
    each = [rays_entering(points, box[None]) for box in boxes]
    assert each[0].any() and each[1].any() and not each[2].any()
    assert np.array_equal(rays_entering(points, boxes), np.any(each, axis=0))
    assert not rays_entering(points, NO_BOXES).any() and rays_entering(points[:0], boxes).shape == (0,)


def test_touching_boxes_and_those_beside_the_grid_are_not_clear() -> None:
    car = stand("Car", 10, 0)
    assert is_clear(car, NO_BOXES, GRID)
    for x, y, clear in ((10, 1.5, False), (13.8, 0, False), (10, 1.7, True), (14.0, 0, True)):
        assert is_clear(car, stand("Car", x, y)[None], GRID) == clear
    assert not is_clear(stand("Car", 41.5, 0), NO_BOXES, GRID) and not is_clear(stand("Car", 10, -21), NO_BOXES, GRID)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 4),
    name=st.sampled_from(["Car", "Pedestrian", "Cyclist"]),
    x=st.floats(7, 22),
    y=st.floats(-4, 4),
    yaw=st.floats(-3, 3),
    draw=st.integers(0, 1000),
    tilt=st.sampled_from([(0.0, 0.0), (0.02, -0.03)]),
)
def test_a_free_place(
    seed: int, name: str, x: float, y: float, yaw: float, draw: int, tilt: tuple[float, float]
) -> None:
    plane = (*tilt, LEVEL[2])
    points, boxes, _ = street(seed, plane)
    space = find_free_space(points)
    item = scanned(stand(name, x, y, yaw))
    scene = Scene(frame_of(points, boxes, [0] * 4), boxes)
    placed = move_to_free_position(item, space, scene, GRID, np.random.default_rng(draw))
    if placed is None:
        return
    # The sensor sees what it saw: the same distance, the same side, the same points in the box.
    turn = np.arctan2(placed.box[1], placed.box[0]) - np.arctan2(item.box[1], item.box[0])
    assert np.hypot(*placed.box[:2]) == pytest.approx(np.hypot(*item.box[:2]), abs=1e-3)
    assert abs(wrap_angle(placed.box[6] - item.box[6] - turn)) < 1e-4
    assert np.array_equal(placed.box[3:6], item.box[3:6]) and placed.label == item.label
    np.testing.assert_allclose(local(placed), local(item), atol=2e-3)
    assert np.array_equal(placed.points[:, 3], item.points[:, 3])
    # It stands on the street,
    ground_m = plane[0] * placed.box[0] + plane[1] * placed.box[1] + plane[2]
    assert placed.box[2] - placed.box[5] / 2 == pytest.approx(ground_m, abs=0.1)
    # and clear of everything, by a margin less the width of a cell where the map is that coarse.
    outline = polygons(placed.box[None])[0]
    assert all(outline.disjoint(other) for other in polygons(np.concatenate([boxes, space.clusters])))
    standing = points[points[:, 2] > points[:, :2] @ np.array(tilt) + LEVEL[2] + 0.3]
    assert not points_in_boxes(standing, placed.box[None] + np.array([0, 0, 0, MARGIN_M, MARGIN_M, 0, 0])).any()


def local(item: StoredObject) -> np.ndarray:
    away = item.points[:, :3].astype(float) - item.box[:3]
    cos, sin = np.cos(item.box[6]), np.sin(item.box[6])
    return away @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def polygons(boxes: np.ndarray) -> list[Polygon]:
    return [Polygon(outline) for outline in footprints(boxes.astype(float))]


def test_places_are_found_where_there_are_some() -> None:
    points, boxes, _ = street(1)
    space = find_free_space(points)
    scene = Scene(frame_of(points, boxes, [0] * 4), boxes)
    found = [
        move_to_free_position(scanned(stand("Pedestrian", 12, 0)), space, scene, GRID, np.random.default_rng(seed))
        for seed in range(10)
    ]
    assert all(item is not None for item in found) and len({float(item.box[1]) for item in found if item}) >= 8


def test_no_place_without_ground_or_at_a_distance_without_any() -> None:
    points, boxes, _ = street(1)
    scene = Scene(frame_of(points, boxes, [0] * 4), boxes)
    nowhere = find_free_space(points[:0])
    rng = np.random.default_rng(0)
    assert move_to_free_position(scanned(stand("Car", 10, 0)), nowhere, scene, GRID, rng) is None
    space: FreeSpace = find_free_space(points)
    assert move_to_free_position(scanned(stand("Car", 2.0, 0)), space, scene, GRID, rng) is None


def test_what_is_behind_an_inserted_object_disappears() -> None:
    behind, beside = stand("Car", 20, 0), stand("Pedestrian", 15, 6)
    points = cast(LEVEL, np.array([behind, beside]))
    scene = Scene(frame_of(points, np.array([behind, beside]), [0, 1]), np.array([behind, beside]))
    item = scanned(stand("Car", 10, 0, np.pi / 2), label=2)
    scene.add(item)
    frame = scene.frame_with_inserted(min_points=1)
    hidden = rays_entering(points, item.box[None])
    assert hidden.sum() > 100 and len(frame.points) == (~hidden).sum() + len(item.points)
    assert np.array_equal(frame.points[-len(item.points) :], item.points)
    assert np.array_equal(frame.points[: -len(item.points)], points[~hidden])
    assert np.array_equal(frame.boxes, [behind, beside, item.box]) and frame.labels[1:].tolist() == [1, 2]
    # The car behind keeps its roof, or nothing; either way its label says whether there is something to find.
    left = points_in_boxes(frame.points, behind[None]).sum()
    assert frame.labels[0] == (0 if left else IGNORED)
    assert scene.frame_with_inserted(min_points=int(left) + 1).labels.tolist() == [IGNORED, 1, 2]


def test_an_inserted_object_needs_as_many_points_as_a_labelled_one() -> None:
    """Exactly so many are enough."""
    scene = Scene(frame_of(cast(LEVEL, NO_BOXES), NO_BOXES, []), NO_BOXES)
    item = scanned(stand("Car", 10, 0), label=2)
    scene.add(item)
    for more, label in ((0, 2), (1, IGNORED)):
        assert scene.frame_with_inserted(min_points=len(item.points) + more).labels.tolist() == [label]


def test_a_scan_drawn_with_the_object_in_it_is_what_insertion_gives() -> None:
    """Ground truth: cast the rays once more with the object standing there."""
    boxes = np.array([stand("Car", 18, 3, 0.4), stand("Pedestrian", 12, -3)])
    item = scanned(stand("Car", 11, 1, 0.3), label=0)
    scene = Scene(frame_of(cast(LEVEL, boxes), boxes, [0, 1]), boxes)
    scene.add(item)
    inserted = scene.frame_with_inserted(min_points=1).points
    truth = cast(LEVEL, np.concatenate([boxes, item.box[None]]))
    order = [np.lexsort(np.round(cloud[:, :3], 3).T) for cloud in (inserted, truth)]
    assert len(inserted) == len(truth)
    np.testing.assert_allclose(inserted[order[0]], truth[order[1]], atol=2e-3)


def test_objects_do_not_hide_one_another() -> None:
    """Neither may most of a labelled object be hidden, nor most of one inserted before, nor of the new one itself."""
    far, near, beside = stand("Pedestrian", 16, 0), stand("Car", 10, 0, np.pi / 2), stand("Car", 10, 6)
    labeled = Scene(frame_of(cast(LEVEL, far[None]), far[None], [1]), far[None])
    assert not labeled.keeps_all_visible(scanned(near)) and labeled.keeps_all_visible(scanned(beside))
    ignored = Scene(frame_of(cast(LEVEL, far[None]), far[None], [IGNORED]), far[None])
    assert ignored.keeps_all_visible(scanned(near))
    empty = frame_of(cast(LEVEL, NO_BOXES), NO_BOXES, [])
    for first, second in ((far, near), (near, far)):
        scene = Scene(empty, NO_BOXES)
        scene.add(scanned(first))
        assert not scene.keeps_all_visible(scanned(second)) and scene.keeps_all_visible(scanned(beside))


def test_a_car_hides_the_edge_of_one_that_stands_beside_its_shadow() -> None:
    near, far = scanned(stand("Car", 10, 0, np.pi / 2)), scanned(stand("Car", 20, 4.5, np.pi / 2))
    left = int((~rays_entering(far.points, near.box[None])).sum())
    assert 0 < left < len(far.points)
    for items in ((far, near), (near, far)):
        scene = Scene(frame_of(cast(LEVEL, NO_BOXES), NO_BOXES, []), NO_BOXES)
        for item in items:
            scene.add(item)
        assert points_in_boxes(scene.frame_with_inserted(1).points, far.box[None]).sum() == left


def test_inserted_objects_hide_each_other() -> None:
    """As GT-Aug may place them: the one behind loses its points, in either order, and then its label."""
    far, near = scanned(stand("Pedestrian", 16, 0), 1), scanned(stand("Car", 10, 0, np.pi / 2), 0)
    empty = frame_of(cast(LEVEL, NO_BOXES), NO_BOXES, [])
    left = int((~rays_entering(far.points, near.box[None])).sum())
    assert left < len(far.points) / 2
    for items in ((far, near), (near, far)):
        scene = Scene(empty, NO_BOXES)
        for item in items:
            scene.add(item)
        labels = scene.frame_with_inserted(min_points=left + 1).labels.tolist()
        assert labels == [IGNORED if item is far else 0 for item in items]
        assert points_in_boxes(scene.frame_with_inserted(1).points, far.box[None]).sum() == left
