"""Interface of the pillar family's backbone graph, with a dense neck and with a sparse one."""

from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.two_stage.first_stage import FirstStageOutputs

Maps: TypeAlias = HeadMaps[NDArray[np.float32]]


class HeadOutputs(NamedTuple):
    """Outputs of the head for one scan, as `decode` takes them."""

    maps: Maps
    """Head maps, or rows of the head's active cells."""
    cells: NDArray[np.int32] | None
    """(M,) flat index of the head cell of each row; None of maps."""


class PillarBackbone(Protocol):
    """Neck and head. What belongs to one scan travels from `place` to `run`, so that several threads may call them."""

    @property
    def stage(self) -> str:
        """Name of the stage `place` in reports."""

    def place(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> Any:
        """Place pillar features (P, C), in the bundle's type, at flat cell indices (P,): the graph's input."""

    def run(self, placed: Any) -> HeadOutputs:
        """Run the graph; each placed scan may be given once."""

    def infer_with_neck(self, placed: Any) -> FirstStageOutputs:
        """Run the graph as `run` does, and return the head's input too; for graphs that a second stage follows."""
