"""Where an object may be put, and what it hides there."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.data.insertion.free_placement import MARGIN_M, Scene, is_clear, move_to_free_position, rays_entering
from asca_pillars.data.insertion.free_space import find_free_space
from asca_pillars.data.insertion.gt_database import StoredObject
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.ops.pillar.grid import PillarGrid
from tests.data.insertion.simple_streets import LEVEL, cast, polygons, stand, street

GRID = PillarGrid(x_range_m=(0, 40.96), y_range_m=(-20.48, 20.48), v_max_m=0.32, zones=1).ranges
NO_BOXES = np.zeros((0, 7), np.float32)


def frame_of(points: np.ndarray, boxes: np.ndarray, labels: list[int]) -> LabeledFrame:
    return LabeledFrame("made", points.astype(np.float32), boxes.astype(np.float32), np.array(labels, np.int64))


def scanned(box: np.ndarray, label: int = 0) -> StoredObject:
    """An object as the database has it: alone on the street."""
    points = cast(LEVEL, box[None])
    return StoredObject(box, label, points[points_in_boxes(points, box[None])[:, 0]])


def scene_of(*boxes: np.ndarray, labels: Sequence[int] = (), items: Sequence[StoredObject] = ()) -> Scene:
    """A level street with these labelled boxes and inserted items."""
    array = np.array(boxes, np.float32).reshape(-1, 7)
    scene = Scene(frame_of(cast(LEVEL, array), array, [*labels]), array)
    for item in items:
        scene.add(item)
    return scene


coordinates = st.floats(-30, 30)


@settings(max_examples=60)
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
    nearer, beyond = (0.7 * center[0], 0.7 * center[1], center[2]), tuple(1.5 * c for c in center)
    points = np.array([point, nearer, beyond], np.float32)
    hit = rays_entering(points, box)
    along = np.linspace(0, 1, 2000)[:, None, None] * points[None].astype(float)
    for margin_m, expected in ((-0.02, True), (0.02, False)):
        inside = points_in_boxes(along.reshape(-1, 3), box, margin_m=margin_m).reshape(2000, -1).any(axis=0)
        assert (hit[inside == expected] == expected).all()


def test_rays_of_several_boxes_and_boxes_that_are_clear_of_others() -> None:
    points = street(0)[0]
    boxes = np.array([stand("Car", 10, 3, 1), stand("Pedestrian", 8, -2), stand("Car", -10, 3)])
    each = [rays_entering(points, box[None]) for box in boxes]
    assert each[0].any() and each[1].any() and not each[2].any()
    assert np.array_equal(rays_entering(points, boxes), np.any(each, axis=0))
    assert not rays_entering(points, NO_BOXES).any() and rays_entering(points[:0], boxes).shape == (0,)
    car = stand("Car", 10, 0)
    assert is_clear(car, NO_BOXES, GRID)
    for x, y, clear in ((10, 1.5, False), (13.8, 0, False), (10, 1.7, True), (14.0, 0, True)):
        assert is_clear(car, stand("Car", x, y)[None], GRID) == clear
    assert not is_clear(stand("Car", 41.5, 0), NO_BOXES, GRID) and not is_clear(stand("Car", 10, -21), NO_BOXES, GRID)


@settings(max_examples=15)
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


def test_places_are_found_where_there_are_some() -> None:
    points, boxes, _ = street(1)
    space, scene = find_free_space(points), Scene(frame_of(points, boxes, [0] * 4), boxes)
    item, draws = scanned(stand("Pedestrian", 12, 0)), map(np.random.default_rng, range(10))
    found = [move_to_free_position(item, space, scene, GRID, rng) for rng in draws]
    assert all(found) and len({float(placed.box[1]) for placed in found if placed}) >= 8
    points, boxes, _ = street(1)
    scene, rng = Scene(frame_of(points, boxes, [0] * 4), boxes), np.random.default_rng(0)
    for x, ground in ((10, points[:0]), (2.0, points)):
        assert move_to_free_position(scanned(stand("Car", x, 0)), find_free_space(ground), scene, GRID, rng) is None


def test_inserted_objects_hide_what_is_behind_and_need_points_as_others_do() -> None:
    behind, beside, item = stand("Car", 20, 0), stand("Pedestrian", 15, 6), scanned(stand("Car", 10, 0, np.pi / 2), 2)
    scene, points = scene_of(behind, beside, labels=[0, 1], items=[item]), cast(LEVEL, np.array([behind, beside]))
    frame, hidden = scene.frame_with_inserted(min_points=1), rays_entering(points, item.box[None])
    assert hidden.sum() > 100 and np.array_equal(frame.points, np.concatenate([points[~hidden], item.points]))
    assert np.array_equal(frame.boxes, [behind, beside, item.box]) and frame.labels[1:].tolist() == [1, 2]
    # The car behind keeps its roof, or nothing; either way its label says whether there is something to find.
    left = points_in_boxes(frame.points, behind[None]).sum()
    assert frame.labels[0] == (0 if left else IGNORED)
    assert scene.frame_with_inserted(min_points=int(left) + 1).labels.tolist() == [IGNORED, 1, 2]
    # Exactly so many are enough.
    item = scanned(stand("Car", 10, 0), label=2)
    for more, label in ((0, 2), (1, IGNORED)):
        assert scene_of(items=[item]).frame_with_inserted(len(item.points) + more).labels.tolist() == [label]


def test_a_scan_drawn_with_the_object_in_it_is_what_insertion_gives() -> None:
    """Ground truth: cast the rays once more with the object standing there."""
    boxes, item = [stand("Car", 18, 3, 0.4), stand("Pedestrian", 12, -3)], scanned(stand("Car", 11, 1, 0.3))
    inserted = scene_of(*boxes, labels=[0, 1], items=[item]).frame_with_inserted(min_points=1).points
    truth = cast(LEVEL, np.array([*boxes, item.box]))
    order = [np.lexsort(np.round(cloud[:, :3], 3).T) for cloud in (inserted, truth)]
    assert len(inserted) == len(truth)
    np.testing.assert_allclose(inserted[order[0]], truth[order[1]], atol=2e-3)


def test_objects_do_not_hide_one_another() -> None:
    """Neither may most of a labelled object be hidden, nor most of one inserted before, nor of the new one itself."""
    far, near, beside = stand("Pedestrian", 16, 0), stand("Car", 10, 0, np.pi / 2), stand("Car", 10, 6)
    assert scene_of(far, labels=[IGNORED]).keeps_all_visible(scanned(near))
    for scene, hiding in (
        (scene_of(far, labels=[1]), near),
        (scene_of(items=[scanned(far)]), near),
        (scene_of(items=[scanned(near)]), far),
    ):
        assert not scene.keeps_all_visible(scanned(hiding)) and scene.keeps_all_visible(scanned(beside))


@pytest.mark.parametrize(
    ("behind", "share"), [(stand("Pedestrian", 16, 0), (0, 0.5)), (stand("Car", 20, 4.5, np.pi / 2), (0.01, 0.99))]
)
def test_inserted_objects_hide_each_other(behind: np.ndarray, share: tuple[float, float]) -> None:
    """As GT-Aug may place them: what is behind, or its edge, loses its points, in either order, and then its label."""
    far, near = scanned(behind, 1), scanned(stand("Car", 10, 0, np.pi / 2), 0)
    left = int((~rays_entering(far.points, near.box[None])).sum())
    assert share[0] <= left / len(far.points) < share[1]
    for items in ((far, near), (near, far)):
        scene = scene_of(items=items)
        labels = scene.frame_with_inserted(min_points=left + 1).labels.tolist()
        assert labels == [IGNORED if item is far else 0 for item in items]
        assert points_in_boxes(scene.frame_with_inserted(1).points, far.box[None]).sum() == left
