"""Scans in the vehicle's frame: objects are inserted as the sensor would see them, wherever it stands."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.data.boxes.box_records import json_line, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.frames import read_frame
from asca_pillars.data.insertion.insert_objects import insert_objects
from asca_pillars.data.kitti import KittiSplit, write_image_set
from asca_pillars.scans.scan_reader import write_scan
from tests.data.insertion.inserters import METHODS, config, open_inserter
from tests.data.insertion.simple_streets import TYPES, write_streets
from tests.helpers.scenes import SPEC


def write_boxes(street: Path, root: Path, sensor_m: tuple[float, float, float]) -> Path:
    """The same street without a camera, in a frame in which the sensor stands there."""
    split, lines = KittiSplit(street, "train"), []
    for frame_id in split.frame_ids:
        frame = read_frame(split, frame_id, TYPES, camera_view=False)
        points, boxes = frame.points, np.array(frame.boxes, np.float64)
        points[:, :3] = np.round(points[:, :3] * 512) / 512  # so that nothing is rounded when they are moved
        boxes[:, :6] = np.round(boxes[:, :6] * 512) / 512
        points[:, :3] += np.array(sensor_m, np.float32)
        boxes[:, :3] += sensor_m
        write_scan(root / "scans" / f"{frame_id}.bin", points)
        lines.append(json_line(f"{frame_id}.bin", records_from(boxes, [TYPES[label] for label in frame.labels])))
    (root / "labels.jsonl").write_text("".join(lines))
    (root / "dataset.yaml").write_text(f"sensor_position: {list(sensor_m)}\n")
    write_image_set(root, "train", split.frame_ids)
    return root


@pytest.mark.parametrize("method", METHODS)
def test_what_hides_what_is_seen_from_the_sensor(tmp_path: Path, method: str) -> None:
    """In a vehicle's frame, as Argoverse 2's and Waymo's are, the origin is on the ground."""
    root = write_streets(tmp_path / "streets", 6)
    sensor_m, grown = (1.5, 0.25, 1.75), []
    for name, position in (("sensor", (0.0, 0.0, 0.0)), ("vehicle", sensor_m)):
        split = BoxSplit(write_boxes(root, tmp_path / name, position), "train")
        inserter = open_inserter(split, config(method, objects=6))
        inserter = dataclasses.replace(inserter, ranges=SPEC.ranges.shifted(position))
        frames = [read_frame(split, frame_id, TYPES) for frame_id in split.frame_ids]
        grown.append([insert_objects(frame, inserter, np.random.default_rng(0)) for frame in frames])
        assert sum(len(after.boxes) - len(before.boxes) for after, before in zip(grown[-1], frames, strict=True)) > 6
    for own, other in zip(*grown, strict=True):
        assert len(own.points) == len(other.points)
        np.testing.assert_allclose(other.points[:, :3] - np.array(sensor_m, np.float32), own.points[:, :3], atol=1e-4)
        np.testing.assert_allclose(other.boxes[:, :3] - np.array(sensor_m, np.float32), own.boxes[:, :3], atol=1e-4)
        np.testing.assert_array_equal(other.labels, own.labels)
