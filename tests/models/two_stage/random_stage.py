"""A first stage without weights: its maps are noise that depends on the scan."""

import zlib

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.ops.two_stage.first_stage import FirstStageOutputs, FirstStageSettings, KeypointSettings
from tests.helpers.scenes import SPEC

SETTINGS = FirstStageSettings(keypoints=KeypointSettings(count=64))
CHANNELS = 5


class RandomStage:
    """See `ops.two_stage.first_stage.FirstStage`."""

    def __init__(self, identity: str = "noise", spec: DetectorSpec = SPEC) -> None:
        self.identity, self.spec = identity, spec
        self.calls = 0

    def __call__(self, points: NDArray[np.float32]) -> FirstStageOutputs:
        self.calls += 1
        rng = np.random.default_rng(zlib.crc32(points.tobytes()))
        height, width, anchors, _ = SPEC.anchors.shape
        means = ((1, -3.5), (7, 0.0), (2, 0.0))
        maps = (rng.normal(mean, 0.4, (channels * anchors, height, width)) for channels, mean in means)
        neck = rng.normal(size=(height, width, CHANNELS)).astype(np.float32)
        return FirstStageOutputs(HeadMaps(*(part.astype(np.float32) for part in maps)), neck)
