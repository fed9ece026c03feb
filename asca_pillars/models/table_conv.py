"""Convolutions at active cells alone, by the tables of `asca_pillars.tables`, forward and backward without a scatter.

Features are rows, one for each active cell; a table's entry beyond the last row stands for zeros. Every sum stays
inside a matrix product or runs in a fixed order, so results do not differ from run to run.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

CHUNK_VALUES = 1 << 20  # gathered at a time: on a CPU they stay in its cache; all at once would be memory-bound


def table_conv(features: Tensor, weight: Tensor, table: Tensor, back: Tensor | None = None) -> Tensor:
    """A convolution without bias at M output cells: (N, C) -> (M, outputs).

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
    result: Tensor = _TableConv.apply(features, weight, table, table.flip(1) if back is None else back)
    return result


class _TableConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, table: Tensor, back: Tensor) -> Tensor:
        ctx.save_for_backward(features, weight, table, back)
        return _gathered_product(features, table, _by_tap(weight).flatten(0, 1))

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, Tensor | None, None, None]:
        features, weight, table, back = ctx.saved_tensors
        gradient = gradients[0].to(features.dtype)
        of_features = of_weight = None
        if ctx.needs_input_grad[0]:
            of_features = _gathered_product(gradient, back, _by_tap(weight).transpose(1, 2).flatten(0, 1))
        if ctx.needs_input_grad[1]:
            of_weight = _weight_gradient(features, table, gradient).to(weight.dtype)
            of_weight = of_weight.unflatten(0, (table.shape[1], -1)).permute(2, 1, 0).reshape(weight.shape)
        return of_features, of_weight, None, None


def _by_tap(weight: Tensor) -> Tensor:
    """(outputs, C, *kernel) -> (K, C, outputs)."""
    return weight.flatten(2).permute(2, 1, 0)


def _gathered_product(features: Tensor, table: Tensor, matrix: Tensor) -> Tensor:
    """Rows gathered by the table (M, K), side by side, times the matrix (K * C, outputs)."""
    if len(table) == 0:
        return features.new_zeros(0, matrix.shape[1])
    return torch.cat([gathered @ matrix for gathered in _chunks(features, table)])


def _weight_gradient(features: Tensor, table: Tensor, gradient: Tensor) -> Tensor:
    """(K * C, outputs), summed over chunks in float32 at least."""
    total = torch.promote_types(features.dtype, torch.float32)
    matrix = torch.zeros(table.shape[1] * features.shape[1], gradient.shape[1], dtype=total, device=features.device)
    first = 0
    for gathered in _chunks(features, table):
        matrix += gathered.T @ gradient[first : first + len(gathered)]
        first += len(gathered)
    return matrix


def _chunks(features: Tensor, table: Tensor) -> Any:
    """Gathered rows (m, K * C), chunk by chunk."""
    padded = F.pad(features, (0, 0, 0, 1))
    rows = max(CHUNK_VALUES // (table.shape[1] * features.shape[1]), 1)
    for part in table.split(rows):
        yield padded.index_select(0, part.flatten()).view(len(part), table.shape[1] * features.shape[1])


def at_active_cells(norm: Callable[[Tensor], Tensor], features: Tensor) -> Tensor:
    """A batch normalization made for maps or volumes, over active cells alone: (M, C) -> (M, C), unitless."""
    return norm(features[:, :, None, None])[:, :, 0, 0]
