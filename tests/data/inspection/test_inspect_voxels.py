"""`asca inspect` of voxels: PV-RCNN's anchors and grid, and remedies that name keys which its configurations have."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asca_pillars.base.schema import to_dict
from asca_pillars.base.settings import shipped_configs
from asca_pillars.cli.inspect import inspect
from asca_pillars.config.tree import Config, load_config
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.inspection.findings import findings, propose
from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
from asca_pillars.data.inspection.measurements import measure_scan
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.ops.pv_rcnn.voxels import voxelize
from asca_pillars.ops.sparse.rulebooks import CellMap
from asca_pillars.scans.scan_reader import read_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.scenes import write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, SPEC, tiny_config

SHIPPED = [name for name, path in shipped_configs().items() if "kind: pv_rcnn" in path.read_text()]


def with_spec(**changes: Any) -> Config:
    return tiny_config(dataclasses.replace(MODEL, spec=dataclasses.replace(SPEC, **changes)))


def with_grid(**changes: Any) -> Config:
    return with_spec(grid=dataclasses.replace(SPEC.grid, **changes))


EVEN: dict[str, Any] = {"x_range_m": (4.8, 24.0), "y_range_m": (-6.4, 9.6)}
"""Ranges that the strides divide with any `last_stride`, and voxels of 0.4 m too."""


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
    split, expected = KittiSplit(clean, "training"), 0
    for frame_id in split.frame_ids:
        boxes, types = split.labeled_boxes(frame_id)
        best = aligned_bev_iou(spec.anchors[:, :, :2].reshape(-1, 7), boxes).max(axis=0)
        expected += (best[np.array(types) == "Car"] >= spec.classes[0].positive_iou).sum()
    assert inspect_dataset(split, spec, tiny_config().data).classes[0].overlapped == expected > 0


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (with_grid(x_range_m=(4.8, 14.4)), r"in x and 0 % in y, .* widen model.spec.grid.x_range_m \[4.8"),
        (with_grid(z_range_m=(-1.2, 2.0)), r"reach beyond model.spec.grid.z_range_m \[-1.2"),
        (
            with_spec(last_stride=2, grid=dataclasses.replace(SPEC.grid, **EVEN)),
            r"Pedestrian: .* set model.spec.last_stride=1, or make model.spec.grid.size_m",
        ),
        (with_grid(size_m=(0.4, 0.4, 0.1), **EVEN), "Pedestrian: .* make model.spec.grid.size_m smaller along x"),
        (
            with_grid(max_points=1, size_m=(0.4, 0.4, 0.2), z_range_m=(-4.0, 2.0), **EVEN),
            r"model.spec.grid.max_points = 1 takes away \d+ % of the points; raise it, or make the voxels smaller",
        ),
    ],
)
def test_remedies_name_keys_that_there_are(clean: Path, config: Config, message: str) -> None:
    spec = config.model.spec
    inspection = inspect_dataset(KittiSplit(clean, "training"), spec, config.data)
    texts = [item.text for item in findings(inspection, spec, config.data.min_points)]
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


def test_a_range_ahead_is_widened_by_whole_cells_of_the_map(tmp_path: Path) -> None:
    narrow = with_grid(x_range_m=(4.8, 14.4), y_range_m=(-1.6, 1.6))
    before, spec = narrow.model.spec, propose(BoxSplit(write_box_dataset(tmp_path, 12)), narrow).config.model.spec
    assert spec.ranges.x_m[0] == 4.8 and spec.ranges.x_m[1] > 20 and spec.ranges.z_m == before.ranges.z_m
    assert spec.ranges.y_m == (-spec.ranges.y_m[1], spec.ranges.y_m[1]) and spec.ranges.y_m[1] > 1.6
    same = with_grid(x_range_m=spec.ranges.x_m, y_range_m=spec.ranges.y_m)
    assert propose(BoxSplit(tmp_path), same).config.model.spec.grid == spec.grid  # it holds them: it stays
