"""Checkpoints small enough to be exported again and again, and scans for them."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from asca_pillars.config.pillar import CpaReading, NetworkConfig, PillarModel
from asca_pillars.config.tree import Config
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.pillar.network import PillarDetector, build_pillar_detector
from asca_pillars.ops.pillar.spec import PillarSpec
from tests.helpers.scenes import SPEC, make_scene

NETWORK = NetworkConfig(pillar_channels=16, block_channels=(16, 24, 32), block_convs=(1, 1, 1), upsample_channels=16)
SCANS = [make_scene(seed)[0] for seed in range(8)]
CALIBRATION = [make_scene(seed)[0] for seed in range(100, 108)]
NOTHING = np.empty((0, 4), np.float32)
ONE_POINT = np.array([[10.0, 0.5, -1.0, 0.3]], np.float32)


def tiny_checkpoint(cpa: CpaReading, spec: PillarSpec = SPEC, **network: Any) -> Checkpoint:
    """Its weights are those of `tiny_detector`."""
    model = _tiny_model(cpa, spec, **network)
    return Checkpoint(Config(name="tiny", model=model), _with_random_weights(model), 0)


def sparse_checkpoint(rule: str) -> Checkpoint:
    spec = SPEC.with_score_threshold(0.02)  # random weights are never sure of anything
    return tiny_checkpoint("channel", spec, neck="sparse", active_cells=rule)


READINGS: tuple[CpaReading, ...] = ("none", "paper", "channel", "point", "linear")
POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled")).with_score_threshold(0.02)
CHECKPOINTS: dict[str, Callable[[], Checkpoint]] = {
    **{cpa: partial(tiny_checkpoint, cpa) for cpa in READINGS},
    **{rule: partial(sparse_checkpoint, rule) for rule in ("sub", "fine")},
    "pooled": partial(tiny_checkpoint, "channel", POOLED),
    "pooled_sparse": partial(tiny_checkpoint, "channel", POOLED, neck="sparse"),
}
"""One for each reading of the attention, rule of active cells and map."""


def tiny_detector(cpa: CpaReading, spec: PillarSpec = SPEC, **network: Any) -> PillarDetector:
    return _with_random_weights(_tiny_model(cpa, spec, **network))


def _tiny_model(cpa: CpaReading, spec: PillarSpec, **network: Any) -> PillarModel:
    return PillarModel(spec=spec, network=dataclasses.replace(NETWORK, cpa=cpa, **network))


def _with_random_weights(model: PillarModel) -> PillarDetector:
    """Fresh random weights, with statistics and scores that differ from place to place."""
    torch.manual_seed(1)
    detector = build_pillar_detector(model)
    with torch.no_grad():
        for name, buffer in detector.named_buffers():
            if name.endswith("running_mean"):
                buffer.normal_(0, 0.1)
            elif name.endswith("running_var"):
                buffer.uniform_(0.2, 1.0)
        for head in (detector.head.scores, detector.head.boxes, detector.head.directions):
            head.weight.normal_(0, 0.3)
    return detector.eval()
