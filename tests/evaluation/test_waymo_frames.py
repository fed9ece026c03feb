"""KITTI text as Waymo's metric takes it: the frame, the levels, the classes and what stands for no-label zones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.objects import frame_objects
from asca_pillars.evaluation.predictions import ScoredFrames, read_truth
from asca_pillars.evaluation.waymo import evaluated_classes, upright_boxes, waymo_frames
from asca_pillars.geometry.boxes import corners
from asca_pillars.geometry.overlap import iou_3d
from tests.evaluation.kitti.kitti_objects import CAR, DONT_CARE, beside, hit
from tests.helpers.scenes import write_dataset


def scored(truth: list[KittiObject], found: list[KittiObject]) -> ScoredFrames:
    return ScoredFrames((frame_objects("0", truth),), (frame_objects("0", found),), ())


def test_boxes_stand_upright_before_the_camera() -> None:
    """2 m to the right, 20 m ahead, its bottom 1.7 m below the camera; rotation_y -pi/2 heads away from it."""
    ahead = replace(CAR, rotation_y=-np.pi / 2)
    (box,) = upright_boxes(frame_objects("0", [ahead]))
    np.testing.assert_allclose(box, [20, -2, 0.75 - 1.7, 3.9, 1.6, 1.5, 0], atol=1e-12)
    # rotation_y 0 heads to the right, which is -y.
    front = corners(upright_boxes(frame_objects("0", [replace(CAR, rotation_y=0.0)])))[0, [0, 3]].mean(axis=0)
    np.testing.assert_allclose(front[:2], [20, -2 - 3.9 / 2], atol=1e-12)


def test_classes_are_kittis_and_without_scans_all_objects_are_of_level_2() -> None:
    labels = [CAR, replace(CAR, type="Van"), replace(CAR, type="Truck"), replace(CAR, type="Forklift"), DONT_CARE]
    assert evaluated_classes(scored(labels, [])) == ("Car", "Forklift")
    found = [hit(type="CYCLIST"), hit(type="truck")]
    assert evaluated_classes(scored(labels, found)) == ("Car", "Cyclist", "Forklift", "Truck")
    assert evaluated_classes(scored([DONT_CARE], [])) == ()
    flat = hit(height_m=-1.0, width_m=-1.0, length_m=-1.0, x_m=-1000.0, y_m=-1000.0, z_m=-1000.0)
    frames = waymo_frames(scored([CAR, DONT_CARE], [hit(score=0.25), flat, hit(type="Tram")]), ("Car",), None)
    assert frames.truth[0].levels.tolist() == [2]
    assert frames.detections[0].scores.tolist() == [0.25] and len(frames.no_label[0]) == 1


def test_levels_come_from_the_points_in_the_boxes(tmp_path: Path) -> None:
    """Every object of a made-up scene has 150 points on it; one of the others has five, one has none."""
    split = KittiSplit(write_dataset(tmp_path / "kitti", 1))
    truth = read_truth(split.folder / "label_2")
    frames = ScoredFrames(tuple(truth), tuple(replace(frame, scores=np.ones(len(frame))) for frame in truth), ())
    names = ("Car", "Pedestrian", "Cyclist")
    assert waymo_frames(frames, names, split).truth[0].levels.tolist() == [1] * len(truth[0])
    path = split.scan_path(truth[0].frame_id)
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    boxes = upright_boxes(truth[0])
    right, _, forward = split.calibration(truth[0].frame_id).rect_from_lidar(points[:, :3]).T
    near = np.hypot(forward - boxes[0, 0], -right - boxes[0, 1]) < 4
    points[~near].tofile(path)
    assert waymo_frames(frames, names, split).truth[0].levels.tolist()[0] == 0
    kept = np.flatnonzero(near)[:5]
    center = split.calibration(truth[0].frame_id).lidar_from_rect(np.array([-boxes[0, 1], -boxes[0, 2], boxes[0, 0]]))
    points[kept, :3] = center
    np.concatenate([points[~near], points[kept]]).tofile(path)
    assert waymo_frames(frames, names, split).truth[0].levels.tolist()[0] == 2


def test_neighbors_stand_for_no_label_zones_and_scores_lie_within_the_cutoffs() -> None:
    van = beside(CAR, 2, type="Van")
    found = [hit(), hit(beside(CAR, 2)), hit(beside(CAR, 5)), hit(beside(CAR, 2), type="Cyclist")]
    frames = waymo_frames(scored([DONT_CARE, van], found), ("Car", "Cyclist"), None)
    assert frames.no_label[0].tolist() == [True, True, False, False]
    # A neighboring type that is itself evaluated is an object like any other.
    frames = waymo_frames(scored([van], found[:2]), ("Car", "Van"), None)
    assert frames.no_label[0].tolist() == [False, False]
    assert iou_3d(frames.detections[0].boxes, frames.truth[0].boxes)[:, 0].tolist() == pytest.approx([0, 1], abs=1e-5)
    with pytest.raises(DatasetError, match=r"frame 0: score -3.5; Waymo's metric cuts off at 0, 0.01 .. 1: scale"):
        waymo_frames(scored([CAR], [hit(score=-3.5)]), ("Car",), None)
