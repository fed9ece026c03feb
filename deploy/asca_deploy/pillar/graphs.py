"""Inputs and outputs of the graphs of a pillar bundle, by name."""

from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import NECK, PillarBundle
from asca_deploy.graph import Interface, Tensor
from asca_pillars.base.errors import ProviderError
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.pillar.neck_rulebooks import LEVELS, SAME, NeckRulebooks
from asca_pillars.ops.two_stage.first_stage import FirstStageOutputs

PILLAR_FEATURES = "pillar_features"
"""Output of encoder.onnx; the backbone of a sparse neck takes it under the same name."""

_NO_SPARSE_NECK = {
    "openvino": "it needs outputs of fixed shapes",
    "tensorrt": "it would build another engine for every number of pillars",
}


def output_channels(bundle: PillarBundle, neck_channels: int = 0) -> dict[str, int]:
    """Return the channels of backbone.onnx's outputs; with `neck_channels` also those of NECK."""
    anchors = bundle.spec.anchors.shape[2]
    counts = (bundle.spec.scores_per_anchor * anchors, 7 * anchors, 2 * anchors)
    channels = dict(zip(HeadMaps._fields, counts, strict=True))
    return {**channels, NECK: neck_channels} if neck_channels else channels


def backbone_interface(bundle: PillarBundle, neck_channels: int = 0, neck_type: str = "float32") -> Interface:
    """Return the interface of backbone.onnx: pseudo-image -> channels-last maps, or for a sparse neck rows -> rows.

    NECK is float32, or the uint8 steps of an 8-bit neck, which refine.onnx scales: `neck_type`.
    """
    section, channels = bundle.pillar, output_channels(bundle, neck_channels)
    types = dict.fromkeys(channels, "float32") | {NECK: neck_type}
    if section.neck == "dense":
        rows, columns = bundle.spec.grid.map_shape
        canvas = Tensor(section.canvas.type, (1, rows + 1, columns + 1, section.channels))
        height, width = bundle.spec.grid.head_shape
        outputs = {name: Tensor(types[name], (1, height, width, count)) for name, count in channels.items()}
        return {"canvas": canvas}, outputs
    inputs = {PILLAR_FEATURES: Tensor(section.canvas.type, (None, section.channels))}
    for level in range(LEVELS):
        inputs |= {f"{kind}_{level}": Tensor("int32", (None, SAME.taps)) for kind in ("strided", "first", "same")}
        inputs[f"places_{level}"] = Tensor("int32", (None,))
    return inputs, {name: Tensor(types[name], (None, count)) for name, count in channels.items()}


def check_neck(bundle: PillarBundle, provider: str) -> None:
    """Raise ProviderError, which says what to choose, if this provider cannot run the bundle's neck."""
    if bundle.pillar.neck == "sparse" and provider in _NO_SPARSE_NECK:
        raise ProviderError(
            f"provider {provider} cannot run the sparse neck of {bundle.name}: {_NO_SPARSE_NECK[provider]}; "
            "choose provider cpu, or a dense neck, as `asca export default --dense-neck` makes it of a pillar detector"
        )


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

    def build_rulebooks(self, cells: NDArray[np.int64]) -> NeckRulebooks[NDArray[np.int32]] | None:
        """Build the rulebooks of flat cell indices (P,), in any thread; None for a dense neck."""

    def place(self, pillar_features: NDArray[Any], cells: NDArray[np.int64], rulebooks: Any = None) -> Any:
        """Place pillar features (P, C), in the bundle's type, at flat cell indices (P,): the graph's input.

        `rulebooks` is the result of `build_rulebooks` for these cells; if it is None, they are built here.
        """

    def run(self, placed: Any) -> HeadOutputs:
        """Run the graph; each placed scan may be given once."""

    def infer_with_neck(self, placed: Any) -> FirstStageOutputs:
        """Run the graph as `run` does, and return the head's input too; for graphs that a second stage follows."""
