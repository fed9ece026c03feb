"""OpenPCDet's PV-RCNN, imported from both versions of spconv: the same values after every part."""

from pathlib import Path
from typing import Any

import pytest
import torch

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import load_config
from asca_pillars.models.build import load_checkpoint
from asca_pillars.models.openpcdet.import_checkpoint import published_config, read_foreign, write_imported
from asca_pillars.models.pv_rcnn.layers import PvRcnn as OurNetwork
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from tests.models.openpcdet.foreign_networks import PvRcnn, random_weights, write_foreign
from tests.models.openpcdet.small_pv_rcnn import (
    CONFIG,
    LAYOUTS,
    PUBLISHED_CHANNELS,
    assert_same_parts,
    foreign_pv_rcnn,
    in_layout,
)


@pytest.fixture(scope="module")
def foreign() -> Any:
    return random_weights(foreign_pv_rcnn(PvRcnn))


def imported(foreign: PvRcnn, folder: Path, layout: str = "1.x") -> OurNetwork:
    weights = read_foreign(write_foreign(folder / "theirs.pth", in_layout(foreign.state_dict(), layout)))
    assert published_config(weights) == "pv_rcnn_kitti"
    write_imported(weights, CONFIG, folder / "ours.ckpt")
    detector = load_checkpoint(folder / "ours.ckpt").detector
    assert isinstance(detector, PvRcnnDetector)
    return detector.network


@pytest.mark.parametrize("layout", LAYOUTS)
def test_sparse_weights_of_every_layout_are_the_dense_ones(foreign: PvRcnn, tmp_path: Path, layout: str) -> None:
    ours, theirs = imported(foreign, tmp_path, layout).voxels, foreign.backbone_3d
    pairs = [(ours.get_submodule("same.0.0"), theirs.conv_input), (ours.get_submodule("same.0.1"), theirs.conv1[0])]
    for level, block in enumerate((theirs.conv2, theirs.conv3, theirs.conv4)):
        names = f"down.{level}", f"same.{level + 1}.0", f"same.{level + 1}.1"
        pairs += list(zip(map(ours.get_submodule, names), block, strict=True))
    for layer, (convolution, _) in [*pairs, (ours.get_submodule("down.3"), theirs.conv_out)]:
        assert isinstance(layer.convolution, torch.nn.Conv3d)
        assert torch.equal(layer.convolution.weight, convolution.weight)


def test_every_part_gives_what_theirs_gives(foreign: PvRcnn, tmp_path: Path) -> None:
    assert_same_parts(foreign, imported(foreign, tmp_path))


def test_the_published_model_fits(tmp_path: Path) -> None:
    config = load_config("pv_rcnn_kitti")
    assert isinstance(config.model, PvRcnnModel)
    published = foreign_pv_rcnn(PvRcnn, config.model, PUBLISHED_CHANNELS)
    assert sum(weight.numel() for weight in published.parameters()) == 13_115_697
    weights = read_foreign(write_foreign(tmp_path / "theirs.pth", in_layout(published.state_dict(), "2.x")))
    write_imported(weights, config, tmp_path / "ours.ckpt")
    assert load_checkpoint(tmp_path / "ours.ckpt").steps == weights.steps
