"""Whole frames: reproducible, readable, labelled as KITTI would.

How a simulation is divided.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.data.frames import read_frame
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, in_image, objects_3d
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.overlap import bev_intersection
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.simulation import Frame, SimulationConfig, held_out, simulate, simulate_frame
from asca_pillars.sim.world.scene import draw_scene
from tests.helpers.sent import sent

CAMERA = SimulationConfig(field_of_view="camera")


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [simulate_frame(0, index, CAMERA) for index in range(24)]


@pytest.fixture(scope="module")
def whole() -> list[Frame]:
    return [simulate_frame(0, index) for index in range(2)]


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_the_number_of_workers_does_not_change_a_byte(tmp_path: Path) -> None:
    simulate(tmp_path / "one", 3, seed=3, workers=1, config=CAMERA, val_share=0.4)
    simulate(tmp_path / "two", 3, seed=3, workers=2, config=CAMERA, val_share=0.4)
    one, two = files(tmp_path / "one"), files(tmp_path / "two")
    assert len(one) == 3 * 3 + 3  # and two lists, and what was simulated
    assert one == two


def test_a_cluster_writes_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What its workers do is done here; tests/cluster runs Ray."""
    handed_out = []

    def run_here(job, items, address, *, shard_size, seen, folders, **rest):
        assert seen.is_file() and {folder.name for folder in folders} == {"velodyne", "label_2", "calib"}
        for item in reversed(items):  # in any order
            sent(job)(item)
            handed_out.append(item)

    simulate(tmp_path / "one", 4, seed=3, config=CAMERA)
    monkeypatch.setattr("asca_pillars.sim.simulation.run_items", run_here)
    simulate(tmp_path / "two", 2, seed=3, config=CAMERA, cluster="made-up:1")
    simulate(tmp_path / "two", 4, seed=3, config=CAMERA, cluster="made-up:1")
    assert handed_out == [1, 0, 3, 2], "frames that are there are left out"
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_an_interrupted_run_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    simulate(tmp_path / "a", 3, seed=1, config=CAMERA)
    before = files(tmp_path / "a")
    (tmp_path / "a/training/velodyne/000001.bin").unlink()
    (tmp_path / "a/training/label_2/000001.txt").unlink()
    (tmp_path / "a/training/calib/000001.txt").write_text("")
    kept = tmp_path / "a/training/velodyne/000002.bin"
    stamp = kept.stat().st_mtime_ns
    simulate(tmp_path / "a", 3, seed=1, config=CAMERA)
    assert files(tmp_path / "a") == before
    assert kept.stat().st_mtime_ns == stamp


def test_frames_of_another_seed_or_configuration_are_not_mixed(tmp_path: Path) -> None:
    simulate(tmp_path, 1, seed=1, config=CAMERA)
    with pytest.raises(DatasetError, match=r"simulation\.json.*another folder"):
        simulate(tmp_path, 2, seed=2, config=CAMERA)
    with pytest.raises(DatasetError, match="another folder"):
        simulate(tmp_path, 2, seed=1)
    simulate(tmp_path, 2, seed=1, config=CAMERA)
    assert KittiSplit(tmp_path).frame_ids == ("000000", "000001")


def test_impossible_wishes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="frames is 0"):
        simulate(tmp_path / "x", 0)
    with pytest.raises(ConfigError, match=r"val_share is 1\.5"):
        simulate(tmp_path / "x", 1, val_share=1.5)
    with pytest.raises(ConfigError, match="cars is -1"):
        SceneConfig(cars=-1)
    with pytest.raises(ConfigError, match="lower bound comes first"):
        SceneConfig(relief_m=(2.0, 1.0))
    wrongs: list[dict[str, Any]] = [{"sensor_height_m": heights_m} for heights_m in ((-2.0, -1.0), (0.0, 1.0))]
    wrongs += [{"slope_x": (0.0, -0.1)}, {"box_lift_m": ((0.0, 0.03), (0.0, -0.05))}, {"clutter": (-15.0, 60.0)}]
    for wrong in (*wrongs, {"reach_m": 0.0}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            SceneConfig(**wrong)  # type: ignore[arg-type]
    assert not (tmp_path / "x").exists()


def test_written_frames_read_back_as_simulated(tmp_path: Path) -> None:
    simulate(tmp_path, 3, seed=5, config=CAMERA, val_share=0.34)
    assert KittiSplit(tmp_path, "train").frame_ids == ("000000", "000001")
    assert KittiSplit(tmp_path, "val").frame_ids == ("000002",)
    split = KittiSplit(tmp_path)
    for index, name in enumerate(split.frame_ids):
        frame = simulate_frame(5, index, CAMERA)
        points = np.fromfile(split.scan_path(name), np.float32).reshape(-1, 4)
        np.testing.assert_array_equal(points, frame.points)
        objects = split.objects(name)
        assert [o.type for o in objects] == [o.type for o in frame.objects]
        for read, made in zip(objects, frame.objects, strict=True):
            assert read.x_m == pytest.approx(made.x_m, abs=0.006)
            assert read.rotation_y == pytest.approx(made.rotation_y, abs=0.006)
        np.testing.assert_allclose(split.calibration(name).p2, frame.calibration.p2, rtol=1e-9)


def test_points_are_those_of_the_sensor(whole: list[Frame]) -> None:
    seeds = [simulate_frame(seed, 0, CAMERA).points for seed in (1, 2)]
    assert len({len(points) for points in (*seeds, *(frame.points for frame in whole))}) == 4, "seeds and frames differ"
    for frame in whole:
        points = frame.points
        assert points.dtype == np.float32
        assert 100_000 < len(points) < 130_000
        assert np.linalg.norm(points[:, :3], axis=1).max() < 80.01  # the laser's own origin lies above the sensor's
        steps = points[:, 3].astype(float) * 100
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)
        assert points[:, 3].min() >= 0 and points[:, 3].max() <= 0.99 + 1e-6
        millimetres = points[:, :3].astype(float) * 1000
        np.testing.assert_allclose(millimetres, np.round(millimetres), atol=0.01)


