"""Export of a checkpoint to a bundle: ONNX graphs, parity with PyTorch, 8-bit quantization."""

import asca_deploy.onnx_runtime  # noqa: F401  (`rounded_backbones` imports its tools after it)
