"""Sparse convolutions by rulebooks, and matrix products over varying numbers of rows.

Features are rows, one for each active cell; a rulebook's entry beyond the last row stands for zeros. Every sum stays
inside a matrix product or runs in a fixed order, so results do not differ from run to run.

In a lower precision, oneDNN compiles a CPU's product for each new shape, in milliseconds: a third of a training step
where every batch has another number of rows. Rows are therefore padded with zeros to one of few numbers.
"""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (torch's own convention)


def rounded_rows(rows: int) -> int:
    """Return `rows` rounded up by at most a sixteenth, to one of 16 numbers in each octave."""
    step = 1 << max((rows - 1).bit_length() - 5, 0)
    return -(-rows // step) * step


def pad_rows(features: Tensor, value: float = 0) -> Tensor:
    """Pad rows (N, C) with rows of `value` to the number that `rounded_rows` gives."""
    missing = rounded_rows(len(features)) - len(features)
    return F.pad(features, (0, 0, 0, missing), value=value) if missing else features


def linear_rows(features: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Apply `torch.nn.functional.linear` to rows, unitless: (N, C) -> (N, outputs)."""
    device = features.device.type
    if device != "cpu" or not torch.is_autocast_enabled(device):
        return F.linear(features, weight, bias)
    return F.linear(pad_rows(features.to(torch.get_autocast_dtype(device))), weight, bias)[: len(features)]


CHUNK_VALUES = 1 << 20  # gathered at a time: on a CPU they stay in its cache; all at once would be memory-bound
GPU_CHUNK_VALUES = 1 << 28  # half a GiB in bfloat16; there each chunk costs launches


def rulebook_conv(features: Tensor, weight: Tensor, table: Tensor, back: Tensor | None = None) -> Tensor:
    """Compute a convolution without bias at M output cells: (N, C) -> (M, outputs).

    Under autocast it computes in the lower precision, as a convolution would.

    Args:
        features: (N, C), unitless.
        weight: (outputs, C, *kernel) as PyTorch stores a convolution's, K cells in its kernel.
        table: (M, K) int32 rows of `features`, N where there is none.
        back: (N, K) int32 the inverse, rows of the output, M where there is none; needed for the features' gradient.
            Of a submanifold convolution it is the same table with its taps reversed, and taken to be so if not given.
    """
    device = features.device.type
    if torch.is_autocast_enabled(device):
        features, weight = (each.to(torch.get_autocast_dtype(device)) for each in (features, weight))
    result: Tensor = _RulebookConv.apply(features, weight, table, table.flip(1) if back is None else back)
    return result


class _RulebookConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, table: Tensor, back: Tensor) -> Tensor:
        ctx.save_for_backward(features, weight, table, back)
        return _gathered_product(features, table, _by_output(weight).T)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, Tensor | None, None, None]:
        features, weight, table, back = ctx.saved_tensors
        gradient = gradients[0].to(features.dtype)
        of_features = of_weight = None
        if ctx.needs_input_grad[0]:
            by_tap = _by_output(weight).unflatten(1, (table.shape[1], -1)).transpose(0, 1)  # (K, outputs, C)
            of_features = _gathered_product(gradient, back, by_tap.flatten(0, 1))
        if ctx.needs_input_grad[1]:
            of_weight = _weight_gradient(features, table, gradient).to(weight.dtype)
            kernel = weight.shape[2:]
            of_weight = of_weight.unflatten(1, (*kernel, -1)).movedim(-1, 1)
        return of_features, of_weight, None, None


def _by_output(weight: Tensor) -> Tensor:
    """Permute (outputs, C, *kernel) to (outputs, K * C), without a copy if channels are last in memory."""
    return weight.movedim(1, -1).flatten(1)


def _gathered_product(features: Tensor, table: Tensor, matrix: Tensor) -> Tensor:
    """Multiply the rows gathered by the table (M, K), side by side, by the matrix (K * C, outputs)."""
    if len(table) == 0:
        return features.new_zeros(0, matrix.shape[1])
    return torch.cat([(gathered @ matrix)[:rows] for rows, gathered in _chunks(features, table)])


def _weight_gradient(features: Tensor, table: Tensor, gradient: Tensor) -> Tensor:
    """Return the gradient of the weight, (outputs, K * C), summed over chunks in float32 at least."""
    total = torch.promote_types(features.dtype, torch.float32)
    matrix = torch.zeros(gradient.shape[1], table.shape[1] * features.shape[1], dtype=total, device=features.device)
    first = 0
    for rows, gathered in _chunks(features, table):
        matrix += pad_rows(gradient[first : first + rows]).T @ gathered
        first += rows
    return matrix


def _chunks(features: Tensor, table: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Yield for each chunk its number of rows, and its gathered rows (m, K * C), followed by zeros."""
    padded = F.pad(features, (0, 0, 0, 1))
    values = table.shape[1] * features.shape[1]
    at_once = GPU_CHUNK_VALUES if features.is_cuda else CHUNK_VALUES
    for part in table.split(rounded_rows(max(at_once // values, 1))):
        entries = pad_rows(part, len(features))
        yield len(part), padded.index_select(0, entries.flatten()).view(len(entries), values)


def at_active_cells(norm: Callable[[Tensor], Tensor], features: Tensor) -> Tensor:
    """Apply a batch normalization of maps or volumes to active cells: (M, C) -> (M, C), unitless."""
    return norm(features[:, :, None, None])[:, :, 0, 0]
