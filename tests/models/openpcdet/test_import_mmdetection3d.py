"""mmdetection3d's PointPillars and PV-RCNN, imported: the same values after every part, and the same boxes."""

import dataclasses
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from asca_deploy import Detector
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config, load_config
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.models.openpcdet.import_checkpoint import published_config, read_foreign, write_imported
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from asca_pillars.ops.pillar.prepare import Pillars
from tests.export.deployed import assert_same_detector
from tests.export.tiny import SCANS
from tests.models.openpcdet import small_pointpillars as openpcdet
from tests.models.openpcdet import small_pv_rcnn as openpcdet_pv_rcnn
from tests.models.openpcdet.foreign_networks import random_weights
from tests.models.openpcdet.mmdetection3d_networks import PointPillars, PvRcnn, pillar_features, write_mmdetection3d
from tests.models.openpcdet.small_pv_rcnn import Parts, assert_same_parts

GRID, SLOTS, NETWORK = openpcdet.GRID, openpcdet.SLOTS, openpcdet.NETWORK
PUBLISHED = load_config("mmdetection3d_pointpillars_kitti").model.spec
SPEC = dataclasses.replace(
    openpcdet.SPEC,
    anchor_places="cells",
    classes=PUBLISHED.classes,
    direction_offset_rad=PUBLISHED.direction_offset_rad,
)
CONFIG = Config(name="foreign", model=PillarModel(spec=SPEC, network=NETWORK))
NOT_LEGACY = "model = dict(voxel_encoder=dict(type='PillarFeatureNet', legacy=False))"


@pytest.fixture(scope="module")
def foreign() -> PointPillars:
    network = PointPillars(12, NETWORK.block_channels, NETWORK.block_convs, 8, len(SPEC.classes))
    assert isinstance(random_weights(network), PointPillars)
    return network


def imported(foreign: PointPillars, folder: Path, **meta: Any) -> Checkpoint:
    weights = read_foreign(write_mmdetection3d(folder / "theirs.pth", foreign.state_dict(), **meta))
    assert published_config(weights) == "mmdetection3d_pointpillars_kitti"
    assert write_imported(weights, CONFIG, folder / "ours.ckpt") == len(foreign.state_dict())
    return load_checkpoint(folder / "ours.ckpt")


def padded(pillars: Pillars, *, legacy: bool) -> Tensor:
    """Their features (P, slots, 10) of kept points."""
    points = np.zeros((len(pillars.cells), SLOTS, 4), np.float32)
    for pillar in range(len(pillars.cells)):
        own = pillars.features[pillars.pillar_index == pillar, :4]
        points[pillar, : len(own)] = own
    rows, columns = np.divmod(pillars.cells, GRID.nx)
    centers = [4.8 + (columns + 0.5) * 0.32, -6.4 + (rows + 0.5) * 0.32, np.full(len(rows), (1.5 - 3.0) / 2)]
    counts = torch.from_numpy(pillars.point_counts)
    return pillar_features(
        torch.from_numpy(points), counts, torch.from_numpy(np.stack(centers, axis=1)).float(), legacy=legacy
    )


@pytest.mark.parametrize("legacy", [True, False])
def test_every_part_gives_what_theirs_gives(foreign: PointPillars, tmp_path: Path, legacy: bool) -> None:
    checkpoint = imported(foreign, tmp_path, **({} if legacy else {"cfg": NOT_LEGACY}))
    detector, pillars = checkpoint.detector, SPEC.pillarize(SCANS[0])
    assert isinstance(detector, PillarDetector) and checkpoint.steps == 37120
    full = pillars.point_counts == SLOTS
    assert full.any() and not full.all(), "pillars with empty slots and without"
    batch = batch_pillars([pillars])
    with torch.inference_mode():
        theirs = foreign.voxel_encoder.pfn_layers[0](padded(pillars, legacy=legacy))
        ours = detector.encode(batch.features, batch.pillar_index, batch.point_counts)
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
        canvas = torch.zeros(GRID.ny * GRID.nx, 12)
        canvas[torch.from_numpy(pillars.cells)] = theirs
        features = foreign.neck(foreign.backbone(canvas.T.reshape(1, 12, GRID.ny, GRID.nx)))
        torch.testing.assert_close(detector.neck(detector.scatter(ours, batch.cells, batch.frame_cells)), features)
        for name, ours_map, their_map in zip(
            HeadMaps._fields, detector(batch), foreign.bbox_head(features), strict=True
        ):
            torch.testing.assert_close(ours_map, their_map, atol=1e-4, rtol=1e-4, msg=name)