def test_the_camera_view_is_the_part_of_the_whole_scan_that_the_image_shows(
    frames: list[Frame], whole: list[Frame]
) -> None:
    for part, full in zip(frames, whole, strict=False):
        assert part.objects == full.objects
        np.testing.assert_array_equal(part.points, full.points[in_image(full.points, full.calibration)])
        assert 14_000 < len(part.points) < 24_000


def test_points_on_a_free_car_lie_in_its_box_and_the_box_fits(frames: list[Frame]) -> None:
    shares, gaps = [], []
    for frame in frames:
        cars = [o for o in frame.objects if o.type == "Car" and o.occluded == 0 and o.truncated == 0]
        for box in boxes_from_objects(cars, frame.calibration):
            if not 8 < np.hypot(box[0], box[1]) < 20:
                continue
            # Above the ground, around the box: nothing else stands that near to a car.
            around = box + np.array([0, 0, 0.25, 0.4, 0.4, 0.1, 0], np.float32)
            around[5] -= 0.5
            near = frame.points[points_in_boxes(frame.points, around[None])[:, 0]]
            inside = points_in_boxes(near, box[None], margin_m=0.05)[:, 0]
            shares.append(inside.mean())
            gaps.append(box[2] + box[5] / 2 - near[inside, 2].max())
    assert len(shares) > 5
    assert np.mean(shares) > 0.95
    assert 0.03 < np.median(gaps) < 0.20  # KITTI: the highest return is 11 cm below the top of the box


def test_labels_follow_kitti(frames: list[Frame]) -> None:
    labelled = [o for frame in frames for o in frame.objects if o.type != "DontCare"]
    assert {"Car", "Pedestrian", "Cyclist", "Van"} <= {o.type for o in labelled}
    assert {0, 1, 2} <= {o.occluded for o in labelled} <= {0, 1, 2, 3}
    for item in labelled:
        x1, y1, x2, y2 = item.bbox
        assert 0 <= x1 < x2 <= 1241 and 0 <= y1 < y2 <= 374
        assert 0 <= item.truncated < 1 and item.z_m > 0
        # Only what the border of the image cuts is truncated.
        if item.truncated > 0.02:
            assert x1 == 0 or y1 == 0 or x2 == 1241 or y2 == 374
    assert any(o.truncated > 0.1 for o in labelled)


def test_fully_visible_objects_hold_more_points_than_hidden_ones(frames: list[Frame]) -> None:
    """Occlusion is real: at the same range, cars marked 0 / 1 / 2 hold fewer and fewer points."""
    counts: dict[int, list[float]] = {0: [], 1: [], 2: [], 3: []}
    for frame in frames:
        cars = [o for o in frame.objects if o.type == "Car" and o.truncated == 0]
        boxes = boxes_from_objects(cars, frame.calibration)
        held = points_in_boxes(frame.points, boxes).sum(axis=0)
        for car, box, n in zip(cars, boxes, held, strict=True):
            counts[car.occluded].append(float(n * np.hypot(box[0], box[1]) ** 2))
    medians = [np.median(counts[level]) for level in (0, 1, 2)]
    assert medians[0] > medians[1] > medians[2]


def test_nothing_stands_in_anything_else() -> None:
    config = SceneConfig()
    placed = 0
    for index in range(12):
        scene = draw_scene(config, np.random.default_rng(index))
        boxes = np.array([target.box for target in scene.targets]).reshape(-1, 7)
        placed += len(boxes)
        car = np.array([[0, 0, 0, 4.0, 1.8, 1.5, 0]])
        shared = bev_intersection(np.concatenate([boxes, car]), np.concatenate([boxes, car]))
        np.fill_diagonal(shared, 0.0)
        on_foot = np.array([target.type == "Pedestrian" for target in scene.targets] + [False])
        beside = on_foot[:, None] & on_foot  # who walks in company shares a part of the box
        assert shared[~beside].max() < 1e-6
        assert shared.max() < 0.2
        ground = scene.ground.heights(boxes[:, :2])
        lift = [target.lift_m for target in scene.targets]  # boxes stand a little above or below the ground
        np.testing.assert_allclose(boxes[:, 2] - boxes[:, 5] / 2 - lift, ground, atol=1e-9)
        assert np.abs(lift).max(initial=0.0) <= 0.15
    assert placed > 100


