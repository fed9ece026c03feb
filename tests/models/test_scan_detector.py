"""A checkpoint's network behind the interface of the runtime."""

import numpy as np
import torch

from asca_pillars.config.pillar import PillarModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.models.scan_detector import ScanDetector
from tests.helpers.scenes import make_scene
from tests.helpers.tiny_run import CONFIG


def test_scans_one_by_one_are_what_a_batch_of_them_gives() -> None:
    """And the second scan does not inherit the first."""
    torch.manual_seed(3)
    assert isinstance(CONFIG.model, PillarModel)
    network = build_pillar_detector(CONFIG.model).eval()
    spec = CONFIG.model.spec.with_score_threshold(0.001)
    detect = ScanDetector(network, spec)
    scans = [make_scene(seed)[0] for seed in (1, 2)]
    with torch.inference_mode():
        maps = network(batch_pillars([spec.pillarize(points) for points in scans]))
    for index in (0, 1, 0):
        expected = spec.decode(HeadMaps(*(part[index].numpy() for part in maps)))
        found = detect(scans[index])
        assert len(found) == len(expected) > 0 and found.names == expected.names
        np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-4)
        np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    assert len(ScanDetector(network, CONFIG.model.spec)(np.empty((0, 4), np.float32))) == 0
