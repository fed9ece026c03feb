"""Shifted keypoints against the equations keypoint by keypoint, and what they learn through."""

import dataclasses

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import ConfigError
from asca_pillars.models.pv_rcnn.keypoints import AuthorsDeformation, PaperDeformation, Surroundings
from asca_pillars.ops.pv_rcnn.prepare import Deform, SourceBalls, VoxelSetSettings
from tests.models.pv_rcnn.tiny_pv_rcnn import SETTINGS, batch, frame, tiny_detector


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


def test_balls_are_around_the_shifted_places() -> None:
    detector = tiny_detector(settings=dataclasses.replace(SETTINGS, deform="authors")).eval()
    for weight in detector.network.deform.parameters():
        torch.nn.init.normal_(weight)
    together = batch(detector, frame(0), frame(1)).scans
    alone = [batch(detector, each).scans for each in (frame(0), frame(1))]
    described = []
    with torch.inference_mode():
        for scans in (together, *alone):
            first = detector.network.propose(scans)
            described.append(detector.network.encode_keypoints(scans, first.levels, first.canvas)[0])
    torch.testing.assert_close(described[0], torch.cat(described[1:]), atol=1e-4, rtol=1e-3)


def test_settings_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="add a level to sources"):
        VoxelSetSettings(sources=(SourceBalls("points", (0.4,), (4,)),), deform="paper")
