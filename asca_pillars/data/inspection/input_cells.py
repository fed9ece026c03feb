"""What a family of detectors sorts points into, and the keys of its configuration that say how."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec

InspectedSpec: TypeAlias = PillarSpec | VoxelSpec
"""Of the families that are inspected."""


@dataclass(frozen=True)
class InputCells:
    """Pillars or voxels.

    Attributes:
        name: of one cell.
        of_points: finite points (N, >=3), metres, LiDAR frame -> flat index of each one's cell (N,), -1 outside.
        max_points: points of a cell that the network sees.
        max_points_key: where the configuration says so.
        max_cells: of a scan; None without a limit.
        closer_anchors: how anchors come closer to each other, as advice.
    """

    name: str
    of_points: Callable[[NDArray[np.floating[Any]]], NDArray[np.int64]]
    max_points: int
    max_points_key: str
    max_cells: int | None
    closer_anchors: str


def input_cells(spec: InspectedSpec) -> InputCells:
    """Of this detector."""
    if isinstance(spec, PillarSpec):
        return InputCells(
            name="pillar",
            of_points=spec.grid.cells,
            max_points=spec.limits.max_points,
            max_points_key="model.spec.limits.max_points",
            max_cells=spec.limits.max_pillars,
            closer_anchors="make model.spec.grid.v_max_m and v_y_m smaller",
        )
    finer = "make model.spec.grid.size_m smaller along x and y"
    return InputCells(
        name="voxel",
        of_points=spec.grid.cells,
        max_points=spec.grid.max_points,
        max_points_key="model.spec.grid.max_points",
        max_cells=None,
        closer_anchors=f"set model.spec.last_stride=1, or {finer}" if spec.last_stride > 1 else finer,
    )
