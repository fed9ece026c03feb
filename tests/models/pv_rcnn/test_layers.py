"""The network and the training of both stages: sizes, gradients, batches, a frame learnt by heart; dual attention.

Adjusted features, their scales and shifted keypoints against the equations, and what they learn through.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import load_config
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.proposals import AnchorProposals
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.models.pv_rcnn.layers import (
    AdaptiveScales,
    Adjustment,
    AuthorsDeformation,
    DualAttention,
    PaperDeformation,
    Surroundings,
    build_pv_rcnn,
)
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from asca_pillars.models.pv_rcnn.preparation import LabeledVoxels
from asca_pillars.ops.points.neighbors import PointScale, point_scales, three_nearest
from asca_pillars.ops.points.sampling import farthest_points
from asca_pillars.ops.pv_rcnn.prepare import Deform, SourceBalls, VoxelSetSettings
from tests.models.pv_rcnn.tiny_pv_rcnn import EVERYTHING, MODEL, SETTINGS, SPEC, VARIANTS, batch, frame, tiny_detector
from tests.ops.points.clouds import cloud

EVERY_ANCHOR = AnchorProposals(candidates=3000, nms_iou=0.95, count=3000)


def on_anchors() -> LabeledFrame:
    """A frame whose boxes are anchors, so that an untrained first stage proposes them."""
    boxes = SPEC.anchors[4, [5, 12, 20], [0, 2, 4]].copy()
    return dataclasses.replace(frame(0), boxes=boxes, labels=np.array([0, 1, 2]))


def seeing_detector(**changes: Any) -> PvRcnnDetector:
    """In evaluation mode, with maps that differ from scan to scan: an untrained network's are the same everywhere."""
    detector = tiny_detector(**changes).train()
    for module in detector.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            module.momentum = 1.0
    with torch.no_grad():
        for part in detector.network.head.parameters():
            part.normal_(0, 0.02)
        for part in detector.network.deform.parameters():
            part.normal_()
        detector.predict(batch(detector, frame(2), frame(3)))
    return detector.eval()


def gradients(detector: PvRcnnDetector, inputs: LabeledVoxels) -> dict[str, torch.Tensor]:
    detector.train().zero_grad()
    torch.manual_seed(3)
    terms = detector.loss(detector.predict(inputs), inputs)
    torch.stack(list(terms.values())).sum().backward()
    assert all(torch.isfinite(term) for term in terms.values())
    return {name: weight.grad.clone() for name, weight in detector.named_parameters() if weight.grad is not None}


def test_the_published_model_has_its_published_size() -> None:
    model = load_config("pv_rcnn_kitti").model
    assert isinstance(model, PvRcnnModel)
    assert dataclasses.replace(model, spec=PvRcnnModel().spec) == PvRcnnModel(), "the defaults are the published sizes"
    network = build_pv_rcnn(model)
    counts = {name: sum(weight.numel() for weight in part.parameters()) for name, part in network.named_children()}
    assert not counts.pop("deform"), "nothing is deformed"
    assert counts == {
        "voxels": 711_872,
        "neck": 4_576_768,
        "head": 36_936,
        "encode": 41_120 + 82_176 + 230_657,
        "refine": 25_472 + 7_144_448 + 132_353 + 133_895,
    }
    assert sum(counts.values()) == 13_115_697


@pytest.mark.parametrize(
    ("order", "changes"),
    [((0, 1, None), {}), ((None, 1, 0), EVERYTHING), ((0, 1), VARIANTS["deformed as the authors"])],
)
def test_a_batch_is_its_frames_of_which_one_may_be_empty(
    order: tuple[int | None, ...], changes: dict[str, Any]
) -> None:
    detector = seeing_detector(**changes)
    empty = LabeledFrame("", np.empty((0, 4), np.float32), np.empty((0, 7), np.float32), np.empty(0, np.int64))
    frames = [empty if seed is None else frame(seed) for seed in order]
    with torch.inference_mode():
        together = detector.predict(batch(detector, *frames))
        alone = [detector.predict(batch(detector, each)) for each in frames]
    for number, one in enumerate(alone):
        for joined, own in zip(together.maps, one.maps, strict=True):
            torch.testing.assert_close(joined[number], own[0], atol=1e-5, rtol=1e-4)
        found, expected = together.proposals[number], one.proposals[0]
        assert len(found) == len(expected) and (len(found) > 0) == (order[number] is not None)
        np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-4)
        np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
        np.testing.assert_array_equal(found.labels, expected.labels)
    confidence = torch.cat([one.refinements.confidence for one in alone])
    torch.testing.assert_close(together.refinements.confidence, confidence, atol=1e-4, rtol=1e-3)
    assert gradients(detector, batch(detector, *frames))


