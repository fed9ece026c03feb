"""Matrix products over rows whose number changes from batch to batch.

In a lower precision a CPU's product is compiled by oneDNN for each shape that it has not seen: milliseconds, again and
again where every batch has its own number of rows; a third of a training step. Rows of zeros round it to one of few.
"""

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (torch's own convention)


def rounded_rows(rows: int) -> int:
    """`rows` or a little more, at most a sixteenth: one of 16 numbers in each octave."""
    step = 1 << max((rows - 1).bit_length() - 5, 0)
    return -(-rows // step) * step


def pad_rows(features: Tensor, value: float = 0) -> Tensor:
    """Rows (N, C) followed by rows of `value`, as many in all as `rounded_rows` says."""
    missing = rounded_rows(len(features)) - len(features)
    return F.pad(features, (0, 0, 0, missing), value=value) if missing else features


def linear_rows(features: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`torch.nn.functional.linear` of rows, unitless: (N, C) -> (N, outputs)."""
    device = features.device.type
    if device != "cpu" or not torch.is_autocast_enabled(device):
        return F.linear(features, weight, bias)
    return F.linear(pad_rows(features.to(torch.get_autocast_dtype(device))), weight, bias)[: len(features)]
