"""Roofline of the backbone: its share of the arithmetic throughput of the machine.

The ceiling is measured, not looked up: a product of two large matrices by onnxruntime's CPU provider with the same
number of threads, one of them constant as a network's weights are. gemm_*.onnx come from benchmarks/gemm_graphs.py.
"""

from dataclasses import dataclass
from importlib import resources
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import Bundle
from asca_deploy.onnx_runtime import onnxruntime

SIZE = 2048
"""Rows and columns of the constant matrix in both graphs."""
RUNS, BUDGET_S = 7, 0.6  # per type: the median of so many, or of as many as the time allows on a slow machine


@dataclass(frozen=True)
class Roofline:
    """Rate of the backbone against the machine's rate of multiplying matrices."""

    gmac: float
    """Multiply-accumulates of the backbone, 1e9."""
    achieved_gmac_s: float
    """Rate of neck and head at their p50, for one pass."""
    gemm_gmac_s: dict[str, float]
    """Measured rate by type, float32 and int8."""
    type: str
    """Type in which the bundle's backbone multiplies."""
    share: float
    """achieved / measured rate of that type. A provider that computes in less precision can exceed 1."""
    threads: int


def measure_roofline(bundle: Bundle, backbone_ms: float, threads: int) -> Roofline:
    """Measure the machine and relate `backbone_ms` to it, the p50 of neck and head in one pass; up to two seconds.

    Args:
        threads: as the detector has.
    """
    rates = {kind: gemm_rate(kind, threads) for kind in ("float32", "int8")}
    achieved = bundle.backbone_gmac / backbone_ms * 1e3
    share = achieved / rates[bundle.precision]
    return Roofline(bundle.backbone_gmac, achieved, rates, bundle.precision, share, threads)


def gemm_rate(kind: str, threads: int, rows: int = SIZE) -> float:
    """Measure multiply-accumulates per second, 1e9, of (rows, SIZE) @ (SIZE, SIZE) in onnxruntime: a median.

    Args:
        kind: "float32", or "int8" for uint8 x int8 -> int32.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    graph = resources.files("asca_deploy.benchmark").joinpath(f"gemm_{kind}.onnx").read_bytes()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    feed = {"a": _matrix(kind, rows)}
    session.run(None, feed)
    seconds: list[float] = []
    while len(seconds) < RUNS and sum(seconds) < BUDGET_S:
        start = perf_counter()
        session.run(None, feed)
        seconds.append(perf_counter() - start)
    return rows * SIZE**2 / float(np.median(seconds)) / 1e9


def _matrix(kind: str, rows: int) -> NDArray[np.generic]:
    rng = np.random.default_rng(0)
    if kind == "int8":
        return rng.integers(0, 256, (rows, SIZE), np.uint8)
    return rng.standard_normal((rows, SIZE), np.float32)
