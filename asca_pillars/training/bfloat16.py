"""Which arithmetic a training computes in on this machine."""

import torch

from asca_pillars.config.tree import Precision


def has_bfloat16(device: str | None = None) -> bool:
    """Whether a device multiplies in bfloat16 itself. None is the one that Lightning takes: a GPU if there is one.

    One that does not still computes it, number by number: twenty times slower than float32 on a CPU with AVX2 alone.
    """
    if device != "cpu" and torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())  # oneDNN's own answer, which has no public name


def settled(precision: Precision, device: str | None = None) -> Precision:
    """`auto` as what suits a device, others as they are, see `has_bfloat16`."""
    if precision != "auto":
        return precision
    return "bf16" if has_bfloat16(device) else "fp32"
