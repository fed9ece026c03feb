"""OpenPCDet's PointPillars, imported: the same values after every part, then a bundle that finds the same boxes."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from asca_deploy.browser_page import write_page
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import BundleError, ConfigError, TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, load_config
from asca_pillars.detection.decode import HeadMaps, PostProcess
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.models.openpcdet.import_checkpoint import published_config, read_foreign, write_imported
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.pillar.prepare import Pillars
from tests.export.deployed import assert_same_detector
from tests.export.tiny import SCANS
from tests.models.openpcdet.foreign_networks import PointPillars, random_weights, write_foreign
from tests.models.openpcdet.small_pointpillars import GRID, NETWORK, SLOTS, SPEC

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


def padded(pillars: Pillars) -> torch.Tensor:
    """(P, slots, 10) as PillarVFE makes them of kept points: from coordinates and indices alone, zeros behind them."""
    found = np.zeros((len(pillars.cells), SLOTS, 10), np.float32)
    for pillar, cell in enumerate(pillars.cells):
        points = pillars.features[pillars.pillar_index == pillar, :4]
        row, column = divmod(int(cell), GRID.nx)
        center = 4.8 + (column + 0.5) * 0.32, -6.4 + (row + 0.5) * 0.32, (1.5 - 3.0) / 2
        found[pillar, : len(points)] = np.hstack(
            [points, points[:, :3] - points[:, :3].mean(0), points[:, :3] - center]
        )
    return torch.from_numpy(found)


def detector_of(checkpoint: Checkpoint) -> PillarDetector:
    assert isinstance(checkpoint.detector, PillarDetector)
    return checkpoint.detector


def test_every_part_gives_what_theirs_gives(foreign: PointPillars, imported: Checkpoint) -> None:
    detector, pillars = detector_of(imported), SPEC.pillarize(SCANS[0])
    full = pillars.point_counts == SLOTS
    assert full.any() and not full.all(), "pillars with empty slots and without"
    batch = batch_pillars([pillars])
    with torch.inference_mode():
        theirs = foreign.vfe.pfn_layers[0](padded(pillars))
        ours = detector.encode(batch.features, batch.pillar_index, batch.point_counts)
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
        canvas = torch.zeros(GRID.ny * GRID.nx, 12)
        canvas[torch.from_numpy(pillars.cells)] = theirs
        features = foreign.backbone_2d(canvas.T.reshape(1, 12, GRID.ny, GRID.nx))
        torch.testing.assert_close(detector.neck(detector.scatter(ours, batch.cells, batch.frame_cells)), features)
        for name, ours_map, their_map in zip(
            HeadMaps._fields, detector(batch), foreign.dense_head(features), strict=True
        ):
            torch.testing.assert_close(ours_map, their_map, atol=1e-4, rtol=1e-4, msg=name)


def test_boxes_are_decoded_as_theirs() -> None:
    height, width = GRID.head_shape
    rng = np.random.default_rng(0)
    maps = HeadMaps(*(rng.normal(0, 0.5, (6 * size, height, width)).astype(np.float32) for size in (3, 7, 2)))
    scores, residuals, directions = (
        part.transpose(1, 2, 0).reshape(height, width, 3, 2, -1)
        for part in maps  # size of the anchor, then its yaw
    )
    best = np.sort(scores.max(axis=-1).reshape(-1))[-20]
    spec = dataclasses.replace(SPEC, post=PostProcess(nms_iou=1.0, max_detections=1000))
    found = spec.with_score_threshold(float(1 / (1 + np.exp(-best.astype(np.float64) + 1e-6)))).decode(maps)
    expected = []
    for y, x, size, turned in np.argwhere(scores.max(axis=-1) >= best):
        anchor, residual = SPEC.classes[size], residuals[y, x, size, turned]
        # Anchors from end to end of the range, on their feet; the direction bin has the half circle from 45 degrees on.
        center = 4.8 + x * 20.48 / (width - 1), -6.4 + y * 15.36 / (height - 1), anchor.z_m
        dims = np.array([anchor.length_m, anchor.width_m, anchor.height_m])
        diagonal = np.hypot(dims[0], dims[1])
        yaw = residual[6] + turned * np.pi / 2 - np.pi / 4
        yaw = yaw - np.floor(yaw / np.pi) * np.pi + np.pi / 4 + np.pi * directions[y, x, size, turned].argmax()
        place = center + residual[:3] * [diagonal, diagonal, dims[2]]
        label = scores[y, x, size, turned].argmax()
        expected.append([label, *place, *(dims * np.exp(residual[3:6])), np.sin(yaw), np.cos(yaw)])
    yaws = found.boxes[:, 6:]
    ours = np.hstack([found.labels[:, None], found.boxes[:, :6], np.sin(yaws), np.cos(yaws)])
    assert len(ours) == len(expected) == 20 and len(set(found.labels)) > 1
    wanted_rows = np.array(expected)
    np.testing.assert_allclose(
        ours[np.lexsort(ours.T[1:3])], wanted_rows[np.lexsort(wanted_rows.T[1:3])], atol=2e-3, rtol=1e-4
    )


def test_it_runs_as_a_bundle(imported: Checkpoint, tmp_path: Path) -> None:
    bundle = export_pillar_bundle(imported, tmp_path / "bundle", SCANS)
    assert bundle.parity is not None and bundle.provenance.steps == 18560
    assert bundle.spec.anchor_places == "ends" and bundle.spec.anchor_scores == "every"
    assert_same_detector(imported, tmp_path / "bundle", tmp_path)
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
