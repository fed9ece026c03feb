"""Adjusted features, their scales and shifted keypoints against the equations, and what they learn through."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.pv_rcnn.keypoints import (
    AdaptiveScales,
    Adjustment,
    AuthorsDeformation,
    PaperDeformation,
    Surroundings,
)
from asca_pillars.ops.points.neighbors import PointScale, point_scales, three_nearest
from asca_pillars.ops.points.sampling import farthest_points
from asca_pillars.ops.pv_rcnn.prepare import Deform, SourceBalls, VoxelSetSettings
from tests.models.pv_rcnn.tiny_pv_rcnn import SETTINGS, batch, frame, tiny_detector
from tests.ops.points.clouds import cloud


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
