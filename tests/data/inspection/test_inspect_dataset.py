"""What `asca inspect` measures, against plain loops and the training loader; and what it says of data gone wrong."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.base.schema import to_dict
from asca_pillars.cli.inspect import inspect
from asca_pillars.config.pillar import LossConfig, PillarModel
from asca_pillars.config.tree import Config, pillar_spec
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.data.inspection.measurements import MatchOutcome, match, measure_frame, measure_scan
from asca_pillars.data.kitti import KittiSplit, read_labels
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.detection.targets import Assigner, assign_targets
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.ops.pillar.prepare import PillarLimits
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.training.dataset import open_dataset
from tests.data.inspection.conftest import FRAMES
from tests.data.inspection.inspected_data import (
    CONFIG,
    change_files,
    change_scans,
    found,
    inspected,
    with_data,
    with_detector,
    with_grid,
)
from tests.helpers.scenes import GRID, SIZES, SPEC, make_scene
from tests.models.pv_rcnn import tiny_pv_rcnn


def test_clean_data_gives_nothing_to_warn_of_and_numbers_by_plain_loops(clean: Path) -> None:
    assert found(clean) == []
    inspection = inspected(clean, CONFIG)
    assert inspection.types == {"Car": 2 * FRAMES, "Pedestrian": FRAMES, "Cyclist": FRAMES}
    cars = [box for seed in range(FRAMES) for box, name in zip(*make_scene(seed)[1:], strict=True) if name == "Car"]
    facts = inspection.classes[0]
    assert (facts.name, facts.boxes, facts.no_points, facts.few_points) == ("Car", 2 * FRAMES, 0, 0)
    # Labels are written with two decimals.
    assert facts.size_m == pytest.approx(np.mean(cars, axis=0)[3:6], abs=0.005)
    assert facts.size_std_m == pytest.approx(np.std(cars, axis=0)[3:6], abs=0.005)
    assert facts.z_m == pytest.approx(np.mean(cars, axis=0)[2], abs=0.01)
    assert facts.reach_m is not None
    assert facts.reach_m[0] == pytest.approx((min(box[0] for box in cars), max(box[0] for box in cars)), abs=0.01)
    assert inspection.frames_without_objects == 0 and not inspection.sampled


def test_points_sizes_and_pillars_are_those_of_plain_loops(clean: Path) -> None:
    split = KittiSplit(clean)
    measure = measure_frame(split, "000000", pillar_spec(CONFIG), CONFIG.data)
    points = read_scan(split.scan_path("000000")).points  # the camera sees all of the boxes
    counts = points_in_boxes(points, measure.boxes).sum(axis=0).tolist()
    assert measure.points.tolist() == counts and min(counts) > 20
    assert measure.labels.tolist() == [0, 0, 1, 2]
    spec = dataclasses.replace(SPEC, limits=PillarLimits(max_pillars=5000, max_points=3))
    scan, stats = measure_scan(points, points, spec), spec.pillarize(points).stats
    assert (scan.points, scan.inside) == (stats.points, stats.points - stats.points_outside)
    assert scan.cells == stats.pillars and scan.cut == stats.points_over_limit > 0
    per_pillar = dataclasses.replace(spec, limits=PillarLimits(5000, 5000)).pillarize(points).point_counts
    assert (scan.fullest, scan.crowded) == (per_pillar.max(), (per_pillar > 3).sum())
    few = dataclasses.replace(spec, limits=PillarLimits(max_pillars=100, max_points=3)).pillarize(points).stats
    assert scan.cells == few.pillars + few.pillars_over_limit


ONE_ZONE = PillarModel(spec=dataclasses.replace(SPEC, grid=dataclasses.replace(GRID, zones=1)))
WITHOUT_THRESHOLDS = PillarModel(spec=SPEC, loss=LossConfig(assigner="atss"))


@pytest.mark.parametrize(
    "config",
    [
        dataclasses.replace(with_data(min_points=110), model=ONE_ZONE),  # some objects are ignored
        dataclasses.replace(CONFIG, model=WITHOUT_THRESHOLDS),
        dataclasses.replace(CONFIG, model=tiny_pv_rcnn.MODEL),
    ],
    ids=["pillars", "without thresholds", "voxels"],
)
def test_the_command_counts_the_positives_of_the_training_loader(clean: Path, tmp_path: Path, config: Config) -> None:
    path, report = tmp_path / "config.yaml", tmp_path / "report.json"
    path.write_text(yaml.safe_dump(to_dict(config)))
    inspect(clean, config=path, json=report)
    frames = open_dataset(clean, config, training=False)
    samples = [frames.sample(0, number) for number in range(FRAMES)]
    states = np.stack([sample.prepared.targets.state for sample in samples])
    labels = np.concatenate([sample.frame.labels for sample in samples])
    written = json.loads(report.read_text())
    for index, facts in enumerate(written["classes"]):
        assert facts["positives"] == (states[..., 2 * index : 2 * index + 2] == 1).sum() > 0
        to_find = facts["overlapped"] + facts["forced"] + facts["missed"]
        assert to_find == (labels == index).sum() == facts["boxes"] - facts["few_points"]
        assert (facts["few_points"] > 0) == (config.data.min_points > 1)
        assert facts["forced"] == 0 or config.model != WITHOUT_THRESHOLDS
    assert written["scans"]["points"][-1] == max(len(sample.frame.points) for sample in samples)


def outcomes_of(
    boxes: list[list[float]], labels: list[int], assigner: Assigner = "overlap"
) -> tuple[list[int], np.ndarray]:
    frame = LabeledFrame("0", np.empty((0, 4), np.float32), np.array(boxes, np.float32), np.array(labels))
    outcomes, positives = match(frame, SPEC, assigner)
    return outcomes.tolist(), positives


@settings(max_examples=15)
@given(st.integers(0, 2), st.floats(6.5, 23), st.floats(-4.5, 5.5), st.floats(0.5, 1.8), st.floats(-3.1, 3.1))
def test_an_objects_outcome_by_its_overlap_with_every_anchor(
    label: int, x: float, y: float, stretch: float, yaw: float
) -> None:
    length, width, height = SIZES[SPEC.class_names[label]]
    box = [x, y, -0.9, length * stretch, width, height, yaw]
    outcomes, positives = outcomes_of([box], [label])
    own = SPEC.anchors[:, :, 2 * label : 2 * label + 2].reshape(-1, 7)
    reached = aligned_bev_iou(own, np.array([box], np.float32)).max() >= SPEC.classes[label].positive_iou
    assert outcomes == [MatchOutcome.OVERLAPPED if reached else MatchOutcome.FORCED]
    assert positives[label] >= 1 and positives.sum() == positives[label]


def test_outcomes_by_hand() -> None:
    x, y = SPEC.anchors[20, 15, 0, :2]
    car = [x, y, -1.0, 3.9, 1.6, 1.56, 0.0]
    short = [x, y + 5, -1.0, 2.0, 1.6, 1.56, 0.0]  # overlap at most 2.0 / 3.9 = 0.51
    person = [x + 6, y, -0.6, 0.8, 0.6, 1.73, 0.0]
    beside = [4.79, y, -1.0, 3.9, 1.6, 1.56, 0.0]
    outcomes, positives = outcomes_of([car, short, person, person, beside, car], [0, 0, 1, 1, 0, IGNORED])
    # Of two equal boxes the later has the best anchors, the earlier what else reaches positive_iou.
    assert [outcomes[row] for row in (0, 1, 3)] == [
        *(MatchOutcome.OVERLAPPED, MatchOutcome.FORCED, MatchOutcome.OVERLAPPED)
    ]
    assert outcomes[4:] == [MatchOutcome.LEFT_OUT] * 2 and positives[2] == 0
    tiny = [[x, y, -0.6, 0.3, 0.3, 1.7, 0.0]] * 2
    assert outcomes_of(tiny, [1, 1])[0] == [MatchOutcome.MISSED, MatchOutcome.FORCED]
    # A short car, which no anchor overlaps by positive_iou, and tiny boxes that have the same best anchors.
    x, y = SPEC.anchors[20, 15, 0, :2]
    boxes, labels = [[x, y, -1.0, 2.0, 1.6, 1.56, 0.0]] + [[x, y + 5, -0.6, 0.3, 0.3, 1.7, 0.0]] * 2, [0, 1, 1]
    outcomes, positives = outcomes_of(boxes, labels, "atss")
    assert outcomes == [MatchOutcome.OVERLAPPED, MatchOutcome.MISSED, MatchOutcome.OVERLAPPED]
    targets = assign_targets(SPEC.anchors, SPEC.classes, np.array(boxes, np.float32), np.array(labels), "atss")
    assert positives.tolist() == np.bincount(np.array(labels)[targets.matched], minlength=3).tolist()


def test_frames_are_evenly_spaced_and_anchors_of_another_size_are_noticed(clean: Path) -> None:
    inspection = inspected(clean, CONFIG, frames=4)
    assert (inspection.frames, inspection.frames_in_split, inspection.sampled) == (4, FRAMES, True)
    chosen = [
        measure_frame(KittiSplit(clean), frame_id, pillar_spec(CONFIG), CONFIG.data)
        for frame_id in ("000000", "000003", "000006", "000009")
    ]
    assert inspection.scans.points.largest == max(frame.scan.points for frame in chosen)
    assert inspection.classes[1].positives == sum(frame.positives[1] for frame in chosen)
    assert inspected(clean, CONFIG, frames=99, split="val").frames == 1
    (car, *others) = SPEC.classes
    config = with_detector(classes=(dataclasses.replace(car, length_m=8.0), *others))
    (warning,) = found(clean, config)
    assert warning.text.startswith("Car: 100 % of the boxes differ too much in size from the anchor for positive_iou")
    advised = float(warning.text.split("length_m ")[1].split(",")[0])
    assert advised == pytest.approx(3.9, abs=0.2)
    assert inspected(clean, config).classes[0].misfits == 2 * FRAMES


@pytest.mark.parametrize("height_m", [-1.73, 1.0])
def test_another_sensor_height_and_its_remedy(data: Path, height_m: float) -> None:
    """Everything lies lower in the LiDAR's frame, the camera's frame stays where it was."""
    change_scans(data, lambda points: np.subtract(points[:, 2], height_m, out=points[:, 2]))
    # CALIBRATION: y of the camera is -z of the LiDAR - 0.08 m.
    change_files(data, "calib", lambda text: text.replace(f"{-0.08:.12e}", f"{-0.08 - height_m:.12e}"))
    warnings = found(data)
    assert {warning.about for warning in warnings} == {"Car", "Pedestrian", "Cyclist", "height"}
    (ground,) = [warning.text for warning in warnings if warning.about == "height"]
    moved_m = float(ground.split("by about ")[1].split(" m")[0])
    assert moved_m == pytest.approx(-height_m, abs=0.3)
    new_z = {item.about: item.text.split("set its z_m to ")[1] for item in warnings if "set its z_m" in item.text}
    classes = tuple(dataclasses.replace(spec, z_m=float(new_z[spec.name])) for spec in SPEC.classes)
    grid = dataclasses.replace(GRID, z_range_m=(-3 + moved_m, 1 + moved_m))
    assert found(data, with_detector(classes=classes, grid=grid)) == []  # the advice works


def test_scans_that_were_raised_without_their_labels(data: Path) -> None:
    change_scans(data, lambda points: np.subtract(points[:, 2], 0.6, out=points[:, 2]))
    boxes, height = found(data)
    assert boxes.about == "boxes" and "lowered by half a height" in boxes.text
    assert height.about == "height" and "z = -2.33 m, the boxes stand +0.6" in height.text
    assert height.text.endswith("calib and labels must belong to the scans")


@pytest.mark.parametrize(
    ("config", "about", "message"),
    [
        (with_grid(x_range_m=(4.8, 15.04)), "Car", r"\d+ % in x and 0 % in y, .* model.spec.grid.x_range_m \[4.8"),
        (with_grid(y_range_m=(-1.28, 7.68)), "Car", r"0 % in x and \d+ % in y, .* model.spec.grid.y_range_m \[-1"),
        (with_grid(z_range_m=(-1.0, 1.0)), "Car", r"100 % of the boxes reach beyond model.spec.grid.z_range_m \[-1"),
        (with_grid(v_max_m=1.28, v_y_m=1.76), "Pedestrian", "make model.spec.grid.v_max_m and v_y_m smaller"),
        (with_data(min_points=110), "Car", r"fewer points than data.min_points = 110 and are ignored; lower it"),
        (with_detector(limits=PillarLimits(500, 24)), "points", r"100 % of the scans have more pillars .* raise it to"),
        (with_detector(limits=PillarLimits(9000, 1)), "points", r"max_points = 1 takes away \d+ % of the points"),
        (with_grid(x_range_m=(4.8, 9.92), y_range_m=(-1.28, 1.28)), "points", r"9\d % of the points lie outside"),
    ],
)
def test_settings_that_do_not_fit_the_data(clean: Path, config: Config, about: str, message: str) -> None:
    texts = [item.text for item in found(clean, config) if item.about == about]
    assert any(re.search(message, text) for text in texts), texts


def test_points_that_are_not_numbers_and_scans_that_see_nothing(data: Path) -> None:
    change_scans(data, lambda points: points.__setitem__((slice(5), 1), np.nan), every=6)
    (warning,) = found(data)
    assert warning.text.startswith("points with a value that is not finite: 10, in 2 of 12 scans; ")
    change_scans(data, lambda points: np.multiply(points[:, 0], -1, out=points[:, 0]), every=12)
    assert any(item.text.startswith("scans without a point inside the grid: 1 of 12; ") for item in found(data))


def test_neighbors_are_ignored_and_other_types_left_out(data: Path) -> None:
    change_files(data, "label_2", lambda text: text.replace("Car", "Van", 1).replace("Cyclist", "Tram"))
    inspection = inspected(data, CONFIG)
    assert inspection.types == {"Van": FRAMES, "Car": FRAMES, "Pedestrian": FRAMES, "Tram": FRAMES}
    assert [facts.boxes for facts in inspection.classes] == [FRAMES, FRAMES, 0]
    assert read_labels(KittiSplit(data).label_path("000000"))[0].type == "Van"


def test_runs_without_torch(clean: Path, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(CONFIG)))
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from pathlib import Path; from asca_pillars.cli.inspect import inspect\n"
        "inspect(Path(sys.argv[1]), config=Path(sys.argv[2]), frames=2)"
    )
    command = [sys.executable, "-W", "error", "-c", code, str(clean), str(tmp_path / "config.yaml")]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "2 of 12 frames, evenly spaced" in " ".join(result.stdout.split())


def test_axes_of_a_layout_that_cannot_state_them(data: Path) -> None:
    """A dataset.yaml would make another layout of it."""
    change_scans(data, lambda points: np.multiply(points[:, 1:3], -1, out=points[:, 1:3]))
    (text,) = [item.text for item in found(data) if "scans are odd" in item.text]
    assert text.endswith("turn the points of all scans to x forward, y left, z up, and calib with them")


# --- reflectances: of those that reading changes, and only of them


@pytest.mark.parametrize(
    ("scale", "every", "message"),
    [
        (255, 1, r"divided by 255 when read: training sees 0 to 0\.\d+; divide it by its full scale"),
        (100, 1, r"training sees 0 to 0\.3\d; divide it by its full scale"),
        (255, 2, r"in 6 of 12 scans, which are divided by 255; .* store all of them as 0\.\.1"),
        (65535, 1, r"divided by 65535 when read: training sees 0 to 0\.\d+; divide it by its full scale"),
        (65535, 2, r"in 6 of 12 scans, which are divided by 65535; the others are taken as 0\.\.1"),
        (1.5, 1, r"cut off at 1 in \d+\.\d % of the points; divide it by its full scale"),
        (0, 1, r"0 everywhere; check what exported"),
        (1 / 255, 1, r"reaches 0\.00\d+ only; store it as 0\.\.1"),
        (-1, 1, r"goes down to -0\.\d+ and is cut off at 0"),
    ],
)
def test_reflectance_on_another_scale(data: Path, scale: float, every: int, message: str) -> None:
    change_scans(data, lambda points: np.multiply(points[:, 3], scale, out=points[:, 3]), every)
    finding = found(data)[0]
    assert finding.level == "warning" and finding.about == "reflectance" and re.search(message, finding.text)


@pytest.mark.parametrize("speck", [1.02, 40.0, 300.0])
def test_a_speck_of_reflectance_is_none_that_reading_minds(data: Path, speck: float) -> None:
    change_scans(data, lambda points: points.__setitem__((0, 3), speck), every=4)
    assert found(data) == []
