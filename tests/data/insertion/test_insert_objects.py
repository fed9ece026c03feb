"""Insertion as a whole: which classes, how many, the same for the same seed, and nothing else changed.

Where an object may be put, and what it hides there.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.cli.train import prepare
from asca_pillars.config.tree import Config, DataConfig
from asca_pillars.data.augment import augment
from asca_pillars.data.boxes.box_records import json_line, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.frames import LabeledFrame, read_frame, within_ranges
from asca_pillars.data.insertion.free_space import find_free_space
from asca_pillars.data.insertion.gt_database import StoredObject, prepare_database
from asca_pillars.data.insertion.insert_objects import (
    MARGIN_M,
    Inserter,
    Scene,
    insert_objects,
    insertion_shares,
    is_clear,
    move_to_free_position,
    rays_entering,
)
from asca_pillars.data.kitti import KittiSplit, objects_3d, read_labels, write_image_set, write_labels
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.training.dataset import open_dataset
from tests.data.insertion.inserters import METHODS, config, open_inserter
from tests.data.insertion.simple_streets import LEVEL, TYPES, cast, polygons, stand, street, write_streets
from tests.helpers.scenes import SPEC
from tests.helpers.sent import sent

FRAMES = 4


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_streets(tmp_path_factory.mktemp("streets"), FRAMES)


def inserter_of(root: Path, method: str, **insert: object) -> Inserter:
    return open_inserter(KittiSplit(root, "train"), config(method, **insert))


def prepared_in(folder: Path, settings_: Config) -> Config:
    return dataclasses.replace(settings_, data=dataclasses.replace(settings_.data, prepared=str(folder)))


def frame_of(root: Path, number: int) -> LabeledFrame:
    return read_frame(KittiSplit(root, "train"), f"{number:06d}", TYPES)


def augmented(inserter: Inserter, root: Path, number: int, seed: int = 0) -> tuple[LabeledFrame, LabeledFrame]:
    before = frame_of(root, number)
    return before, insert_objects(before, inserter, np.random.default_rng((seed, number)))


def assert_same(one: LabeledFrame, other: LabeledFrame) -> None:
    assert np.array_equal(one.points, other.points) and np.array_equal(one.boxes, other.boxes)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.floats(0, 20), st.one_of(st.just(0.0), st.floats(0.05, 3))), min_size=1, max_size=5).filter(
        lambda pairs: any(wanted for _, wanted in pairs)
    ),
    st.integers(1, 30),
)
def test_shares_fill_the_classes_up_to_one_level(pairs: list[tuple[float, float]], objects: int) -> None:
    there, wanted = np.array(pairs).T
    shares = insertion_shares(there, wanted, objects)
    assert shares.sum() == pytest.approx(1) and (shares >= -1e-12).all() and not shares[wanted == 0].any()
    asked = wanted > 0
    after = (there + objects * shares)[asked] / wanted[asked]
    filled = shares[asked] > 1e-9
    assert np.ptp(after[filled]) < 1e-6 * max(after.max(), 1)
    assert (after[~filled] >= after[filled].min() - 1e-6 * after.max()).all()


@pytest.mark.parametrize("method", METHODS)
def test_what_is_inserted_touches_nothing(root: Path, method: str) -> None:
    inserter = inserter_of(root, method, objects=8)
    inserted = 0
    for number, seed in itertools.product(range(FRAMES), range(2)):
        before, after = augmented(inserter, root, number, seed)
        new, others = polygons(after.boxes[len(before.boxes) :]), polygons(before.boxes)
        if method == "rs_aug":
            others += polygons(inserter.free_space(before.frame_id).clusters)
        assert not any(one.intersection(other).area > 1e-6 for one in new for other in others)
        assert not any(a.intersection(b).area > 1e-6 for a, b in itertools.combinations(new, 2))
        inserted += len(new)
    assert inserted > 2 * FRAMES * 2


@pytest.mark.parametrize("method", METHODS)
def test_the_rest_of_the_frame_stays(root: Path, method: str) -> None:
    inserter = inserter_of(root, method)
    before, after = augmented(inserter, root, 2)
    copy = frame_of(root, 2)
    assert np.array_equal(before.points, copy.points) and np.array_equal(before.labels, copy.labels)
    count = len(before.boxes)
    assert len(after.boxes) > count and np.array_equal(after.boxes[:count], before.boxes)
    assert after.points.dtype == after.boxes.dtype == np.float32 and after.labels.dtype == np.int64
    assert after.frame_id == before.frame_id and len(after.boxes) == len(after.labels)
    kept = {tuple(row) for row in before.points.tolist()}
    new = np.array([tuple(row) not in kept for row in after.points.tolist()])
    held = [points_in_boxes(after.points, after.boxes[count:], margin_m) for margin_m in (1e-3, -1e-3)]
    within, deep = (np.any(inside, axis=1) for inside in held)
    assert new.any() and within[new].all() and not deep[~new].any(), "of the frame, nothing is left in the new boxes"


def test_gt_aug_leaves_objects_in_place_and_another_process_gives_the_same(root: Path) -> None:
    inserter = inserter_of(root, "gt_aug")
    stored = {tuple(box) for box in inserter.database.boxes.tolist()}
    before, after = augmented(inserter, root, 1)
    new = after.boxes[len(before.boxes) :]
    assert len(new) and all(tuple(box) in stored for box in new.tolist())
    # The loader sends its workers what it has pickled.
    frames = open_dataset(root, config("rs_aug"), training=True)
    there = sent(frames)
    for index in ((0, 1), (1, 0)):
        assert_same(there.sample(*index).frame, frames.sample(*index).frame)


@pytest.mark.parametrize("method", METHODS)
def test_other_types_are_in_the_way_too(tmp_path: Path, method: str) -> None:
    """A lorry, which is no class, stands over the whole street: there is no room for anything."""
    split = KittiSplit(write_streets(tmp_path, 2), "train")
    inserter = open_inserter(split, config(method))
    car = objects_3d(read_labels(split.label_path("000000")))[0]
    lorry = dataclasses.replace(car, type="Truck", length_m=100.0, width_m=100.0)
    write_labels(split.label_path("000000"), [lorry])
    before, after = augmented(inserter, tmp_path, 0)
    assert len(before.boxes) == 0
    assert_same(before, after)


@pytest.mark.parametrize(
    ("proportions", "expected"),
    [({}, (1, 1, 1)), ({"Pedestrian": 1, "Car": 1, "Cyclist": 1.5}, (1, 1, 1.5)), ({"Cyclist": 1, "Car": 1}, None)],
)
def test_counts_approach_the_proportions(
    root: Path, proportions: dict[str, float], expected: tuple[float, ...] | None
) -> None:
    inserter = inserter_of(root, "rs_aug", objects=4, proportions=proportions)
    before, after = np.zeros(3), np.zeros(3)
    for number, seed in itertools.product(range(FRAMES), range(6)):
        for counts, frame in zip((before, after), augmented(inserter, root, number, seed), strict=True):
            counts += np.bincount(frame.labels[frame.labels >= 0], minlength=3)
    if expected is None:  # the class that was not asked for stays as it is
        assert after[1] == before[1] and after[2] > 1.5 * before[2]
        return
    ratio = after / np.array(expected)
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.2, ratio
    assert np.ptp(before / np.array(expected) / before.mean()) > 0.3


@pytest.mark.parametrize("method", METHODS)
def test_samples_depend_on_seed_epoch_and_frame_alone(root: Path, method: str) -> None:
    """Not on the order in which they are asked for, as by a run that resumes; from an epoch on nothing is inserted."""
    always, again, early, never = (
        open_dataset(root, settings_, training=True)
        for settings_ in (config(method), config(method), config(method, disable_after_epoch=2), config("none"))
    )
    again.sample(1, 3)
    for number in (3, 2):
        assert_same(again.sample(0, number).frame, always.sample(0, number).frame)
    for epoch, number in itertools.product(range(4), (3, 2)):
        like = always if epoch < 2 else never
        assert_same(early.sample(epoch, number).frame, like.sample(epoch, number).frame)
    first, second = always.sample(0, 3).frame, always.sample(1, 3).frame
    assert len(first.points) != len(second.points) or not np.array_equal(first.points, second.points)
    assert len(early.sample(1, 3).frame.boxes) > len(early.sample(2, 3).frame.boxes)


def test_without_insertion_everything_is_as_before(root: Path, tmp_path: Path) -> None:
    """Neither method `none` nor 0 objects changes what else is drawn, and no folder is made for `none`."""
    plain = prepared_in(tmp_path / "prepared", config("none"))
    rng = np.random.default_rng((plain.train.seed, 2, 3))
    frame = within_ranges(augment(frame_of(root, 3), plain.augment, rng), SPEC.grid.ranges)
    pillars = SPEC.pillarize(frame.points)
    for settings_ in (plain, config("rs_aug", objects=0), config("gt_aug", objects=0)):
        sample = open_dataset(root, settings_, training=True).sample(2, 3)
        assert_same(sample.frame, frame)
        assert np.array_equal(sample.prepared.pillars.features, pillars.features)
    assert not (tmp_path / "prepared").exists()


def test_a_frame_without_ground_or_points_stays_as_it_is(tmp_path: Path) -> None:
    split = KittiSplit(write_streets(tmp_path, 3), "train")
    inserter = open_inserter(split, config("rs_aug"))
    for number, x in enumerate((9, -9)):
        write_scan(split.scan_path(f"00000{number}"), np.array([[x, 0, 0, 0.5]], np.float32))
        assert_same(*augmented(inserter, tmp_path, number))


def test_a_class_without_objects_is_named(tmp_path: Path) -> None:
    split = KittiSplit(write_streets(tmp_path, 2), "train")
    for frame_id in split.frame_ids:
        path = split.label_path(frame_id)
        path.write_text(path.read_text().replace("Cyclist", "Misc"))
    with pytest.raises(DatasetError, match=r"list `train` has no Cyclist with a point in it; .* --propose") as caught:
        open_dataset(tmp_path, config("rs_aug"), training=True)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
    assert inserter_of(tmp_path, "rs_aug", proportions={"Car": 1, "Pedestrian": 1}).shares[2] == 0
    with pytest.raises(DatasetError, match="has no Car with 1000000 or more points"):
        inserter_of(tmp_path, "gt_aug", min_points=1_000_000, proportions={"Car": 1})


@pytest.mark.parametrize(
    ("proportions", "message"),
    [({"Bus": 1.0}, r"proportions\.Bus: no such class; available: Car, "), ({"Car": 0.0}, "all are 0")],
)
def test_impossible_proportions_are_refused(proportions: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config("rs_aug", proportions=proportions)


def test_processes_of_the_database_and_plain_validation(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(
        "asca_pillars.data.insertion.insert_objects.prepare_database",
        lambda *args, workers, **more: asked.append(workers) or prepare_database(*args, **more),
    )
    open_inserter(KittiSplit(root, "train"), dataclasses.replace(config("gt_aug"), data=DataConfig(workers=3)))
    assert asked == [3]
    monkeypatch.setattr("asca_pillars.data.augment.prepare_inserter", lambda *_: pytest.fail("built"))
    sample = open_dataset(root, config("rs_aug"), training=False).sample(0, 0)
    assert np.array_equal(sample.frame.points, frame_of(root, 0).points)


def test_prepare_leaves_nothing_for_training_to_compute(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = tmp_path / "model.yaml", tmp_path / "prepared"
    path.write_text("augment: {insert: {method: rs_aug}}")
    prepare(path, data=root, override=[f"data.prepared={folder}"], workers=1)
    assert f"{4 * FRAMES} objects of {FRAMES} frames" in capsys.readouterr().out
    made = {file: file.stat().st_mtime_ns for file in folder.rglob("*.n*")}
    assert len(made) == FRAMES + 2
    for name in ("free_space.find_free_space", "gt_database._build"):
        monkeypatch.setattr(f"asca_pillars.data.insertion.{name}", lambda *_: pytest.fail("again"))
    frames = open_dataset(root, prepared_in(folder, config("rs_aug")), training=True)
    assert all(len(frames.sample(0, number).frame.boxes) for number in range(FRAMES))
    assert {file: file.stat().st_mtime_ns for file in made} == made


# --- scans in the vehicle's frame


def write_boxes(street: Path, root: Path, sensor_m: tuple[float, float, float]) -> Path:
    """The same street without a camera, in a frame in which the sensor stands there."""
    split, lines = KittiSplit(street, "train"), []
    for frame_id in split.frame_ids:
        frame = read_frame(split, frame_id, TYPES, camera_view=False)
        points, boxes = frame.points, np.array(frame.boxes, np.float64)
        points[:, :3] = np.round(points[:, :3] * 512) / 512 + sensor_m  # rounded, so that moving them rounds nothing
        boxes[:, :6] = np.round(boxes[:, :6] * 512) / 512
        boxes[:, :3] += sensor_m
        write_scan(root / "scans" / f"{frame_id}.bin", points)
        lines.append(json_line(f"{frame_id}.bin", records_from(boxes, [TYPES[label] for label in frame.labels])))
    (root / "labels.jsonl").write_text("".join(lines))
    (root / "dataset.yaml").write_text(f"sensor_position: {list(sensor_m)}\n")
    write_image_set(root, "train", split.frame_ids)
    return root


@pytest.mark.parametrize("method", METHODS)
def test_what_hides_what_is_seen_from_the_sensor(root: Path, tmp_path: Path, method: str) -> None:
    """In a vehicle's frame, as Argoverse 2's and Waymo's are, the origin is on the ground."""
    sensor_m, grown = (1.5, 0.25, 1.75), []
    for name, position in (("sensor", (0.0, 0.0, 0.0)), ("vehicle", sensor_m)):
        split = BoxSplit(write_boxes(root, tmp_path / name, position), "train")
        inserter = open_inserter(split, config(method, objects=6))
        inserter = dataclasses.replace(inserter, ranges=SPEC.ranges.shifted(position))
        frames = [read_frame(split, frame_id, TYPES) for frame_id in split.frame_ids]
        grown.append([insert_objects(frame, inserter, np.random.default_rng(0)) for frame in frames])
        assert sum(len(after.boxes) - len(before.boxes) for after, before in zip(grown[-1], frames, strict=True)) > 6
    for own, other in zip(*grown, strict=True):
        np.testing.assert_array_equal(other.labels, own.labels)
        for moved, still in ((other.points, own.points), (other.boxes, own.boxes)):
            assert len(moved) == len(still)
            np.testing.assert_allclose(moved[:, :3] - np.array(sensor_m, np.float32), still[:, :3], atol=1e-4)


