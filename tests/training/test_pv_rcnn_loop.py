"""PV-RCNN through the same training as the other families: resume, evaluation of a checkpoint, what is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import load_config, pillar_spec
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.models.scan_detector import ScanDetector
from asca_pillars.training.loop import train
from tests.helpers.scenes import write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, NETWORK, SPEC, tiny_config


def test_a_run_made_longer_is_the_longer_run(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 5)
    straight = load_checkpoint(train(tiny_config(), data, tmp_path / "straight"))
    train(tiny_config(epochs=1), data, tmp_path / "resumed")
    resumed = load_checkpoint(train(tiny_config(), data, tmp_path / "resumed"))
    assert straight.steps == resumed.steps == 4
    for (name, expected), found in zip(
        straight.detector.state_dict().items(), resumed.detector.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(found, expected, msg=name, rtol=0, atol=0)
    points = KittiSplit(data, "val").points("000004", camera_view=True)
    detect = ScanDetector(resumed.detector, SPEC.with_score_threshold(0.0))
    found = detect(points)
    assert len(found) > 0 and np.isfinite(found.boxes).all()
    assert len(detect(np.empty((0, 4), np.float32))) == 0


def test_the_second_stage_alone_on_a_trained_first_one(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 5)
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


def test_what_cannot_be() -> None:
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
