"""The sparse neck and head on the vehicle: one graph over active cells alone, tables in place of a pseudo-image."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import NECK, Bundle
from asca_deploy.graph import Session, Tensor, check_interface
from asca_deploy.pillar_backbone import HeadAnswer, neck_output
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.pillars.map_pooling import pool_pillars
from asca_pillars.points.first_stage import FirstPass
from asca_pillars.tables.neck_tables import LEVELS, NeckTableBuilder, NeckTables, table_inputs

FEATURES = "pillar_features"


class PlacedPillars(NamedTuple):
    """What the graph reads of one scan."""

    features: NDArray[Any]
    """(P, C), of a pooled map (cells, C)"""
    tables: NeckTables[NDArray[np.int32]]


class TableBackbone:
    """backbone.onnx of a sparse neck, see `pillar_backbone.PillarBackbone`.

    Tables are built in memory that is kept from scan to scan, as many builders as threads ever built at once; the
    tables themselves belong to their scan.

    Args:
        path: of the graph, for messages.
        session: that has opened it.
        bundle: the manifest.
        neck_channels: of the graph's output NECK, if it has one.

    Raises:
        BundleError: the graph's inputs and outputs are not those of this bundle.
    """

    stage = "tables"

    def __init__(self, path: Path, session: Session, bundle: Bundle, neck_channels: int = 0) -> None:
        self._bundle, self._pools, section = bundle, bundle.spec.grid.pools, bundle.pillar
        inputs = {FEATURES: Tensor(section.canvas.type, (None, section.channels))}
        for number in range(LEVELS):
            inputs |= {f"{kind}_{number}": Tensor("int32", (None, 9)) for kind in ("strided", "first", "same")}
            inputs[f"places_{number}"] = Tensor("int32", (None,))
        anchors = bundle.spec.anchors.shape[2]
        counts = (bundle.spec.scores_per_anchor * anchors, 7 * anchors, 2 * anchors)
        self._channels = dict(zip(HeadMaps._fields, counts, strict=True))
        if neck_channels:
            self._channels[NECK] = neck_channels
        outputs = {name: Tensor("float32", (None, channels)) for name, channels in self._channels.items()}
        if neck_channels:
            outputs[NECK] = neck_output(session, (None, neck_channels))
        self._session = check_interface(path, session, inputs, outputs)
        self._free = [self._new_builder()]

    def place(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> PlacedPillars:
        """Pillar features (P, C) with the tables that their cells, flat indices (P,), make."""
        try:
            builder = self._free.pop()  # atomic, as append is: two threads never get the same one
        except IndexError:
            builder = self._new_builder()
        if self._pools:
            pillar_features, cells = pool_pillars(pillar_features, cells, self._bundle.spec.grid)
        tables = builder.build(cells)
        self._free.append(builder)
        return PlacedPillars(pillar_features, tables)

    def run(self, placed: PlacedPillars) -> HeadAnswer:
        """Scores (M, A), boxes (M, 7A), directions (M, 2A) at M active head cells."""
        return HeadAnswer(HeadMaps(*self._rows(placed, HeadMaps._fields)), placed.tables.head_cells)

    def infer_with_neck(self, placed: PlacedPillars) -> FirstPass:
        """As `run`, and the head's input (M, C), which a second stage reads; for graphs with the output NECK."""
        *maps, neck = self._rows(placed, (*HeadMaps._fields, NECK))
        return FirstPass(HeadMaps(*maps), neck, placed.tables.head_cells)

    def _rows(self, placed: PlacedPillars, names: Sequence[str]) -> list[NDArray[np.float32]]:
        if not len(placed.tables.head_cells):
            return [np.empty((0, self._channels[name]), np.float32) for name in names]
        given = {FEATURES: placed.features, **table_inputs(placed.tables)}
        # A graph takes what its layers read.
        return list(self._session.run(names, {name: given[name] for name in self._session.inputs}))

    def _new_builder(self) -> NeckTableBuilder:
        rule = self._bundle.pillar.active_cells
        assert rule is not None
        return NeckTableBuilder(*self._bundle.spec.grid.map_shape, rule)
