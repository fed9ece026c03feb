"""Two stages through the same training as a pillar detector: resume, cached proposals, average, evaluation."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import AugmentConfig, load_config, pillar_spec
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.data.augment import move_scene
from asca_pillars.data.frames import LabeledFrame, Motion
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.models.build import ScanDetector, build_model, load_checkpoint
from asca_pillars.models.two_stage.first_stage import open_first_stage, with_first_stage
from asca_pillars.models.two_stage.network import RefineDetector, refine
from asca_pillars.models.two_stage.preparation import LabeledProposals, move_proposed
from asca_pillars.ops.two_stage.decode import match_proposals
from asca_pillars.ops.two_stage.first_stage import run_first_stage
from asca_pillars.training.dataset import Batch, Collate, open_dataset
from asca_pillars.training.loop import train
from tests.helpers.scenes import SPEC, write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, NETWORK, tiny_config
from tests.models.pv_rcnn.tiny_pv_rcnn import SPEC as VOXELS
from tests.models.two_stage.small_refiner import proposed_frame
from tests.models.two_stage.tiny_refine import (
    STILL_OBJECTS,
    opened_config,
    tiny_refine_config,
    tiny_refine_model,
    write_first_stage,
)


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    return write_first_stage(tmp_path / "first.ckpt")


@pytest.mark.parametrize("family", ["pillar_refine", "pv_rcnn"])
def test_a_run_made_longer_is_the_longer_run(family: str, tmp_path: Path, stage: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    long, short = (
        tiny_refine_config(stage, epochs=epochs) if family == "pillar_refine" else tiny_config(epochs=epochs)
        for epochs in (2, 1)
    )
    straight = load_checkpoint(train(long, data, tmp_path / "straight"))
    train(short, data, tmp_path / "resumed")
    resumed = load_checkpoint(train(long, data, tmp_path / "resumed"))
    assert straight.steps == resumed.steps == 2
    spec = straight.config.model.spec
    assert spec == (VOXELS if family == "pv_rcnn" else SPEC), "taken from the first stage"
    torch.testing.assert_close(resumed.detector.state_dict(), straight.detector.state_dict(), rtol=0, atol=0)
    points = KittiSplit(data, "val").points("000002", camera_view=True)
    detect = ScanDetector(resumed.detector, spec.with_score_threshold(0.0))
    assert np.isfinite((found := detect(points)).boxes).all() and len(found) > 0
    assert len(detect(np.empty((0, 4), np.float32))) == 0


def test_a_checkpoint_runs_both_stages(tmp_path: Path, stage: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    checkpoint = load_checkpoint(train(tiny_refine_config(stage, epochs=1), data, tmp_path / "run"))
    model, detector = checkpoint.config.model, checkpoint.detector
    assert isinstance(model, RefineModel) and isinstance(detector, RefineDetector)
    points = KittiSplit(data, "val").points("000002", camera_view=True)
    found = ScanDetector(detector, model.spec.with_score_threshold(0.0))(points)
    proposed = run_first_stage(open_first_stage(str(stage)), points, model.refine.seen)
    wanted = refine(detector.refiner, points, proposed, model.refine.neighbors, model.spec.post, model.refine.scores)
    assert len(found) > 0
    np.testing.assert_array_equal(found.boxes, wanted.boxes)
    np.testing.assert_allclose(found.scores, wanted.scores, atol=1e-6)
    assert len(ScanDetector(detector, model.spec)(np.empty((0, 4), np.float32))) == 0
    write_first_stage(stage, cpa="none")
    with pytest.raises(ConfigError, match=r"first\.ckpt: other weights are there"):
        ScanDetector(load_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt").detector, model.spec)(points)


def test_a_moved_scene_has_its_proposals_moved_with_it(tmp_path: Path, stage: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    moving = AugmentConfig(**vars(STILL_OBJECTS) | {"flip_probability": 1.0, "rotation_rad": 1.5, "shift_z_m": 0.2})
    config = dataclasses.replace(opened_config(stage), augment=moving)
    frames = open_dataset(data, config, training=True)
    sample = frames.sample(0, 0)
    assert sample.frame.motion.flipped and abs(sample.frame.motion.rotation_rad) > 0.01
    again = frames.sample(0, 0).prepared
    np.testing.assert_array_equal(sample.prepared.sample.scan.grid_points, again.sample.scan.grid_points)
    for keypoint in sample.prepared.sample.scan.keypoints:  # they are points of the scan, and must have stayed so
        assert np.abs(sample.frame.points[:, :3] - keypoint).max(axis=1).min() < 1e-4


@pytest.mark.parametrize("motion", [Motion(flipped=True), Motion(False, 2.0), Motion(True, -0.7, 1.1, 0.3)])
def test_motion_keeps_overlaps_and_headings(motion: Motion) -> None:
    frame, proposed = proposed_frame(0)
    of_labels = dataclasses.replace(proposed.proposals[:4], boxes=frame.boxes.copy())
    boxes = move_proposed(dataclasses.replace(proposed, proposals=of_labels), motion).proposals.boxes
    moved = copy.deepcopy(frame)
    move_scene(moved, motion)
    np.testing.assert_array_equal(of_labels.boxes, frame.boxes, "what is cached stays in its place")
    np.testing.assert_allclose(boxes[:, :6], moved.boxes[:, :6], atol=1e-5)
    np.testing.assert_allclose(wrap_angle(boxes[:, 6] - moved.boxes[:, 6]), 0, atol=1e-5)
    before = match_proposals(proposed.proposals, frame.boxes, frame.labels)
    after = match_proposals(move_proposed(proposed, motion).proposals, moved.boxes, frame.labels)
    np.testing.assert_allclose(after.iou, before.iou, atol=1e-4)
    np.testing.assert_array_equal(after.matched, before.matched)


def test_a_batch_without_proposals_is_learnt_from_and_changes_nothing(tmp_path: Path, stage: Path) -> None:
    model = with_first_stage(tiny_refine_model(stage))
    detector = build_model(model)
    assert isinstance(detector, RefineDetector)
    empty = LabeledFrame("", np.empty((0, 4), np.float32), np.empty((0, 7), np.float32), np.empty(0, np.int64))
    batch = detector.preparation.collate([detector.preparation.prepare(empty, np.random.default_rng(0))])
    before = {name: value.clone() for name, value in detector.named_buffers()}
    terms = detector.train().loss(detector.predict(batch), batch).values()
    torch.stack(list(terms)).sum().backward()
    assert all(weight.grad is not None and not weight.grad.any() for weight in detector.parameters())
    for name, value in detector.named_buffers():
        assert torch.equal(value, before[name]), name


def test_ignored_proposals_are_detected_and_not_learnt(tmp_path: Path, stage: Path) -> None:
    config = opened_config(stage)
    frames = open_dataset(write_dataset(tmp_path / "data", 3), config, training=False)
    batch = Collate(frames.preparation)([frames.sample(0, 0)])
    assert isinstance(batch, Batch)
    detector = build_model(config.model).eval()
    with torch.inference_mode():
        outputs = detector.predict(batch.inputs)
    assert isinstance(batch.inputs, LabeledProposals)
    batch.inputs.loss_mask[:] = False
    assert detector.loss(outputs, batch.inputs)["confidence"] == 0
    assert len(detector.detect(outputs, SPEC.with_score_threshold(0.0))[0]) > 0


def test_what_cannot_be(tmp_path: Path, stage: Path) -> None:
    model = "model.kind=pillar_refine"
    base = load_config("asca_refine_sim")
    assert base.model.kind == "pillar_refine"
    for override, message in (
        ("augment.object_shift_m=0.1", r"augment.object_shift_m = 0.1: .* set augment.object_shift_m=0"),
        ("augment.insert.method=rs_aug", "augment.insert.method = rs_aug"),
        ("model.refine.rois=1", "model.refine.rois = 1"),
        ("model.refine.network.dropout=1", "model.refine.network.dropout = 1"),
        ("model.refine.netwrk=1", "did you mean `network`"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_config("asca_refine_sim", [model, override])
    two = load_config("asca_refine_sim", [model, "model.refine.seen.proposals.quotas=[1, 2]"]).model
    assert two.kind == "pillar_refine"  # as a first stage of two classes needs it
    with pytest.raises(ConfigError, match="give one for each of the classes Car, Pedestrian"):
        with_first_stage(dataclasses.replace(two, first_stage=str(stage)))
    with pytest.raises(ConfigError, match="bev_channels = 0"):
        build_model(tiny_refine_config(stage).model)
    with pytest.raises(TrainingError, match="no such checkpoint"):
        with_first_stage(tiny_refine_model(tmp_path / "none.ckpt"))
    with pytest.raises(ConfigError, match=r"the map of .* has 48; leave it out"):
        with_first_stage(dataclasses.replace(tiny_refine_model(stage), bev_channels=47))


def test_the_second_stage_alone_on_a_trained_first_one(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    both = train(tiny_config(epochs=1), data, tmp_path / "both")
    network = dataclasses.replace(NETWORK, hidden=16)
    alone = tiny_config(dataclasses.replace(MODEL, network=network, train_first_stage=False), epochs=1)
    alone = dataclasses.replace(alone, train=dataclasses.replace(alone.train, ema=0.9))  # an average of equal weights
    with pytest.raises(TrainingError, match=r"train_first_stage = false: .* give .* --init"):
        train(alone, data, tmp_path / "second")
    weights = load_checkpoint(train(alone, data, tmp_path / "second", init=both)).detector.state_dict()
    given = load_checkpoint(both).detector.state_dict()
    kept = [name for name in weights if name.split(".")[1] in PvRcnnModel.FIRST_STAGE]
    assert {name.split(".")[1] for name in kept} == {"voxels", "neck", "head"}
    assert all(torch.equal(weights[name], given[name]) for name in kept)
    assert weights["network.refine.confidence.0.weight"].shape != given["network.refine.confidence.0.weight"].shape
    train(alone, data, tmp_path / "second")  # a run that is there has its first stage

    wider = dataclasses.replace(network, voxel_channels=(4, 6, 8, 8, 16))
    alone = tiny_config(dataclasses.replace(MODEL, network=wider, train_first_stage=False), epochs=1)
    with pytest.raises(TrainingError, match=r"another network: network\.voxels\..* in this configuration"):
        train(alone, data, tmp_path / "other", init=both)


def test_what_pv_rcnn_cannot_be() -> None:
    for override, message in (
        ("model.rois=1", "model.rois = 1: must be at least 2"),
        ("model.spec.grid.size_m=[0.1, 0.1, 0.05]", "81 voxels along z are more than 64"),
        ("model.spec.grid.y_range_m=[-30.3, 30.3]", "606 voxels along y must be a multiple of 8"),
        ("model.settings.sources=[{source: conv5, radii_m: [1], samples: [2]}]", "conv5"),
        ("model.settings.keypoint=3", "did you mean `keypoints`"),
        ("model.network.source_widths=[[8]]", "give one for each of model.settings.sources"),
        ("model.network.dropout=1", "model.network.dropout = 1"),
        ("model.network.grid_widths=[]", "model.network.grid_widths"),
        ("model.network.block_convs=[-1, 1]", "model.network.block_convs"),
        ("model.settings.keypoints=0", "keypoints 0"),
        ("model.settings.grid_radii_m=[]", "grid_radii_m"),
        ("model.kind=pvrcnn", "input should be"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_config("pvrcnn_small_sim", [override])
    with pytest.raises(ConfigError, match=r"model.kind = pv_rcnn: has no pillars"):
        pillar_spec(load_config("pvrcnn_small_sim"))
