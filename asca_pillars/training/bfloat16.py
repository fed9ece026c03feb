"""Which arithmetic a training computes in on this machine."""

import torch

from asca_pillars.config import Precision


def has_bfloat16(device: str | None = None) -> bool:
    """Whether a device multiplies in bfloat16 itself. None is the one that Lightning takes: a GPU if there is one.

    One that does not still computes it, number by number: twenty times slower than float32 on a CPU with AVX2 alone.
    """
    if device != "cpu" and torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())  # oneDNN's own answer, which has no public name


def computes_in_bfloat16(precision: Precision, device: str | None = None) -> bool:
    """What `train.precision` means on a device, see `has_bfloat16`."""
    return precision == "bf16" or (precision == "auto" and has_bfloat16(device))
