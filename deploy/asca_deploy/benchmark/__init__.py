"""Benchmarks: time per stage, comparison with another detector and with the machine, cold start."""

from asca_deploy.benchmark.bench_report import BenchmarkReport, ColdStart, benchmark, cold_start
from asca_deploy.benchmark.speed_comparison import Comparison, Contestant, MatrixRow, alternate, compare, measure_matrix
from asca_deploy.benchmark.timing import (
    Roofline,
    ScalingRow,
    Throughput,
    measure_roofline,
    measure_scaling,
    measure_throughput,
)

__all__ = [
    "BenchmarkReport",
    "ColdStart",
    "Comparison",
    "Contestant",
    "MatrixRow",
    "Roofline",
    "ScalingRow",
    "Throughput",
    "alternate",
    "benchmark",
    "cold_start",
    "compare",
    "measure_matrix",
    "measure_roofline",
    "measure_scaling",
    "measure_throughput",
]
