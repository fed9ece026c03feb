"""`asca inspect` of voxels: PV-RCNN's anchors and grid, and remedies that name keys which its configurations have."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from asca_pillars.base.schema import parse, to_dict
from asca_pillars.base.settings import shipped_configs
from asca_pillars.cli.inspect import inspect
from asca_pillars.config.tree import Config, load_config
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.inspection.findings import Finding, findings
from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
from asca_pillars.data.inspection.measurements import measure_scan
from asca_pillars.data.inspection.proposal import differences, propose
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.ops.pv_rcnn.voxels import voxelize
from asca_pillars.ops.sparse.rulebooks import CellMap
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.training.dataset import open_dataset
from tests.data.boxes.box_scenes import write_box_dataset
from tests.data.inspection.conftest import FRAMES
from tests.data.inspection.sized_boxes import SIZES, write_around
from tests.helpers.scenes import write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, SPEC, tiny_config

SHIPPED = [name for name, path in shipped_configs().items() if "kind: pv_rcnn" in path.read_text()]


def with_spec(**changes: Any) -> Config:
    return tiny_config(dataclasses.replace(MODEL, spec=dataclasses.replace(SPEC, **changes)))


def with_grid(**changes: Any) -> Config:
    return with_spec(grid=dataclasses.replace(SPEC.grid, **changes))


EVEN: dict[str, Any] = {"x_range_m": (4.8, 24.0), "y_range_m": (-6.4, 9.6)}
"""Ranges that the strides divide with any `last_stride`, and voxels of 0.4 m too."""


def found(root: Path, config: Config) -> list[Finding]:
    spec = config.model.spec
    inspection = inspect_dataset(KittiSplit(root, "training"), spec, config.data)
    return findings(inspection, spec, config.data.min_points)


def test_the_command_counts_the_positives_of_the_training_loader(clean: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(tiny_config(), data=dataclasses.replace(tiny_config().data, train_set="training"))
    path, report = tmp_path / "config.yaml", tmp_path / "report.json"
    path.write_text(yaml.safe_dump(to_dict(config)))
    inspect(clean, config=path, json=report)
    frames = open_dataset(
        clean, dataclasses.replace(config, data=dataclasses.replace(config.data, val_set="training")), training=False
    )
    samples = [frames.sample(0, number).prepared for number in range(FRAMES)]
    states = np.stack([sample.targets.state for sample in samples])
    written = json.loads(report.read_text())
    for index, facts in enumerate(written["classes"]):
        assert facts["positives"] == (states[..., 2 * index : 2 * index + 2] == 1).sum() > 0
    assert written["scans"]["cell"] == "voxel"
    assert written["scans"]["cells"][-1] == max(len(sample.scan.features) for sample in samples)
    assert {item["level"] for item in written["findings"]} <= {"warning"}


def test_voxels_by_those_that_the_backbone_reads(clean: Path) -> None:
    points = read_scan(KittiSplit(clean).scan_path("000000")).points
    grid = dataclasses.replace(SPEC.grid, max_points=1)
    measure = measure_scan(points, points, dataclasses.replace(SPEC, grid=grid))
    voxels = voxelize(points, grid, CellMap(grid.shape))
    assert (measure.cells, measure.points - measure.inside) == (len(voxels.cells), voxels.points_outside)
    low, size = np.array(grid.ranges_m, np.float32)[:, 0], np.array(grid.size_m, np.float32)
    _, counts = np.unique(np.floor((points[grid.inside(points), :3] - low) / size), axis=0, return_counts=True)
    assert (measure.fullest, measure.crowded) == (counts.max(), (counts > 1).sum())
    assert measure.cut == (counts - 1).sum() > 0


@pytest.mark.parametrize("last_stride", [1, 2])
@pytest.mark.parametrize("anchor_places", ["cells", "ends"])
def test_anchors_stand_where_the_detector_has_them(clean: Path, last_stride: int, anchor_places: str) -> None:
    grid = dataclasses.replace(SPEC.grid, **EVEN)
    spec = with_spec(last_stride=last_stride, anchor_places=anchor_places, grid=grid).model.spec
    facts = inspect_dataset(KittiSplit(clean, "training"), spec, tiny_config().data).classes[0]
    expected = 0
    for frame_id in KittiSplit(clean, "training").frame_ids:
        boxes, types = KittiSplit(clean).labeled_boxes(frame_id)
        cars = boxes[[kind == "Car" for kind in types]]
        anchors = spec.anchors[:, :, :2].reshape(-1, 7)
        overlaps = [_aligned_iou(anchors, box) for box in cars]
        expected += sum(iou.max() >= spec.classes[0].positive_iou for iou in overlaps)
    assert facts.overlapped == expected


def _aligned_iou(anchors: np.ndarray, box: np.ndarray) -> np.ndarray:
    """With the box turned to the nearest axis, as the assigner has it."""
    halves = []
    for each in (anchors, box[None]):
        across = np.abs(np.cos(each[:, 6])) < np.abs(np.sin(each[:, 6]))
        halves.append(np.where(across[:, None], each[:, [4, 3]], each[:, [3, 4]]) / 2)
    sides = np.minimum(anchors[:, :2] + halves[0], box[:2] + halves[1]) - np.maximum(
        anchors[:, :2] - halves[0], box[:2] - halves[1]
    )
    both = np.clip(sides, 0, None).prod(axis=1)
    return both / (4 * halves[0].prod(axis=1) + 4 * halves[1].prod() - both)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (with_grid(x_range_m=(4.8, 14.4)), r"in x and 0 % in y, .* widen model.spec.grid.x_range_m \[4.8"),
        (with_grid(z_range_m=(-1.2, 2.0)), r"reach beyond model.spec.grid.z_range_m \[-1.2"),
        (
            with_spec(last_stride=2, grid=dataclasses.replace(SPEC.grid, **EVEN)),
            r"Pedestrian: .* set model.spec.last_stride=1, or make model.spec.grid.size_m",
        ),
        (
            with_grid(size_m=(0.4, 0.4, 0.1), **EVEN),
            r"Pedestrian: .* make model.spec.grid.size_m smaller along x and y",
        ),
        (
            with_grid(max_points=1, size_m=(0.4, 0.4, 0.2), z_range_m=(-4.0, 2.0), **EVEN),
            r"model.spec.grid.max_points = 1 takes away \d+ % of the points; raise it, or make the voxels smaller",
        ),
    ],
)
def test_remedies_name_keys_that_there_are(clean: Path, config: Config, message: str) -> None:
    texts = [item.text for item in found(clean, config)]
    assert any(re.search(message, text) for text in texts), texts
    for key in re.findall(r"\b(?:model|data)\.[a-z_.]*[a-z_]", " ".join(texts)):
        settings: Any = to_dict(config)
        for part in key.split("."):
            assert part in settings, key
            settings = settings[part]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configurations_are_inspected(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_dataset(tmp_path / "data", 2)
    if name.endswith("_waymo"):
        for path in (root / "training" / "label_2").iterdir():
            path.write_text(path.read_text().replace("Car ", "Vehicle "))
    inspect(root, config=Path(name), split="training")
    output = " ".join(capsys.readouterr().out.split())
    assert f"against {load_config(name).name}: 2 of 2 frames" in output
    assert "voxels with more points" in output and "pillar" not in output


def test_a_configuration_is_proposed_for_voxels(tmp_path: Path) -> None:
    split = BoxSplit(write_around(tmp_path, 40, reach_m=30, z_m=0.3))
    proposed = propose(split, tiny_config()).config
    spec = proposed.model.spec
    assert spec.class_names == tuple(SIZES)
    centers = np.concatenate([split.labeled_boxes(frame_id).boxes for frame_id in split.frame_ids])
    assert spec.ranges.hold_centers(centers).mean() >= 0.94
    assert spec.ranges.x_m[0] == -spec.ranges.x_m[1] and spec.ranges.z_m[1] > 2.5
    text = yaml.safe_dump(differences(proposed), sort_keys=False)
    assert parse(Config, yaml.safe_load(text), "text") == proposed
    inspection = inspect_dataset(split, spec, proposed.data)
    assert not [finding for finding in findings(inspection, spec, 1) if finding.level == "error"]


def test_a_range_ahead_is_widened_by_whole_cells_of_the_map(tmp_path: Path) -> None:
    narrow = with_grid(x_range_m=(4.8, 14.4), y_range_m=(-1.6, 1.6))
    before, spec = narrow.model.spec, propose(BoxSplit(write_box_dataset(tmp_path, 12)), narrow).config.model.spec
    assert spec.ranges.x_m[0] == 4.8 and spec.ranges.x_m[1] > 20 and spec.ranges.z_m == before.ranges.z_m
    assert spec.ranges.y_m == (-spec.ranges.y_m[1], spec.ranges.y_m[1]) and spec.ranges.y_m[1] > 1.6
    same = with_grid(x_range_m=spec.ranges.x_m, y_range_m=spec.ranges.y_m)
    assert propose(BoxSplit(tmp_path), same).config.model.spec.grid == spec.grid  # it holds them: it stays