def limit_period(value: Tensor, offset: float, period: float) -> Tensor:
    return value - torch.floor(value / period + offset) * period


def their_boxes(maps: list[Tensor], places: Callable[[int, float, float], Tensor], offset: float) -> list[Tensor]:
    """Boxes (N, 7) with the bottom's center in third place, and scores (N, classes), of maps (channels, H, W).

    Published sizes and bottoms of the anchors of pedestrians, cyclists and cars.
    """
    scores, residuals, directions = (part.permute(1, 2, 0) for part in maps)
    height, width, _ = scores.shape
    sizes = torch.tensor([[0.8, 0.6, 1.73], [1.76, 0.6, 1.73], [3.9, 1.6, 1.56]])
    anchors = torch.zeros(height, width, 3, 2, 7)
    anchors[..., 0] = places(width, 4.8, 25.28)[None, :, None, None]
    anchors[..., 1] = places(height, -6.4, 8.96)[:, None, None, None]
    anchors[..., 2] = torch.tensor([-0.6, -0.6, -1.78])[:, None]
    anchors[..., 3:6] = sizes[:, None]
    anchors[..., 6] = torch.tensor([0, 1.57])
    xa, ya, za, dxa, dya, dza, ra = anchors.reshape(-1, 7).split(1, dim=1)
    xt, yt, zt, dxt, dyt, dzt, rt = residuals.reshape(-1, 7).split(1, dim=1)
    diagonal = torch.sqrt(dxa**2 + dya**2)
    dz = torch.exp(dzt) * dza
    z = zt * dza + za + dza / 2 - dz / 2
    yaw = limit_period(rt + ra - offset, 0, math.pi) + offset
    yaw = yaw + math.pi * directions.reshape(-1, 2).argmax(dim=1, keepdim=True)
    boxes = [xt * diagonal + xa, yt * diagonal + ya, z, torch.exp(dxt) * dxa, torch.exp(dyt) * dya, dz, yaw]
    return [torch.cat(boxes, dim=1), scores.reshape(-1, 3).sigmoid()]


def centers(count: int, low: float, high: float) -> Tensor:
    """Where AlignedAnchor3DRangeGenerator has anchors."""
    edges = torch.linspace(low, high, count + 1)
    return edges[:-1] + (edges[1] - edges[0]) / 2


def test_boxes_are_decoded_as_theirs() -> None:
    height, width = GRID.head_shape
    rng = np.random.default_rng(0)
    maps = HeadMaps(*(rng.normal(0, 0.5, (6 * size, height, width)).astype(np.float32) for size in (3, 7, 2)))
    boxes, scores = their_boxes([torch.from_numpy(part) for part in maps], centers, -math.pi / 2)
    best, labels = scores.max(dim=1)
    chosen = torch.argsort(-best)[:30]
    post = dataclasses.replace(SPEC.post, nms_iou=1.0, max_detections=1000, candidates=1000)
    threshold = float((best[chosen[-1]] + best[torch.argsort(-best)[30]]) / 2)
    found = dataclasses.replace(SPEC, post=post).with_score_threshold(threshold).decode(maps)
    assert len(found) == 30 and set(found.names) == {"Pedestrian", "Cyclist", "Car"}
    np.testing.assert_allclose(found.scores, best[chosen], atol=1e-6)
    np.testing.assert_array_equal(found.labels, labels[chosen])
    theirs = boxes[chosen].double().numpy()
    theirs[:, 2] += theirs[:, 5] / 2  # their boxes stand on their third coordinate
    np.testing.assert_allclose(found.boxes[:, :6], theirs[:, :6], atol=1e-4)
    turned = np.exp(1j * found.boxes[:, 6]) / np.exp(1j * theirs[:, 6])
    np.testing.assert_allclose(turned, 1, atol=2e-3)  # turned anchors: 1.57 and half of pi
    yaws = np.abs(theirs[:, 6])
    assert ((yaws > 0.3) & (np.abs(yaws - np.pi) > 0.3)).any(), "where bins from 45 degrees on would turn boxes round"


