"""mmdetection3d's PointPillars and PV-RCNN, imported: the same values after every part, and the same boxes."""

import dataclasses
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config, load_config
from asca_pillars.models.build import Checkpoint, load_checkpoint
from asca_pillars.models.openpcdet.import_checkpoint import published_config, read_foreign, write_imported
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from tests.models.openpcdet.foreign_networks import random_weights
from tests.models.openpcdet.mmdetection3d_networks import PointPillars, PvRcnn, write_mmdetection3d
from tests.models.openpcdet.small_pointpillars import NETWORK, assert_same_boxes, assert_same_parts, padded
from tests.models.openpcdet.small_pointpillars import SPEC as OPENPCDET_SPEC
from tests.models.openpcdet.small_pv_rcnn import CONFIG as PV_RCNN_CONFIG
from tests.models.openpcdet.small_pv_rcnn import PUBLISHED_CHANNELS, foreign_pv_rcnn, in_layout
from tests.models.openpcdet.small_pv_rcnn import assert_same_parts as assert_same_pv_rcnn

PUBLISHED = load_config("mmdetection3d_pointpillars_kitti").model.spec
SPEC = dataclasses.replace(
    OPENPCDET_SPEC,
    anchor_places="cells",
    classes=PUBLISHED.classes,
    direction_offset_rad=PUBLISHED.direction_offset_rad,
)
CONFIG = Config(name="foreign", model=PillarModel(spec=SPEC, network=NETWORK))
NOT_LEGACY = "model = dict(voxel_encoder=dict(type='PillarFeatureNet', legacy=False))"


@pytest.fixture(scope="module")
def foreign() -> PointPillars:
    network = PointPillars(12, NETWORK.block_channels, NETWORK.block_convs, 8, len(SPEC.classes))
    assert isinstance(random_weights(network, seed=1), PointPillars)
    return network


def imported(foreign: PointPillars, folder: Path, **meta: Any) -> Checkpoint:
    weights = read_foreign(write_mmdetection3d(folder / "theirs.pth", foreign.state_dict(), **meta))
    assert published_config(weights) == "mmdetection3d_pointpillars_kitti"
    assert write_imported(weights, CONFIG, folder / "ours.ckpt") == len(foreign.state_dict())
    return load_checkpoint(folder / "ours.ckpt")


@pytest.mark.parametrize("legacy", [True, False])
def test_every_part_gives_what_theirs_gives(foreign: PointPillars, tmp_path: Path, legacy: bool) -> None:
    checkpoint = imported(foreign, tmp_path, **({} if legacy else {"cfg": NOT_LEGACY}))
    assert isinstance(checkpoint.detector, PillarDetector) and checkpoint.steps == 37120
    layer = foreign.vfe.pfn_layers[0]
    assert_same_parts(
        checkpoint.detector,
        lambda pillars: layer(padded(pillars, legacy=legacy)),
        foreign.backbone_2d,
        foreign.dense_head,
    )


def centers(count: int, low: float, high: float) -> Tensor:
    """Where AlignedAnchor3DRangeGenerator has anchors."""
    edges = torch.linspace(low, high, count + 1)
    return edges[:-1] + (edges[1] - edges[0]) / 2


def test_boxes_are_decoded_as_theirs() -> None:
    anchors = [(0.8, 0.6, 1.73, -0.6), (1.76, 0.6, 1.73, -0.6), (3.9, 1.6, 1.56, -1.78)]
    assert_same_boxes(SPEC, centers, anchors, -math.pi / 2)


def test_the_published_models_have_their_published_sizes(tmp_path: Path) -> None:
    pillars = PointPillars(64, (64, 128, 256), (3, 5, 5), 128, 3)
    model = load_config("mmdetection3d_pv_rcnn_kitti").model
    assert isinstance(model, PvRcnnModel)
    for network, name, parameters in (
        (pillars, "mmdetection3d_pointpillars_kitti", 4_834_888),
        (foreign_pv_rcnn(PvRcnn, model, PUBLISHED_CHANNELS), "mmdetection3d_pv_rcnn_kitti", 13_115_697),
    ):
        assert sum(weight.numel() for weight in network.parameters()) == parameters
        state = in_layout(network.state_dict(), "2.x", "middle_encoder")
        weights = read_foreign(write_mmdetection3d(tmp_path / "theirs.pth", state))
        assert published_config(weights) == name
        write_imported(weights, load_config(name), tmp_path / f"{name}.ckpt")
        assert load_checkpoint(tmp_path / f"{name}.ckpt").config == load_config(name)