GRID = PillarGrid(x_range_m=(0, 40.96), y_range_m=(-20.48, 20.48), v_max_m=0.32, zones=1).ranges
NO_BOXES = np.zeros((0, 7), np.float32)


def made_frame(points: np.ndarray, boxes: np.ndarray, labels: list[int]) -> LabeledFrame:
    return LabeledFrame("made", points.astype(np.float32), boxes.astype(np.float32), np.array(labels, np.int64))


def scanned(box: np.ndarray, label: int = 0) -> StoredObject:
    """An object as the database has it: alone on the street."""
    points = cast(LEVEL, box[None])
    return StoredObject(box, label, points[points_in_boxes(points, box[None])[:, 0]])


def scene_of(*boxes: np.ndarray, labels: Sequence[int] = (), items: Sequence[StoredObject] = ()) -> Scene:
    """A level street with these labelled boxes and inserted items."""
    array = np.array(boxes, np.float32).reshape(-1, 7)
    scene = Scene(made_frame(cast(LEVEL, array), array, [*labels]), array)
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
    scene = Scene(made_frame(points, boxes, [0] * 4), boxes)
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
    space, scene = find_free_space(points), Scene(made_frame(points, boxes, [0] * 4), boxes)
    item, draws = scanned(stand("Pedestrian", 12, 0)), map(np.random.default_rng, range(10))
    found = [move_to_free_position(item, space, scene, GRID, rng) for rng in draws]
    assert all(found) and len({float(placed.box[1]) for placed in found if placed}) >= 8
    points, boxes, _ = street(1)
    scene, rng = Scene(made_frame(points, boxes, [0] * 4), boxes), np.random.default_rng(0)
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
