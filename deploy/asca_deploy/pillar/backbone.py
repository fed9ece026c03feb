"""What the pillar family's second graph is to its pipeline, with a dense neck and with a sparse one."""

from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.two_stage.first_stage import FirstPass

Maps: TypeAlias = HeadMaps[NDArray[np.float32]]


class HeadAnswer(NamedTuple):
    """What the head says of one scan, as `decode` takes it."""

    maps: Maps
    """On the head's map, or in rows of its active cells."""
    cells: NDArray[np.int32] | None
    """(M,) flat index of the head cell of each row; None of maps."""


class PillarBackbone(Protocol):
    """Neck and head. What belongs to one scan travels from `place` to `run`, so that several threads may call them."""

    @property
    def stage(self) -> str:
        """What `place` is called in reports."""

    def place(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> Any:
        """Pillar features (P, C), in the bundle's type, and flat indices (P,) of their cells -> the graph's input."""

    def run(self, placed: Any) -> HeadAnswer:
        """Run the graph; each placed scan may be given once."""

    def infer_with_neck(self, placed: Any) -> FirstPass:
        """As `run`, and the head's input; for graphs that a second stage follows."""
