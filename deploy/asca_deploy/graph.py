"""One ONNX graph of a bundle, checked against what the bundle says of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy.providers import open_session
from asca_pillars.errors import BundleError


class Tensor(NamedTuple):
    """An input or output as the bundle expects it; None stands for a size that varies from scan to scan."""

    type: str
    shape: tuple[int | None, ...]


class Graph:
    """A session of onnxruntime with known inputs and outputs.

    Raises:
        ProviderError: none of the providers starts.
        BundleError: the graph cannot be run, or its inputs and outputs are not the expected ones.
    """

    def __init__(
        self,
        path: Path,
        inputs: Mapping[str, Tensor],
        outputs: Mapping[str, Tensor],
        providers: Sequence[str],
        threads: int,
    ) -> None:
        self._session, self.provider = open_session(path, providers, threads)
        self._outputs = list(outputs)
        found = {node.name: Tensor(node.type, tuple(node.shape)) for node in self._session.get_inputs()}
        # A graph need not declare every input: the exporter drops those that the network does not use.
        self._inputs = list(found)
        _compare(path, "input", found, inputs)
        found = {node.name: Tensor(node.type, tuple(node.shape)) for node in self._session.get_outputs()}
        for name in outputs:
            if name not in found:
                raise BundleError(f"{path} has no output `{name}`, only {', '.join(found)}; export the bundle again")
        _compare(path, "output", {name: found[name] for name in outputs}, outputs)

    def run(self, **inputs: NDArray[np.generic]) -> list[NDArray[np.float32]]:
        """Outputs in the order in which they were expected."""
        result: list[NDArray[np.float32]] = self._session.run(
            self._outputs, {name: inputs[name] for name in self._inputs}
        )
        return result


def _compare(path: Path, kind: str, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    for name, tensor in found.items():
        if name not in expected:
            raise BundleError(
                f"{path} has an unknown {kind} `{name}`, the runtime knows {', '.join(expected)}; "
                "export the bundle again"
            )
        want = expected[name]
        fits = len(tensor.shape) == len(want.shape) and all(
            size is None or not isinstance(actual, int) or actual == size
            for actual, size in zip(tensor.shape, want.shape, strict=True)
        )
        if not fits or tensor.type != want.type:
            raise BundleError(
                f"{path}: {kind} `{name}` is {_show(tensor)}, the bundle's spec needs {_show(want)};"
                " export the bundle again"
            )


def _show(tensor: Tensor) -> str:
    return f"{tensor.type} ({', '.join('any' if size is None else str(size) for size in tensor.shape)})"
