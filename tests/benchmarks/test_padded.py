"""Pillars padded to one number of points, as others compute them, are the same network."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.pillar import CpaReading, PillarModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from benchmarks.padded import PaddedDetector
from tests.helpers.scenes import make_scene
from tests.helpers.tiny_run import CONFIG


def network(cpa: CpaReading) -> tuple:
    """A small network whose normalization has seen a scan, as `benchmarks.eager.random_weights` does it."""
    torch.manual_seed(1)
    assert isinstance(CONFIG.model, PillarModel)
    model = replace(CONFIG.model, network=replace(CONFIG.model.network, cpa=cpa))
    detector, spec = build_pillar_detector(model).train(), model.spec
    for module in detector.modules():
        if isinstance(module, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            module.momentum = 1.0
            torch.nn.init.normal_(module.bias, std=0.5)  # or padding would be neutral without a mask
    with torch.no_grad():
        detector(batch_pillars([spec.pillarize(make_scene(0)[0])]))
    return detector.eval(), spec


@pytest.mark.parametrize("cpa", ["channel", "paper", "none", "linear"])
@pytest.mark.parametrize(("all_pillars", "channels_last"), [(True, False), (False, True)])
def test_padded_pillars_are_the_same_network(cpa: CpaReading, all_pillars: bool, channels_last: bool) -> None:
    detector, spec = network(cpa)
    points = make_scene(3)[0]
    with torch.inference_mode():
        expected: HeadMaps = detector(batch_pillars([spec.pillarize(points)]))
    found = PaddedDetector(detector, spec, all_pillars, channels_last).head_maps(points)
    for ours, theirs in zip(expected, found, strict=True):
        assert theirs.std() > 1e-4  # the maps say something of the points
        np.testing.assert_allclose(ours[0].numpy(), theirs.numpy(), atol=1e-4)


def test_attention_among_points_is_refused() -> None:
    detector, spec = network("point")
    with pytest.raises(ConfigError, match="channel, paper or none"):
        PaddedDetector(detector, spec)
