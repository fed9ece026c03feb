"""The encoder of a pillar bundle: points of pillars -> one feature vector per pillar (paper section 3.2)."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import ENCODER, PFN, PillarBundle
from asca_deploy.graph import Interface, Session, Tensor, check_interface
from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.pillar.prepare import FEATURES, KERNELS, Pillars

PILLAR_MAXIMA = "pillar_maxima"
"""Output of pfn.onnx and input of the encoder.onnx that follows it."""
WEIGHT, BIAS = "weight", "bias"
"""Outputs of pfn.onnx: the parameters of its layer."""


class Encoder:
    """encoder.onnx on onnxruntime's CPU provider, and the PFN layer before it where that is a graph of its own.

    A compiled loop computes this layer, in about a third of the time that pfn.onnx takes, with the graph's parameters.

    Args:
        folder: of the bundle.
        bundle: its manifest.

    Raises:
        BundleError: a graph cannot be run or does not match the manifest.
    """

    def __init__(self, folder: Path, bundle: PillarBundle) -> None:
        self._bundle = bundle
        self.pfn = _open(folder, bundle, PFN, pfn_interface(bundle)) if PFN in bundle.graphs else None
        """pfn.onnx, or None where encoder.onnx takes the points."""
        self._graph = _open(folder, bundle, ENCODER, encoder_interface(bundle))
        if self.pfn is not None:
            point: dict[str, NDArray[Any]] = {
                "features": np.zeros((1, len(FEATURES)), np.float32),
                "pillar_index": np.zeros(1, np.int64),
                "point_counts": np.ones(1, np.int64),
            }
            self._parameters = self.pfn.run((WEIGHT, BIAS), {name: point[name] for name in self.pfn.inputs})

    def __call__(self, pillars: Pillars) -> NDArray[Any]:
        """Encode features (M, 9) -> pillar features (P, C), of the canvas's type."""
        if not len(pillars.cells):
            return np.empty((0, self._bundle.pillar.channels), self._bundle.pillar.canvas.type)
        inputs = pfn_inputs(self._graph, pillars) if self.pfn is None else {PILLAR_MAXIMA: self.maxima(pillars)}
        return self._graph.run((PILLAR_FEATURES,), inputs)[0]

    def maxima(self, pillars: Pillars) -> NDArray[np.float32]:
        """Compute what pfn.onnx gives: features (M, 9) -> the largest of each channel in each pillar (P, C)."""
        maxima: NDArray[np.float32] = load_kernels(KERNELS).pfn_maxima(
            pillars.features, pillars.point_counts, *self._parameters
        )
        return maxima


def pfn_inputs(graph: Session, pillars: Pillars) -> dict[str, NDArray[Any]]:
    """Return the inputs of a graph that takes the points, those that it declares."""
    return {name: getattr(pillars, name) for name in graph.inputs}


def pfn_interface(bundle: PillarBundle) -> Interface:
    """Return the interface of pfn.onnx: features of M points in P pillars -> maxima of the pillars."""
    channels = bundle.pillar.channels
    outputs = {
        PILLAR_MAXIMA: Tensor("float32", (None, channels)),
        WEIGHT: Tensor("float32", (len(FEATURES), channels)),
        BIAS: Tensor("float32", (channels,)),
    }
    return _point_inputs(), outputs


def encoder_interface(bundle: PillarBundle) -> Interface:
    """Return the interface of encoder.onnx: maxima, or features of M points in P pillars -> features of the pillars."""
    channels = bundle.pillar.channels
    inputs = {PILLAR_MAXIMA: Tensor("float32", (None, channels))} if PFN in bundle.graphs else _point_inputs()
    return inputs, {PILLAR_FEATURES: Tensor(bundle.pillar.canvas.type, (None, channels))}


def _point_inputs() -> dict[str, Tensor]:
    return {
        "features": Tensor("float32", (None, len(FEATURES))),
        "pillar_index": Tensor("int64", (None,)),
        "point_counts": Tensor("int64", (None,)),
    }


def _open(folder: Path, bundle: PillarBundle, name: str, interface: Interface) -> Session:
    # One thread: the maximum over a pillar's points is a ScatterND with repeated indices, and onnxruntime's threads
    # race for them: now and then a few features come out too small (onnxruntime issue 18048; seen with 1.31). It is
    # still the fastest form, ten times faster than ScatterElements. The other core builds rulebooks meanwhile.
    path = folder / bundle.graphs[name].file
    session = providers.open_session(path, "cpu", "float32", threads=1)
    return check_interface(path, session, *interface)
