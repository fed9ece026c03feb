"""ONNX graphs of a bundle in a backend, and the check of their interface against the bundle."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

from numpy.typing import NDArray

from asca_pillars.base.errors import BundleError


class Tensor(NamedTuple):
    """An input or output: NumPy's name of its type, and its shape; None where a size varies from scan to scan."""

    type: str
    shape: tuple[int | None, ...]


Interface: TypeAlias = tuple[dict[str, Tensor], dict[str, Tensor]]
"""Inputs and outputs of a graph."""


class Session(Protocol):
    """A graph that a backend has opened."""

    @property
    def inputs(self) -> Mapping[str, Tensor]:
        """Inputs that the graph declares; an exporter drops inputs that the network does not use."""

    @property
    def outputs(self) -> Mapping[str, Tensor]:
        """Outputs of the graph."""

    @property
    def run(self) -> Callable[[Sequence[str], Mapping[str, NDArray[Any]]], list[NDArray[Any]]]:
        """(names of outputs, inputs by name) -> these outputs, in that order; the arrays are the caller's to keep.

        Shapes are those that `inputs` and `outputs` declare. Several threads may call it.
        """


def first_line(error: Exception) -> str:
    """Return the first line of a backend's error."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].strip()


def check_interface(
    path: Path, session: Session, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]
) -> Session:
    """Return the session if its graph has these outputs and no other inputs than these.

    Raises:
        BundleError: it does not; names the file, the input or output and the remedy.
    """
    _compare(path, "input", session.inputs, inputs)
    available = session.outputs
    for name in outputs:
        if name not in available:
            raise BundleError(f"{path} has no output `{name}`, only {', '.join(available)}; export the bundle again")
    _compare(path, "output", {name: available[name] for name in outputs}, outputs)
    return session


def _compare(path: Path, kind: str, tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if name not in expected:
            raise BundleError(
                f"{path} has an unknown {kind} `{name}`, the runtime knows {', '.join(expected)}; "
                "export the bundle again"
            )
        expected_type = expected[name]
        fits = len(tensor.shape) == len(expected_type.shape) and all(
            size is None or actual is None or actual == size
            for actual, size in zip(tensor.shape, expected_type.shape, strict=True)
        )
        if not fits or tensor.type != expected_type.type:
            raise BundleError(
                f"{path}: {kind} `{name}` is {_show(tensor)}, the bundle's spec needs {_show(expected_type)};"
                " export the bundle again"
            )


def _show(tensor: Tensor) -> str:
    return f"{tensor.type} ({', '.join('any' if size is None else str(size) for size in tensor.shape)})"