def test_it_runs_as_a_bundle_with_its_direction_bins(foreign: PointPillars, tmp_path: Path) -> None:
    checkpoint = imported(foreign, tmp_path)
    bundle = export_pillar_bundle(checkpoint, tmp_path / "bundle", SCANS)
    assert bundle.spec.direction_offset_rad == -math.pi / 2
    assert_same_detector(checkpoint, tmp_path / "bundle", tmp_path)
    detections = Detector(tmp_path / "bundle")(SCANS[0])
    with torch.inference_mode():
        assert isinstance(checkpoint.detector, PillarDetector)
        maps = [part[0] for part in checkpoint.detector(batch_pillars([SPEC.pillarize(SCANS[0])]))]
    boxes = their_boxes(maps, centers, -math.pi / 2)[0].numpy()
    assert len(detections) > 5
    for box in detections.boxes:
        nearest = np.abs(boxes[:, [0, 1, 3, 4, 5]] - box[[0, 1, 3, 4, 5]]).sum(axis=1).argmin()
        assert math.cos(box[6] - boxes[nearest, 6]) > 0.999


def test_the_published_models_have_their_published_sizes(tmp_path: Path) -> None:
    pillars = PointPillars(64, (64, 128, 256), (3, 5, 5), 128, 3)
    model = load_config("mmdetection3d_pv_rcnn_kitti").model
    assert isinstance(model, PvRcnnModel)
    channels = {"points": 1, "conv1": 16, "conv2": 32, "conv3": 64, "conv4": 64}
    for network, name, parameters in (
        (pillars, "mmdetection3d_pointpillars_kitti", 4_834_888),
        (foreign_pv_rcnn(model, channels), "mmdetection3d_pv_rcnn_kitti", 13_115_697),
    ):
        assert sum(weight.numel() for weight in network.parameters()) == parameters
        state = openpcdet_pv_rcnn.in_layout(network.state_dict(), "2.x", "middle_encoder")
        weights = read_foreign(write_mmdetection3d(tmp_path / "theirs.pth", state))
        assert published_config(weights) == name
        write_imported(weights, load_config(name), tmp_path / f"{name}.ckpt")
        assert load_checkpoint(tmp_path / f"{name}.ckpt").config == load_config(name)


def foreign_pv_rcnn(model: PvRcnnModel, channels: dict[str, int]) -> PvRcnn:
    network, settings = model.network, model.settings
    balls = [
        (channels[each.source], len(each.radii_m), widths)
        for each, widths in zip(settings.sources, network.source_widths, strict=True)
    ]
    neck = network.block_channels, network.block_convs, network.upsample_channels
    grid = settings.grid_size, len(settings.grid_radii_m), network.grid_widths, network.hidden
    return PvRcnn(network.voxel_channels, neck, 3, balls, network.keypoint_channels, network.weighting_channels, grid)


def test_every_part_of_pv_rcnn_gives_what_theirs_gives(tmp_path: Path) -> None:
    theirs = foreign_pv_rcnn(openpcdet_pv_rcnn.MODEL, openpcdet_pv_rcnn.CHANNELS)
    random_weights(theirs)
    state = openpcdet_pv_rcnn.in_layout(theirs.state_dict(), "1.x", "middle_encoder")
    weights = read_foreign(write_mmdetection3d(tmp_path / "theirs.pth", state, dataset_meta={}))
    write_imported(weights, openpcdet_pv_rcnn.CONFIG, tmp_path / "ours.ckpt")
    detector = load_checkpoint(tmp_path / "ours.ckpt").detector
    assert isinstance(detector, PvRcnnDetector)
    encoder, points, roi = theirs.middle_encoder, theirs.points_encoder, theirs.roi_head
    stages = [getattr(encoder.encoder_layers, f"encoder_layer{number}") for number in range(1, 5)]

    def convolved(layers: torch.nn.Module) -> Callable[[Tensor], Tensor]:
        return lambda rows: layers(rows[..., None, None])[..., 0, 0]

    head = roi.bbox_head
    parts = Parts(
        [[encoder.conv_input, *stages[0]], *map(list, stages[1:]), [encoder.conv_out]],
        lambda seen: theirs.neck(theirs.backbone(seen)),
        theirs.rpn_head,
        [list(layer.mlps) for layer in (points.rawpoints_sa_layer, *points.voxel_sa_layers)],
        convolved(points.point_feature_fusion_layer),
        roi.semantic_head.seg_cls_layer,
        list(roi.bbox_roi_extractor.roi_grid_pool_layer.mlps),
        convolved(head.shared_fc_layer),
        convolved(head.cls_layer),
        convolved(head.reg_layer),
    )
    assert_same_parts(parts, detector.network)


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
