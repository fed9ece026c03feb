"""Creation of the two graphs with which `asca bench` measures the machine's matrix multiplication rate.

    python -m benchmarks.gemm_graphs

The constant matrix is a small tile repeated: onnxruntime expands it when it opens the graph and packs it like a
network's weights, and the files stay small. MatMulInteger rather than QLinearMatMul: int32 output without rounding.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

import asca_deploy.benchmark
from asca_deploy.benchmark.timing import SIZE

TILE = 64


def main() -> None:
    """Write gemm_float32.onnx and gemm_int8.onnx into the package."""
    rng = np.random.default_rng(0)
    folder = Path(asca_deploy.benchmark.__file__).parent
    normal = rng.standard_normal((TILE, TILE), np.float32)
    onnx.save(_gemm("MatMul", normal, TensorProto.FLOAT, TensorProto.FLOAT), folder / "gemm_float32.onnx")
    integers = rng.integers(-127, 128, (TILE, TILE), np.int8)
    onnx.save(_gemm("MatMulInteger", integers, TensorProto.UINT8, TensorProto.INT32), folder / "gemm_int8.onnx")


def _gemm(operator: str, tile: np.ndarray, kind_in: int, kind_out: int) -> onnx.ModelProto:
    repeats = np.full(2, SIZE // TILE, np.int64)
    graph = helper.make_graph(
        [helper.make_node("Tile", ["tile", "repeats"], ["b"]), helper.make_node(operator, ["a", "b"], ["c"])],
        operator,
        [helper.make_tensor_value_info("a", kind_in, ["rows", SIZE])],
        [helper.make_tensor_value_info("c", kind_out, ["rows", SIZE])],
        [numpy_helper.from_array(tile, "tile"), numpy_helper.from_array(repeats, "repeats")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return model


if __name__ == "__main__":
    main()