@pytest.mark.parametrize("changes", VARIANTS.values(), ids=VARIANTS)
def test_every_weight_learns_and_the_same_each_time(changes: dict[str, Any]) -> None:
    detector = tiny_detector(training_proposals=EVERY_ANCHOR, **changes)
    with torch.no_grad():
        for weight in detector.network.head.parameters():
            weight.mul_(0.1)  # proposals stay at their anchors, some of which are objects
    inputs = batch(detector, on_anchors(), frame(1))
    first, again = gradients(detector, inputs), gradients(detector, inputs)
    assert set(first) == {name for name, _ in detector.named_parameters()}
    assert not [name for name, gradient in first.items() if not gradient.any()]
    assert all(torch.equal(gradient, again[name]) for name, gradient in first.items())


def test_a_first_stage_that_is_not_trained_stays_as_it_is() -> None:
    detector = tiny_detector(training_proposals=EVERY_ANCHOR, train_first_stage=False)
    before = {name: array.clone() for name, array in detector.state_dict().items()}
    inputs = batch(detector, on_anchors(), frame(1))
    optimizer = torch.optim.Adam(detector.parameters(), lr=1e-2, weight_decay=0.1, decoupled_weight_decay=True)
    detector.train()
    terms = detector.loss(detector.predict(inputs), inputs)
    assert set(terms) == {"confidence", "residuals", "corners", "keypoints"}
    torch.stack(list(terms.values())).sum().backward()
    optimizer.step()
    first = ("network.voxels.", "network.neck.", "network.head.")
    changed = {name for name, array in detector.state_dict().items() if not torch.equal(array, before[name])}
    assert changed and not [name for name in changed if name.startswith(first)]


def test_training_draws_from_the_step_s_seed() -> None:
    detector = tiny_detector().train()
    inputs = batch(detector, frame(0))
    drawn = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        drawn.append(detector.predict(inputs).proposals[0].boxes)
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    assert len(drawn[0]) == MODEL.rois


@pytest.mark.parametrize("points", [0, 1])
def test_a_batch_without_voxels_is_learnt_from_and_changes_nothing(points: int) -> None:
    empty = dataclasses.replace(
        frame(0), points=frame(0).points[:points], boxes=np.empty((0, 7), np.float32), labels=np.empty(0, np.int64)
    )
    detector = tiny_detector()
    inputs = batch(detector, empty)
    before = {name: value.clone() for name, value in detector.named_buffers()}
    assert not any(gradient.any() for gradient in gradients(detector, inputs).values())
    for name, value in detector.named_buffers():
        assert torch.equal(value, before[name]), name
    with torch.inference_mode():
        found = detector.eval().detect(detector.predict(inputs), SPEC.with_score_threshold(0.0))
    assert (len(found[0]) == 0) == (points == 0)


def test_lower_precision_leaves_positions_alone() -> None:
    detector = tiny_detector().eval()
    inputs = batch(detector, frame(0))
    with torch.inference_mode():
        exact = detector.predict(inputs)
        with torch.autocast("cpu", torch.bfloat16):
            found = detector.predict(inputs)
    assert found.refinements.confidence.dtype == torch.float32
    torch.testing.assert_close(
        found.refinements.keypoint_logits, exact.refinements.keypoint_logits, atol=0.05, rtol=0.05
    )