def test_the_shares_of_the_configuration_are_kept() -> None:
    others = ("cars", "beyond", "vans", "trucks", "trams", "misc", "cyclists", "sitting")
    none: dict[str, Any] = dict.fromkeys(others, 0)
    people_only = SceneConfig(**none, empty_share=0, pedestrian_uniform_heading=1)
    yaws, count = [], 0
    for index in range(40):
        scene = draw_scene(people_only, np.random.default_rng(index))
        assert {target.type for target in scene.targets} <= {"Pedestrian"}
        yaws += [target.box[6] for target in scene.targets]
        count += len(scene.targets)
    assert count / 40 == pytest.approx(2 * people_only.pedestrians, rel=0.45)
    quarter = np.histogram(yaws, np.linspace(-np.pi, np.pi, 5))[0] / len(yaws)
    assert (quarter > 0.15).all()
    empty = draw_scene(SceneConfig(empty_share=1.0), np.random.default_rng(0))
    assert not empty.targets and len(empty.background.triangles) > 2000, "but never bare"


def test_statistics_are_near_to_those_of_kitti(frames: list[Frame]) -> None:
    """Loose bounds around the measured values of KITTI, to notice when a change spoils them."""
    per_frame = {
        name: np.mean([sum(o.type == name for o in frame.objects) for frame in frames])
        for name in ("Car", "Pedestrian", "Cyclist")
    }
    assert 3.0 < per_frame["Car"] < 7.0
    assert 0.6 < per_frame["Pedestrian"] < 3.0
    assert 0.4 < per_frame["Cyclist"] < 2.0
    zero = {}
    for name in ("Car", "Pedestrian"):
        values = []
        for frame in frames:
            items = [o for o in objects_3d(frame.objects) if o.type == name]
            boxes = boxes_from_objects(items, frame.calibration)
            boxes[:, 2] += 0.1  # without the ground
            values.append(frame.points[points_in_boxes(frame.points, boxes).any(axis=1), 3])
        zero[name] = np.mean(np.concatenate(values) == 0)
    assert 0.30 < zero["Car"] < 0.60  # 0.46
    assert zero["Pedestrian"] < 0.25  # 0.09


def test_around_is_the_whole_scan_with_labels_in_every_direction(whole: list[Frame]) -> None:
    behind = 0
    for index, full in enumerate(whole):
        around = simulate_frame(0, index, SimulationConfig(field_of_view="around"))
        np.testing.assert_array_equal(around.points, full.points)
        seen = {(o.type, o.x_m, o.z_m) for o in full.objects if o.type != "DontCare"}
        everywhere = {(o.type, o.x_m, o.z_m) for o in around.objects}
        assert seen <= everywhere and "DontCare" not in {o.type for o in around.objects}
        boxes = boxes_from_objects(around.objects, around.calibration)
        boxes[:, 3:6] += 0.3  # a return may lie a little outside, as on the wheels or by its noise
        assert points_in_boxes(around.points, boxes).any(axis=0).all()
        behind += sum(boxes[:, 0] < 0)
        # No object that holds points away from the ground and from other things is left out.
        scene = draw_scene(SceneConfig(), np.random.default_rng([0, index, 0]))
        targets = np.array([target.box for target in scene.targets], np.float32).reshape(-1, 7)
        targets[:, 2] += 0.2
        targets[:, 3:6] *= 0.9
        rich = targets[points_in_boxes(around.points, targets).sum(axis=0) > 20]
        for x, y in rich[:, :2]:
            assert np.hypot(boxes[:, 0] - x, boxes[:, 1] - y).min() < 0.05
    assert behind > 5


def test_a_set_labelled_all_around_says_so_and_reads_back_for_training(tmp_path: Path) -> None:
    simulate(tmp_path, 2, config=SimulationConfig(field_of_view="around"))
    assert json.loads((tmp_path / "simulation.json").read_text())["field_of_view"] == "around"
    split, names = KittiSplit(tmp_path), ("Car", "Pedestrian", "Cyclist")
    ahead = behind = 0
    for name in split.frame_ids:
        frame = read_frame(split, name, names, camera_view=False)
        ahead += ((frame.boxes[:, 0] > 0) & (frame.labels >= 0)).sum()
        behind += ((frame.boxes[:, 0] < 0) & (frame.labels >= 0)).sum()
        cropped = read_frame(split, name, names)
        assert (cropped.labels[cropped.boxes[:, 0] < -2] < 0).all(), "the camera's points hold nothing of them"
    assert ahead > 0 and behind > 0
    with pytest.raises(DatasetError, match="another folder"):
        simulate(tmp_path, 3)


def test_both_lists_get_a_frame_where_there_are_two() -> None:
    assert [held_out(count, 0.1) for count in (1, 2, 5, 14, 100)] == [0, 1, 1, 1, 10]
    assert [held_out(3, share) for share in (0.0, 0.9, 1.0)] == [0, 2, 3]
