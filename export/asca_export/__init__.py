"""Export of a checkpoint to a bundle: ONNX graphs, parity with PyTorch, 8-bit quantization."""

import asca_deploy.onnx_runtime  # noqa: F401  (`int8` imports its tools after it)
