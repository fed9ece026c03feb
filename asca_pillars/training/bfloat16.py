"""Which arithmetic a training computes in on this machine."""

import torch

from asca_pillars.config import Precision


def has_bfloat16() -> bool:
    """Whether the device that Lightning takes, a GPU if there is one, multiplies in bfloat16 itself.

    One that does not still computes it, number by number: twenty times slower than float32 on a CPU with AVX2 alone.
    """
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())  # oneDNN's own answer, which has no public name


def computes_in_bfloat16(precision: Precision) -> bool:
    """What `train.precision` means here."""
    return precision == "bf16" or (precision == "auto" and has_bfloat16())
