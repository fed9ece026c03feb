"""Simulated sequences on disk: reproducible, readable as a dataset, and with labels that the points agree with."""

import json
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.sim.sequence_files import SequencePlan, simulate_sequence_frame, simulate_sequences
from asca_pillars.sim.simulation import SimulationConfig, load_simulation_config

VLP = load_simulation_config("vlp_16", "around")


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_any_number_of_workers_writes_the_same_bytes_and_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    for name, workers in (("one", 1), ("two", 2)):
        simulate_sequences(tmp_path / name, 2, 2, 0, workers, VLP, val_share=0.5)
    one = files(tmp_path / "one")
    assert len(one) == 2 * 2 * 2 + 4
    assert files(tmp_path / "two") == one
    (tmp_path / "one/scans/0001/000001.bin").unlink()
    (tmp_path / "one/labels/0001/000001.json").unlink()
    simulate_sequences(tmp_path / "one", 2, 2, 0, 1, VLP, val_share=0.5)
    assert files(tmp_path / "one") == one
    with pytest.raises(DatasetError, match="another folder"):
        simulate_sequences(tmp_path / "one", 2, 4, 0, 1, VLP)
    split = BoxSplit(tmp_path / "one", "val")
    assert split.frame_ids == ("0001/000000", "0001/000001")
    first, second = (split.records(frame_id) for frame_id in split.frame_ids)
    assert set(first.track_ids) & set(second.track_ids) and split.points("0001/000000").shape[1] == 4
    times = [json.loads((tmp_path / f"one/labels/{name}.json").read_text())["time_s"] for name in split.frame_ids]
    assert times[1] - times[0] == pytest.approx(0.1) and times[0] > 0


def test_boxes_follow_the_points_and_what_stands_still_stays_in_the_world() -> None:
    plan = SequencePlan(3, 60, VLP)
    speeds = []
    for index in range(0, 60, 20):
        frame = simulate_sequence_frame(plan, 1, index)
        for box in frame.labels["boxes"]:
            speeds.append(np.hypot(box["vx_mps"], box["vy_mps"]))
            if box["points"] >= 20 and box["class"] in ("Car", "Van", "Truck"):  # people carry and push things
                size = [box[f"{name}_m"] + 0.3 for name in ("length", "width", "height")]
                grown = np.array([[box["x_m"], box["y_m"], box["z_m"], *size, box["yaw_rad"]]], np.float32)
                assert points_in_boxes(frame.points, grown).sum() >= 0.9 * box["points"]
    assert min(speeds) == 0 and max(speeds) > 3
    plan = SequencePlan(3, 60, VLP)
    world: dict[int, list[np.ndarray]] = {}
    for index in (0, 20, 40):
        labels = simulate_sequence_frame(plan, 1, index).labels
        pose = np.array(labels["ego_pose"])
        for box in labels["boxes"]:
            if box["vx_mps"] == box["vy_mps"] == 0 and box["class"] == "Car":
                world.setdefault(box["track_id"], []).append(pose @ [box["x_m"], box["y_m"], box["z_m"], 1])
    still = [np.ptp(places, axis=0) for places in world.values() if len(places) == 3]
    assert len(still) > 2 and np.max(still) < 1e-3


def test_the_camera_keeps_a_part_of_the_same_points() -> None:
    around = simulate_sequence_frame(SequencePlan(3, 20, VLP), 0, 5)
    camera = simulate_sequence_frame(SequencePlan(3, 20, SimulationConfig(VLP.scene, VLP.lidar, "camera")), 0, 5)
    assert 0 < len(camera.points) < len(around.points)
    rows = {row.tobytes() for row in around.points}
    assert all(row.tobytes() in rows for row in camera.points)
    ids = {box["track_id"] for box in around.labels["boxes"]}
    assert {box["track_id"] for box in camera.labels["boxes"]} <= ids


def test_impossible_wishes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="length is 0"):
        simulate_sequences(tmp_path / "x", 1, 0)
    with pytest.raises(ConfigError, match=r"val_share is 2"):
        simulate_sequences(tmp_path / "x", 1, 1, val_share=2.0)
    assert not (tmp_path / "x").exists()
