"""The sparse neck and head on the vehicle: one graph over active cells alone.

With the tables of a `NeckTableBuilder` it takes the places of the canvas and of the dense backbone: nothing is
scattered, and the head speaks of active head cells only, which `decode` takes as they are.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.graph import Session, Tensor, check_interface
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.tables.neck_tables import LEVELS, NeckTables, table_inputs

FEATURES = "pillar_features"


class SparseBackboneGraph:
    """backbone.onnx of a sparse neck.

    Args:
        path: of the graph, for messages.
        session: that has opened it.
        channels: C, features of one pillar.
        feature_type: of a value of them: float32, or uint8 in the graph's steps.
        anchors_per_cell: A.

    Raises:
        BundleError: the graph's inputs and outputs are not those of a sparse backbone of these sizes.
    """

    def __init__(self, path: Path, session: Session, channels: int, feature_type: str, anchors_per_cell: int) -> None:
        inputs = {FEATURES: Tensor(feature_type, (None, channels))}
        for number in range(LEVELS):
            inputs |= {f"{kind}_{number}": Tensor("int32", (None, 9)) for kind in ("strided", "first", "same")}
            inputs[f"places_{number}"] = Tensor("int32", (None,))
        self._channels = [anchors_per_cell * channels for channels in (1, 7, 2)]
        outputs = zip(HeadMaps._fields, self._channels, strict=True)
        shapes = {name: Tensor("float32", (None, channels)) for name, channels in outputs}
        self._session = check_interface(path, session, inputs, shapes)

    def run(
        self, pillar_features: NDArray[Any], tables: NeckTables[NDArray[np.int32]]
    ) -> HeadMaps[NDArray[np.float32]]:
        """(P, C) and their tables -> scores (M, A), boxes (M, 7A), directions (M, 2A) at M head cells."""
        if not len(tables.head_cells):
            return HeadMaps(*(np.empty((0, channels), np.float32) for channels in self._channels))
        given = {FEATURES: pillar_features, **table_inputs(tables)}
        inputs = {name: given[name] for name in self._session.inputs}  # a graph takes what its layers read
        return HeadMaps(*self._session.run(HeadMaps._fields, inputs))
