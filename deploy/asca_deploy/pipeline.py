"""Interface between `Detector` and the families of detectors."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.detections import Detections, ScanCounts

StageTimes: TypeAlias = list[tuple[str, float]]
"""A scan's stages in the order in which they ended: name, and `time.perf_counter()` at the end. A stage lasts from the
end before it; a name may come twice."""


class Prepared(Protocol):
    """A scan's input for the slowest network."""

    @property
    def counts(self) -> ScanCounts:
        """Counts of the scan's points."""


P = TypeVar("P", bound=Prepared)
R = TypeVar("R")


class Pipeline(Protocol[P, R]):
    """Interface of a family's pipeline: three parts that `Detector.stream` runs concurrently on different scans.

    A scan's state is in arguments and results alone, so that several threads may use one pipeline. Each part appends
    its finished stages to `stage_times`.
    """

    spec: Any
    """Spec of the bundle; may be replaced by one with other score thresholds."""

    @property
    def stages(self) -> Sequence[str]:
        """Names of the stages, in order."""

    @property
    def network_stages(self) -> Sequence[str]:
        """Names of the stages that run a graph."""

    def prepare(self, points: NDArray[np.float32], stage_times: StageTimes) -> P:
        """Prepare the slowest network's input: (N, 4) finite x, y, z in metres, LiDAR frame, reflectance 0..1."""

    def infer(self, prepared: P, stage_times: StageTimes) -> R:
        """Run the slowest network; each prepared scan may be given once."""

    def finish(self, raw: R, stage_times: StageTimes) -> Detections:
        """Decode the network's output into boxes."""
