"""Providers of the backbone: hardware, library and precision.

    cpu       onnxruntime, always there
    cuda      onnxruntime's GPU build
    tensorrt  onnxruntime's GPU build and TensorRT
    openvino  the package of that name, on the CPU

"float32" computes as the export's proof of parity did. "reduced" lets the hardware keep fewer digits where that is
faster: bfloat16 in OpenVINO, TF32 in CUDA, float16 in TensorRT. In an int8 bundle both concern only what the export
left in floating point.

A requested provider that cannot run is an error; there is no silent fallback to the CPU.
"""

from pathlib import Path
from typing import Literal, get_args

from asca_deploy import openvino_session, ort_session
from asca_deploy.graph import Session
from asca_pillars.base.errors import ProviderError

Provider = Literal["cpu", "cuda", "tensorrt", "openvino"]
Precision = Literal["float32", "reduced"]

PRECISIONS: tuple[Precision, ...] = get_args(Precision)
PROVIDERS: tuple[Provider, ...] = get_args(Provider)
AUTO: Literal["auto"] = "auto"


def arithmetic(weights: str, precision: str) -> str:
    """Return the arithmetic of a network in words.

    Args:
        weights: the bundle's own precision, float32 or int8.
        precision: of the provider; in an int8 bundle it concerns only what the export left in floating point.
    """
    if weights == "float32":
        return precision
    return weights if precision == "float32" else f"{weights}, rest {precision}"


def require(provider: str, precision: str = "float32") -> None:
    """Raise ProviderError, one line with the remedy, unless the provider is installed and has the precision.

    AUTO always passes; its candidates are checked when they are opened.
    """
    if provider not in (AUTO, *PROVIDERS):
        raise ProviderError(f"unknown provider {provider!r}; choose one of {AUTO}, {', '.join(PROVIDERS)}")
    if precision not in PRECISIONS:
        raise ProviderError(f"unknown precision {precision!r}; choose {' or '.join(PRECISIONS)}")
    if provider == "openvino":
        openvino_session.require(precision)
    elif provider != AUTO:
        ort_session.require(provider, precision)


def available() -> list[tuple[Provider, Precision]]:
    """Return every (provider, precision) that is installed; the faster precision of a provider first."""
    ways: list[tuple[Provider, Precision]] = []
    for provider in PROVIDERS:
        for precision in reversed(PRECISIONS):
            try:
                require(provider, precision)
            except ProviderError:
                continue
            ways.append((provider, precision))
    return ways


def open_session(
    path: Path, provider: Provider, precision: Precision, threads: int, *, keep_memory: bool = True
) -> Session:
    """Open an ONNX file with a provider and precision that `require` allows.

    With `keep_memory` onnxruntime keeps what a run took for the next one: faster, but of a graph whose rows differ in
    number from scan to scan ever more pieces.

    Raises:
        ProviderError: the provider does not start.
        BundleError: the graph cannot be run.
    """
    if provider == "openvino":
        return openvino_session.OpenVinoSession(path, precision, threads)
    return ort_session.OrtSession(path, provider, precision, threads, keep_memory=keep_memory)