def test_every_part_of_pv_rcnn_gives_what_theirs_gives(tmp_path: Path) -> None:
    theirs = foreign_pv_rcnn(PvRcnn)
    random_weights(theirs)
    state = in_layout(theirs.state_dict(), "1.x", "middle_encoder")
    weights = read_foreign(write_mmdetection3d(tmp_path / "theirs.pth", state, dataset_meta={}))
    write_imported(weights, PV_RCNN_CONFIG, tmp_path / "ours.ckpt")
    detector = load_checkpoint(tmp_path / "ours.ckpt").detector
    assert isinstance(detector, PvRcnnDetector)
    assert_same_pv_rcnn(theirs, detector.network)


class HistoryBuffer:
    """As mmengine's, which stands beside the weights of every training: arrays, and its own methods by name."""

    def __init__(self) -> None:
        self._log_history = np.array([0.1, 0.2])
        self.statistics_methods = {"mean": HistoryBuffer.mean}

    def mean(self) -> float:
        return float(self._log_history.mean())


class Attack:
    """What a pickle runs when it is read with all that Python allows."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return exec, (f"open({str(self.path)!r}, 'w')",)


def test_logs_beside_the_weights_are_left_out_and_nothing_is_executed(foreign: PointPillars, tmp_path: Path) -> None:
    beside = {"log": HistoryBuffer(), "seed": np.int64(3), "attack": Attack(tmp_path / "attacked")}
    assert imported(foreign, tmp_path, **beside).steps == 37120
    assert not (tmp_path / "attacked").exists()
    within = foreign.state_dict() | {"bbox_head.conv_cls.bias": Attack(tmp_path / "attacked")}
    with pytest.raises(TrainingError, match="has neither `model_state` with arrays"):
        read_foreign(write_mmdetection3d(tmp_path / "theirs.pth", within))
    (tmp_path / "raw.pth").write_bytes(pickle.dumps({"state_dict": Attack(tmp_path / "attacked")}))
    with pytest.raises(
        TrainingError, match=r"raw\.pth: damaged, or .* write a file with .*`state_dict` \(mmdetection3d\) alone"
    ):
        read_foreign(tmp_path / "raw.pth")
    assert not (tmp_path / "attacked").exists()


def test_what_does_not_fit_is_named(foreign: PointPillars, tmp_path: Path) -> None:
    state, linear = foreign.state_dict(), "voxel_encoder.pfn_layers.0.linear.weight"
    swapped = dataclasses.replace(SPEC, classes=SPEC.classes[::-1])
    for changes, meta, config, message in (
        ({linear: torch.zeros(12, 9)}, {}, CONFIG, "has 9 features of a point: trained by mmdetection3d before 1.0"),
        ({linear: torch.zeros(12, 11)}, {}, CONFIG, "must have 10 features"),
        ({}, {"mmdet3d_version": "0.18.1"}, CONFIG, "trained by mmdetection3d 0.18.1, whose boxes have other axes"),
        ({"bbox_head.conv_reg.bias": None}, {}, CONFIG, r"lacks bbox_head\.conv_reg\.bias;"),
        ({"img_neck.weight": torch.zeros(1)}, {}, CONFIG, r"img_neck\.weight: no place for it"),
        (
            {},
            {},
            Config(name="foreign", model=PillarModel(spec=swapped, network=NETWORK)),
            "its classes are Pedestrian, Cyclist, Car, those of foreign Car, Cyclist, Pedestrian",
        ),
        ({}, {}, Config(name="own", model=PillarModel()), "its classes are Pedestrian, Cyclist, Car, those of own Car"),
        ({}, {"dataset_meta": {}}, Config(name="own"), "mmdetection3d's model has no encode.pillar_attention"),
    ):
        changed = {name: value for name, value in (state | changes).items() if value is not None}
        with pytest.raises((TrainingError, ConfigError), match=message):
            weights = read_foreign(write_mmdetection3d(tmp_path / "theirs.pth", changed, **meta))
            write_imported(weights, config, tmp_path / "ours.ckpt")
        assert not (tmp_path / "ours.ckpt").exists()


def test_our_own_checkpoint_needs_no_import(foreign: PointPillars, tmp_path: Path) -> None:
    imported(foreign, tmp_path)
    with pytest.raises(TrainingError, match=r"ours\.ckpt: a checkpoint of `asca train`, which needs no import"):
        read_foreign(tmp_path / "ours.ckpt")