def test_learns_one_frame_by_heart() -> None:
    detector, expected = tiny_detector(), frame(5)
    for module in detector.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            module.momentum = 0.1  # so that a hundred steps are enough for its statistics
    inputs = batch(detector, expected)
    optimizer = torch.optim.Adam(detector.parameters())
    for step in range(160):
        if step >= 40 and step % 20 == 0 and not _mistakes(detector, inputs, expected):
            break
        torch.manual_seed(step)
        optimizer.param_groups[0]["lr"] = 6e-3 * (1 - step / 160)
        loss = torch.stack(list(detector.loss(detector.predict(inputs), inputs).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert not _mistakes(detector, inputs, expected)


def _mistakes(detector: PvRcnnDetector, inputs: LabeledVoxels, expected: LabeledFrame) -> str:
    """How what is found differs from the frame's boxes; empty where each of them is found once, and nothing else."""
    with torch.inference_mode():
        (found,) = detector.eval().detect(detector.predict(inputs), SPEC.with_score_threshold(0.5))
    detector.train()
    if len(found) != len(expected.boxes):
        return f"{len(found)} boxes"
    overlap = iou_3d(found.boxes, expected.boxes)
    best = overlap.argmax(axis=0)
    if set(best) != set(range(len(best))) or overlap.max(axis=0).min() <= 0.85:
        return f"overlaps {overlap.max(axis=0)}"
    return "" if np.array_equal(found.labels[best], expected.labels) else f"labels {found.labels[best]}"


def by_hand(module: DualAttention, features: np.ndarray) -> np.ndarray:
    """Eq. (1)-(4) on one map (C, H, W), with loops over places."""

    def at(layer: torch.nn.Conv2d, value: np.ndarray) -> np.ndarray:
        bias = 0.0 if layer.bias is None else layer.bias.detach().numpy()
        return np.asarray(layer.weight[:, :, 0, 0].detach().numpy() @ value + bias)

    places = [tuple(place) for place in np.ndindex(*features.shape[1:])]
    scores = np.array([at(module.channel_query, features[:, y, x])[0] for y, x in places])
    shares = np.exp(scores - scores.max()) / np.exp(scores - scores.max()).sum()
    pooled = sum(
        share * at(module.channel_value, features[:, y, x]) for share, (y, x) in zip(shares, places, strict=True)
    )
    out, norm = module.channel_out, module.channel_norm
    wide = out.weight.detach().numpy() @ pooled + out.bias.detach().numpy()
    normed = (wide - wide.mean()) / np.sqrt(wide.var() + norm.eps)
    weights = 1 / (1 + np.exp(-(normed * norm.weight.detach().numpy() + norm.bias.detach().numpy())))
    attended = features * weights[:, None, None]
    query = np.mean([at(module.place_query, attended[:, y, x]) for y, x in places], axis=0)
    shares = np.exp(query - query.max()) / np.exp(query - query.max()).sum()
    result = np.empty_like(attended)
    for y, x in places:
        weight = 1 / (1 + np.exp(-(shares @ at(module.place_value, attended[:, y, x]))))
        result[:, y, x] = weight * attended[:, y, x]
    return result


@pytest.mark.parametrize("residual", [True, False])
def test_dual_attention_is_what_the_equations_say(residual: bool) -> None:
    torch.manual_seed(0)
    module = DualAttention(6, residual=residual).double()
    features = torch.randn(2, 6, 3, 4, dtype=torch.float64)
    with torch.inference_mode():
        found = module(features).numpy()
    for one, expected in zip(found, features.numpy(), strict=True):
        attended = by_hand(module, expected)
        np.testing.assert_allclose(one, expected + 0.1 * attended if residual else attended, atol=1e-9)


def random_adjustment(channels: int) -> Adjustment:
    module = Adjustment(channels).double()
    for weight in module.parameters():
        torch.nn.init.normal_(weight, std=0.5)
    return module


def in_double(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array).double() if array.dtype == np.float32 else torch.from_numpy(array)


def impact(module: Adjustment, value: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        return module.out(torch.relu(module.hidden(torch.from_numpy(value)))).numpy()


def test_features_are_adjusted_as_eq_10_says() -> None:
    torch.manual_seed(0)
    module, features = random_adjustment(8), torch.randn(3, 4, 8, dtype=torch.float64)
    counted = torch.tensor([[1, 1, 1, 1], [1, 1, 0, 0], [1, 0, 1, 0]], dtype=torch.float64)
    with torch.inference_mode():
        found = module(features, counted).numpy()
    for group, own, members in zip(features.numpy(), found, counted.numpy().astype(bool), strict=True):
        for i in np.flatnonzero(members):
            expected = (impact(module, group[i]) + 1) * group[i]  # beta_i F_i
            for j in np.flatnonzero(members):
                if j != i:
                    # beta_j (F_j - F_i)
                    expected = expected - impact(module, group[i] - group[j]) * (group[j] - group[i])
            np.testing.assert_allclose(own[i], expected, atol=1e-12)


def test_the_first_keypoints_are_what_sampling_them_again_takes() -> None:
    points = cloud(3, 300, 3.0, coarse=False)
    keypoints = np.ascontiguousarray(points[farthest_points(points, 60), :3])
    finest, middle, coarse = point_scales(points, keypoints, (0.8, 1.6, 3.2), 6)
    np.testing.assert_array_equal(middle.positions, keypoints[farthest_points(keypoints, 15)])
    np.testing.assert_array_equal(coarse.positions, keypoints[farthest_points(keypoints, 4)])
    assert finest.groups.max() < 300 and middle.groups.max() < 60 and coarse.groups.max() < 15
    assert len(finest.nearest) == 0 and middle.nearest.shape == (60, 3) and coarse.nearest.shape == (15, 3)
    for finer, scale in ((finest, middle), (middle, coarse)):
        indices, weights = three_nearest(scale.positions, finer.positions)
        np.testing.assert_array_equal(scale.nearest, indices)
        np.testing.assert_array_equal(scale.nearest_weights, weights)


def test_coarse_features_reach_every_keypoint() -> None:
    torch.manual_seed(0)
    points = cloud(4, 200, 2.0, coarse=False)
    keypoints = np.ascontiguousarray(points[farthest_points(points, 40), :3])
    scales = point_scales(points, keypoints, (0.8, 1.6), 5)
    module = AdaptiveScales(1, (6, 7), 5).double().eval()
    given: Any = [PointScale(*(in_double(part) for part in scale)) for scale in scales]
    with torch.inference_mode():
        found = module(torch.from_numpy(points).double(), given).numpy()
        rows, positions, of_scales = points[:, 3:].astype(np.float64), points[:, :3].astype(np.float64), []
        lifts: Any = module.lift
        for lift, adjust, scale in zip(lifts, module.adjust, scales, strict=True):
            own = []
            for center, group in zip(scale.positions.astype(np.float64), scale.groups, strict=True):
                members = list(dict.fromkeys(group.tolist()))
                pairs = np.concatenate([positions[members] - center, rows[members]], axis=1)
                lifted = torch.relu(lift.norms[0](lift.layers[0](torch.from_numpy(pairs))))
                own.append(adjust(lifted[None], torch.ones(1, len(members)).double())[0].numpy().max(axis=0))
            rows, positions = np.array(own), scale.positions.astype(np.float64)
            of_scales.append(rows)
        coarse = scales[1]
        brought = (of_scales[1][coarse.nearest] * coarse.nearest_weights[:, :, None]).sum(axis=1)
        expected = module.join(torch.from_numpy(np.concatenate([of_scales[0], brought], axis=1))).numpy()
    assert found.shape == (40, 5)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_scales_that_cannot_be() -> None:
    settings = VoxelSetSettings(scale_radii_m=(0.8, 1.6))
    with pytest.raises(ConfigError, match=r"scale_widths has 3 entries: give one for each of the 2 radii"):
        dataclasses.replace(PvRcnnModel(), settings=settings)
    for changes in ({"scale_radii_m": (0.0,)}, {"scale_samples": 1}):
        with pytest.raises(ConfigError, match="scale_radii_m"):
            dataclasses.replace(settings, **changes)
    with pytest.raises(ConfigError, match="vector_cells 8 must lie between 0 and 7"):
        dataclasses.replace(settings, vector_cells=8)


def surroundings() -> Surroundings:
    """Seven voxels, three keypoints, of which the last has nothing around it."""
    rng = np.random.default_rng(0)
    voxels, keypoints = rng.normal(size=(7, 3)), rng.normal(size=(3, 3))
    weights = rng.random((3, 3))
    return Surroundings(
        torch.from_numpy(rng.normal(size=(7, 5))),
        torch.from_numpy(voxels),
        torch.from_numpy(keypoints),
        [torch.tensor([[0, 1], [2, 2], [7, 7]]), torch.tensor([[3, 4, 5], [1, 6, 1], [7, 7, 7]])],
        torch.tensor([[0, 3, 4], [2, 1, 6], [5, 0, 1]]),
        torch.from_numpy(weights / weights.sum(axis=1, keepdims=True)),
    )


def test_the_paper_s_equation() -> None:
    torch.manual_seed(0)
    around, module = surroundings(), PaperDeformation(5).double()
    torch.nn.init.normal_(module.align.weight)
    features, positions, keypoints = (part.numpy() for part in around[:3])
    offset, align = module.offset.weight.detach().numpy(), module.align.weight.detach().numpy()
    assert around.nearest is not None and around.nearest_weights is not None
    with torch.inference_mode():
        (found,) = module(around)
    for i in range(2):
        own = around.nearest_weights[i].numpy() @ features[around.nearest[i].numpy()]
        neighbors = set(around.indices[1][i].tolist())  # one that fills a ball counts once
        terms = [np.outer(offset @ (own - features[j]), keypoints[i] - positions[j]) for j in neighbors]
        shift = np.tanh(align @ np.maximum(np.mean(terms, axis=0), 0).reshape(-1))
        np.testing.assert_allclose(found[i].numpy(), keypoints[i] + shift, atol=1e-12)
    np.testing.assert_array_equal(found[2].numpy(), keypoints[2], "nothing around, no shift")


def test_what_the_authors_code_computes() -> None:
    torch.manual_seed(0)
    around, module = surroundings(), AuthorsDeformation(5).double()
    features, positions, keypoints = (part.numpy() for part in around[:3])
    with torch.inference_mode():
        found = module(around)
    weight = module.offset.weight.detach().numpy()
    for index, places in zip(around.indices, found, strict=True):
        for i in range(2):
            away = [positions[j] - keypoints[i] for j in index[i]]
            moves = [
                np.tanh(weight @ np.concatenate([rel, features[j]])) * rel
                for rel, j in zip(away, index[i], strict=True)
            ]
            np.testing.assert_allclose(places[i].numpy(), keypoints[i] + np.mean(moves, axis=0), atol=1e-12)
        np.testing.assert_array_equal(places[2].numpy(), keypoints[2])


@pytest.mark.parametrize("deform", ["paper", "authors", "authors_frozen"])
def test_places_learn_unless_they_are_frozen(deform: Deform) -> None:
    detector = tiny_detector(settings=dataclasses.replace(SETTINGS, deform=deform)).train()
    inputs = batch(detector, frame(0), frame(1))
    first = detector.network.propose(inputs.scans)
    features, _ = detector.network.encode_keypoints(inputs.scans, first.levels, first.canvas.detach())
    features.square().sum().backward()
    gradients = {name: weight.grad for name, weight in detector.network.deform.named_parameters()}
    of_backbone = detector.network.voxels.get_parameter("down.1.convolution.weight").grad
    if deform == "authors_frozen":
        assert gradients and all(gradient is None for gradient in gradients.values()) and of_backbone is None
        assert not any(weight.requires_grad for weight in detector.network.deform.parameters())
    else:
        assert gradients and all(gradient is not None and gradient.any() for gradient in gradients.values())
        assert of_backbone is not None and of_backbone.any()


def test_a_deformation_without_a_level() -> None:
    with pytest.raises(ConfigError, match="add a level to sources"):
        VoxelSetSettings(sources=(SourceBalls("points", (0.4,), (4,)),), deform="paper")
