"""Classes, anchors, thresholds and ranges that are measured on labels."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from asca_pillars.base.errors import AscaError, DatasetError, OutputError
from asca_pillars.base.schema import parse
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig, load_config, pillar_spec
from asca_pillars.data.boxes.box_records import json_line, read_frames, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.inspection.findings import differences, findings, propose
from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits, pillarize
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.scan_reader import write_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.data.inspection.sized_boxes import SIZES, write_around
from tests.helpers.in_process import invoke
from tests.helpers.scenes import SPEC
from tests.models.pv_rcnn.tiny_pv_rcnn import tiny_config

CONFIG = Config(model=PillarModel(spec=SPEC), data=DataConfig(workers=0))


def with_grid(grid: PillarGrid) -> Config:
    return replace(CONFIG, model=PillarModel(spec=PillarSpec(grid=grid)))


@pytest.fixture(scope="module")
def around(tmp_path_factory: pytest.TempPathFactory) -> BoxSplit:
    return BoxSplit(write_around(tmp_path_factory.mktemp("around"), 60, reach_m=30, z_m=0.3))


@pytest.mark.parametrize("config", [CONFIG, tiny_config()], ids=["pillars", "voxels"])
def test_anchors_and_ranges_are_those_of_the_boxes(around: BoxSplit, config: Config) -> None:
    proposal = propose(around, config)
    proposed, spec = proposal.config, proposal.config.model.spec
    assert proposal.boxes == {"Forklift": 60, "Pallet": 60}
    assert not proposed.data.camera_view  # there is no camera
    for item in spec.classes:
        size = np.array([item.length_m, item.width_m, item.height_m])
        np.testing.assert_allclose(size, SIZES[item.name], rtol=0.03, atol=0.01)
        assert item.z_m == pytest.approx(0.3 + SIZES[item.name][2] / 2, abs=0.05)
        assert item.negative_iou == pytest.approx(item.positive_iou - 0.15)
    assert spec.ranges.x_m[0] == -spec.ranges.x_m[1]
    centers = np.concatenate([around.labeled_boxes(frame_id).boxes for frame_id in around.frame_ids])
    assert spec.ranges.hold_centers(centers).mean() >= 0.94
    assert spec.ranges.z_m[0] < 0.3 and spec.ranges.z_m[1] > 2.5
    inspection = inspect_dataset(around, spec, proposed.data)
    assert not [finding for finding in findings(inspection, spec, 1) if finding.level == "error"]
    assert all(facts.forced <= 0.45 * facts.boxes for facts in inspection.classes)
    text = yaml.safe_dump(differences(proposed), sort_keys=False)
    assert parse(Config, yaml.safe_load(text), "text") == proposed
    assert ("learning_rate" in text) == (config is not CONFIG)  # what is the default stays out


def test_a_range_to_the_sides_that_holds_the_boxes_stays_where_boxes_stand_behind(tmp_path: Path) -> None:
    """A corridor: 20 m ahead and behind, hardly any to the sides."""
    root, lines = write_around(tmp_path, 40, reach_m=20), []
    for name, records, *_ in read_frames(root / "labels.jsonl"):
        boxes = records.boxes * [1, 0.2, 1, 1, 1, 1, 1]
        lines.append(json_line(name, records_from(boxes, records.types)))
        write_scan(root / "scans" / name, np.insert(np.repeat(boxes[:, :3], 20, axis=0), 3, 0.5, axis=1))
    (root / "labels.jsonl").write_text("".join(lines))
    wide = PillarGrid(x_range_m=(4.8, 15.04), y_range_m=(-15.36, 15.36), v_max_m=0.32, zones=2)
    grid = pillar_spec(propose(BoxSplit(root), with_grid(wide)).config).grid
    assert grid.x_range_m[0] == -grid.x_range_m[1] and grid.x_range_m[1] > 15
    assert grid.y_range_m == wide.y_range_m


def test_legal_ranges_classes_with_enough_boxes_and_room_for_pillars(tmp_path: Path) -> None:
    narrow = PillarGrid(x_range_m=(4.8, 15.04), y_range_m=(-2.56, 2.56), v_max_m=0.32, zones=2)
    split = BoxSplit(write_box_dataset(tmp_path, 12))
    grid = pillar_spec(propose(split, with_grid(narrow)).config).grid
    assert grid.zones == 2 and grid.x_range_m[1] > 20 and grid.y_range_m == (-grid.y_range_m[1], grid.y_range_m[1])
    spec = propose(split, CONFIG).config.model.spec
    assert spec.grid == SPEC.grid and spec.class_names == ("Car", "Forklift")
    split = BoxSplit(write_box_dataset(tmp_path, 12))
    grass = np.random.default_rng(0).uniform([5, -6, -1.7, 0], [25, 7, -1.6, 1], (3300, 4))
    write_scan(split.scan_path("000003"), np.concatenate([split.points("000003"), grass]))  # the fullest by far
    config = replace(CONFIG, model=PillarModel(spec=replace(SPEC, limits=replace(SPEC.limits, max_pillars=100))))
    unlimited = PillarLimits(max_pillars=10**5, max_points=1)
    clouds = (split.points(frame_id) for frame_id in split.frame_ids)
    pillars = [len(pillarize(points, SPEC.grid, unlimited).cells) for points in clouds]
    assert pillar_spec(propose(split, config).config).limits.max_pillars == math.ceil(max(pillars) * 1.1 / 1000) * 1000


def test_a_type_with_few_boxes_is_no_class(tmp_path: Path) -> None:
    split = BoxSplit(write_box_dataset(tmp_path, 4))
    with pytest.raises(DatasetError, match=r"no type has 10 boxes with points \(there are: Car 4, Forklift 4\)"):
        propose(split, CONFIG)


def test_the_command_writes_what_it_then_inspects(tmp_path: Path) -> None:
    root, path = write_around(tmp_path / "own", 20, reach_m=30), tmp_path / "own.yaml"
    with pytest.raises(AscaError, match="let --propose measure the classes that there are"):
        invoke("inspect", root, "-c", "asca_small_sim")
    output = invoke("inspect", root, "-c", "asca_small_sim", "--propose", path)
    assert f"asca train {path}" in output.replace("\n", "")
    assert load_config(path).model.spec.class_names == ("Forklift", "Pallet")
    with pytest.raises(OutputError, match=r"own\.yaml: already exists"):
        invoke("inspect", root, "-c", "asca_small_sim", "--propose", path)


def test_boxes_with_hardly_a_point_do_not_widen_the_grid(tmp_path: Path) -> None:
    split, far, lines = BoxSplit(write_box_dataset(tmp_path, 12)), [200.0, 0, -1, 2.5, 1.2, 2, 0], []
    for frame_id in split.frame_ids:
        write_scan(split.scan_path(frame_id), np.append(split.points(frame_id), [[200, 0, -1, 0.5]], axis=0))
        boxes = np.append(split.labeled_boxes(frame_id).boxes, [far], axis=0)
        lines.append(json_line(f"{frame_id}.bin", records_from(boxes, ["Car", "Forklift", "Forklift"])))
    (tmp_path / "labels.jsonl").write_text("".join(lines))
    proposal = propose(BoxSplit(tmp_path), CONFIG)
    assert proposal.boxes["Forklift"] == 24 and proposal.config.model.spec.grid == SPEC.grid
