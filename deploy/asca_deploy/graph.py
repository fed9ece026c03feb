"""One ONNX graph of a bundle, checked against what the bundle says of it, on whichever backend runs it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from asca_pillars.errors import BundleError


class Tensor(NamedTuple):
    """An input or output: NumPy's name of its type, and its shape; None where a size varies from scan to scan."""

    type: str
    shape: tuple[int | None, ...]


class Session(Protocol):
    """A graph that a backend has opened."""

    @property
    def inputs(self) -> Mapping[str, Tensor]:
        """What the graph declares; an exporter drops inputs that the network does not use."""

    @property
    def outputs(self) -> Mapping[str, Tensor]:
        """What the graph returns."""

    def run(self, inputs: Mapping[str, NDArray[Any]], outputs: Sequence[str]) -> list[NDArray[Any]]:
        """The named outputs, in that order; the arrays are the caller's to keep. Several threads may call it."""


class Graph:
    """A session with known inputs and outputs.

    Raises:
        BundleError: the graph's inputs and outputs are not the expected ones.
    """

    def __init__(
        self, path: Path, session: Session, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]
    ) -> None:
        self._session = session
        self._inputs, self._outputs = list(session.inputs), list(outputs)
        _compare(path, "input", session.inputs, inputs)
        found = session.outputs
        for name in outputs:
            if name not in found:
                raise BundleError(f"{path} has no output `{name}`, only {', '.join(found)}; export the bundle again")
        _compare(path, "output", {name: found[name] for name in outputs}, outputs)

    def run(self, **inputs: NDArray[Any]) -> list[NDArray[Any]]:
        """Outputs in the order in which they were expected; the arrays are the caller's to keep."""
        return self._session.run({name: inputs[name] for name in self._inputs}, self._outputs)


def _compare(path: Path, kind: str, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    for name, tensor in found.items():
        if name not in expected:
            raise BundleError(
                f"{path} has an unknown {kind} `{name}`, the runtime knows {', '.join(expected)}; "
                "export the bundle again"
            )
        want = expected[name]
        fits = len(tensor.shape) == len(want.shape) and all(
            size is None or actual is None or actual == size
            for actual, size in zip(tensor.shape, want.shape, strict=True)
        )
        if not fits or tensor.type != want.type:
            raise BundleError(
                f"{path}: {kind} `{name}` is {_show(tensor)}, the bundle's spec needs {_show(want)};"
                " export the bundle again"
            )


def _show(tensor: Tensor) -> str:
    return f"{tensor.type} ({', '.join('any' if size is None else str(size) for size in tensor.shape)})"
