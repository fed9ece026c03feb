"""OpenPCDet's PointPillars, imported: the same values after every part, then a bundle that finds the same boxes."""

import dataclasses
import math
import pickle
from pathlib import Path

import pytest
import torch

from asca_deploy.browser_page import write_page
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import BundleError, ConfigError, TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, load_config
from asca_pillars.models.build import Checkpoint, load_checkpoint
from asca_pillars.models.openpcdet.import_checkpoint import published_config, read_foreign, write_imported
from asca_pillars.models.pillar.network import PillarDetector
from tests.export.deployed import assert_same_detector
from tests.export.tiny import SCANS
from tests.models.openpcdet.foreign_networks import PointPillars, random_weights, write_foreign
from tests.models.openpcdet.small_pointpillars import NETWORK, SPEC, assert_same_boxes, assert_same_parts, padded

CONFIG = Config(name="foreign", model=PillarModel(spec=SPEC, network=NETWORK))


@pytest.fixture(scope="module")
def foreign() -> PointPillars:
    network = PointPillars(12, NETWORK.block_channels, NETWORK.block_convs, 8, len(SPEC.classes))
    assert isinstance(random_weights(network), PointPillars)
    return network


@pytest.fixture(scope="module")
def imported(foreign: PointPillars, tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    folder = tmp_path_factory.mktemp("foreign")
    weights = read_foreign(write_foreign(folder / "theirs.pth", foreign.state_dict()))
    assert published_config(weights) == "openpcdet_pointpillars_kitti"
    assert write_imported(weights, CONFIG, folder / "ours.ckpt") == len(foreign.state_dict()) + 1
    return load_checkpoint(folder / "ours.ckpt")


def test_every_part_gives_what_theirs_gives(foreign: PointPillars, imported: Checkpoint) -> None:
    assert isinstance(imported.detector, PillarDetector)
    layer = foreign.vfe.pfn_layers[0]
    assert_same_parts(imported.detector, lambda each: layer(padded(each)), foreign.backbone_2d, foreign.dense_head)


def test_boxes_are_decoded_as_theirs() -> None:
    """Anchors from end to end of the range; a direction bin has the half circle from 45 degrees on."""
    anchors = [(3.9, 1.6, 1.56, -1.78), (0.8, 0.6, 1.73, -0.6 - 1.73 / 2), (1.76, 0.6, 1.73, -0.6 - 1.73 / 2)]
    assert_same_boxes(SPEC, lambda count, low, high: torch.linspace(low, high, count), anchors, math.pi / 4)


def test_it_runs_as_a_bundle(imported: Checkpoint, tmp_path: Path) -> None:
    """Anchors from end to end, and directions as mmdetection3d has them."""
    assert isinstance(imported.config.model, PillarModel)
    spec = dataclasses.replace(SPEC, direction_offset_rad=-math.pi / 2)
    model = dataclasses.replace(imported.config.model, spec=spec)
    imported = imported._replace(config=dataclasses.replace(imported.config, model=model))
    bundle = export_pillar_bundle(imported, tmp_path / "bundle", SCANS)
    assert bundle.spec.direction_offset_rad == -math.pi / 2
    assert bundle.parity is not None and bundle.provenance.steps == 18560
    assert bundle.spec.anchor_places == "ends" and bundle.spec.anchor_scores == "every"
    assert_same_detector(imported, tmp_path / "bundle")
    with pytest.raises(BundleError, match="anchor_places ends, anchor_scores every; the page runs anchors at cell"):
        write_page(tmp_path / "page", tmp_path / "bundle", tmp_path / "scan.npy", tmp_path)


def test_what_does_not_fit_is_named(foreign: PointPillars, tmp_path: Path) -> None:
    state = foreign.state_dict()

    def refused(message: str, changes: dict[str, torch.Tensor | None], config: Config = CONFIG) -> None:
        changed = {name: value for name, value in (state | changes).items() if value is not None}
        weights = read_foreign(write_foreign(tmp_path / "theirs.pth", changed))
        with pytest.raises((TrainingError, ConfigError), match=message):
            write_imported(weights, config, tmp_path / "ours.ckpt")
        assert not (tmp_path / "ours.ckpt").exists()

    some = torch.zeros(3)
    refused(r"theirs\.pth: lacks dense_head\.conv_cls\.bias;", {"dense_head.conv_cls.bias": None})
    refused(r"a\.0, a\.1, a\.2, a\.3, a\.4 and 2 more: no place", {f"a.{number}": some for number in range(7)})
    refused(
        r"conv_box\.bias has shape \(3,\), which does not fit head\.boxes\.bias \(42,\)",
        {"dense_head.conv_box.bias": some},
    )
    linear = "vfe.pfn_layers.0.linear.weight"
    for features in (9, 11):
        refused(
            rf"linear\.weight has shape \(\d+, {features}\): .* must have 10 features",
            {linear: torch.zeros(len(state[linear]), features)},
        )
    refused("OpenPCDet's model has no encode.pillar_attention", {}, Config(name="own", model=PillarModel()))
    refused("OpenPCDet has none", {}, load_config("asca_refine_sim"))


def test_files_that_are_no_weights(tmp_path: Path) -> None:
    (tmp_path / "text.pth").write_text("no weights")
    (tmp_path / "code.pth").write_bytes(pickle.dumps({"model_state": Path("x")}))
    torch.save({"weights": {}}, tmp_path / "other.pth")
    torch.save({"model_state": {"backbone.conv.weight": torch.zeros(1)}}, tmp_path / "unknown.pth")
    for name, message in (
        ("text.pth", "damaged, or holds more than weights"),
        ("code.pth", "damaged, or holds more than weights"),
        ("other.pth", "has neither `model_state` with arrays"),
        ("none.pth", "no such file"),
    ):
        with pytest.raises(TrainingError, match=message):
            read_foreign(tmp_path / name)
    with pytest.raises(
        TrainingError, match="neither PointPillars nor PV-RCNN of OpenPCDet or mmdetection3d; it has the parts backbone"
    ):
        published_config(read_foreign(tmp_path / "unknown.pth"))


def test_the_published_model_has_its_published_size(tmp_path: Path) -> None:
    config = load_config("openpcdet_pointpillars_kitti")
    published = PointPillars(64, (64, 128, 256), (3, 5, 5), 128, 3)
    assert sum(weight.numel() for weight in published.parameters()) == 4_834_888
    write_imported(
        read_foreign(write_foreign(tmp_path / "theirs.pth", published.state_dict())), config, tmp_path / "p.ckpt"
    )
    assert load_checkpoint(tmp_path / "p.ckpt").config == config
