"""The pooled map in PyTorch: against the runtime's pooling, frames apart, gradients through the maximum."""

import dataclasses
from typing import Literal

import numpy as np
import pytest
import torch

from asca_pillars.config.pillar import NetworkConfig, PillarModel
from asca_pillars.models.pillar.network import PillarDetector, build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.pillar.grid import pool_pillars
from tests.helpers.scenes import SPEC, make_scene

POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled"))
NETWORK = NetworkConfig(pillar_channels=8, block_channels=(8, 12, 16), block_convs=(1, 1, 1), upsample_channels=8)
EMPTY = np.empty((0, 4), np.float32)


def make_detector(neck: Literal["dense", "sparse"]) -> PillarDetector:
    torch.manual_seed(0)
    return build_pillar_detector(PillarModel(spec=POOLED, network=dataclasses.replace(NETWORK, neck=neck))).eval()


@pytest.mark.parametrize("neck", ["dense", "sparse"])
def test_frames_are_pooled_as_the_runtime_does_and_stay_apart(neck: Literal["dense", "sparse"]) -> None:
    detector = make_detector(neck)
    frames = [POOLED.pillarize(points) for points in (make_scene(0)[0], EMPTY, make_scene(1)[0])]
    placements = [detector.preparation.place(frame) for frame in frames]
    batch = batch_pillars(frames, placements)
    with torch.inference_mode():
        encoded = detector.encode(batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars)
        features, cells, frame_cells = detector.pool(encoded, batch)
    assert encoded.min() < 0 and sum(frame_cells) == len(cells) and frame_cells[1] == 0
    parts = encoded.split(list(batch.frame_pillars))
    for frame, own, found, where in zip(
        frames, parts, features.split(list(frame_cells)), cells.split(list(frame_cells)), strict=True
    ):
        pooled, occupied = pool_pillars(own.numpy(), frame.cells, POOLED.grid)
        np.testing.assert_array_equal(found.numpy(), pooled)
        np.testing.assert_array_equal(where.numpy(), occupied)
    with torch.inference_mode():
        together = detector(batch).scores
        alone = detector(batch_pillars(frames[2:], placements[2:])).scores
    torch.testing.assert_close(together[-len(alone) :], alone, rtol=0, atol=1e-5)


def test_gradients_reach_every_pillar_that_is_largest_somewhere() -> None:
    detector = make_detector("sparse").train()
    frame = POOLED.pillarize(make_scene(0)[0])
    batch = batch_pillars([frame], [detector.preparation.place(frame)])
    detector(batch).scores.square().sum().backward()
    gradient = detector.encode.linear.weight.grad
    assert gradient is not None and torch.isfinite(gradient).all() and gradient.abs().min() > 0
