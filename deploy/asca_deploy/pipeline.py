"""What a family of detectors has to bring along to be run by `Detector`."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.frame_report import ScanCounts

Laps: TypeAlias = list[tuple[str, float]]
"""A scan's stages in the order in which they ended: name, and `time.perf_counter()` at the end. A stage lasts from the
end before it; a name may come twice."""


class Prepared(Protocol):
    """A scan on its way into the network."""

    @property
    def counts(self) -> ScanCounts:
        """What became of its points."""


P = TypeVar("P", bound=Prepared)
R = TypeVar("R")


class Pipeline(Protocol[P, R]):
    """The way from points to boxes, in three parts that `Detector.stream` runs at once for different scans.

    What belongs to one scan travels in the arguments and results, so that several threads may be in one pipeline.
    Each part appends the stages that it is through with to `laps`.
    """

    spec: Any
    """The bundle's numbers; the same with other score thresholds may be put in their place."""

    @property
    def stages(self) -> Sequence[str]:
        """Names of the stages, in order."""

    @property
    def network_stages(self) -> Sequence[str]:
        """Those of them that are spent in graphs."""

    def prepare(self, points: NDArray[np.float32], laps: Laps) -> P:
        """(N, 4) finite x, y, z in metres, LiDAR frame, and reflectance 0..1 -> the input of the slowest network."""

    def infer(self, prepared: P, laps: Laps) -> R:
        """Run the slowest network; each prepared scan may be given once."""

    def finish(self, raw: R, laps: Laps) -> Detections:
        """What the network answered -> boxes."""


T = TypeVar("T")


def take_free(free: list[T], make: Callable[[], T]) -> T:
    """One that is free, or a new one; appending it to `free` gives it back."""
    try:
        return free.pop()  # atomic, as append is: two threads never get the same one
    except IndexError:
        return make()


def channels_first(channels_last: Sequence[NDArray[Any]]) -> HeadMaps[NDArray[np.float32]]:
    """Head maps of one scan as a graph gives them, (1, H, W, C) each, as decoding reads them, (C, H, W) each."""
    return HeadMaps(*(maps[0].transpose(2, 0, 1) for maps in channels_last))
