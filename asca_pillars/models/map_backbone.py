"""Layers on a bird's-eye-view map (SECOND, PointPillars): blocks, their upsamplings, and the head on them.

Sparse convolutions by rulebooks, and matrix products over varying numbers of rows.

Features are rows, one for each active cell; a rulebook's entry beyond the last row stands for zeros. Every sum stays
inside a matrix product or runs in a fixed order, so results do not differ from run to run.

In a lower precision, oneDNN compiles a CPU's product for each new shape, in milliseconds: a third of a training step
where every batch has another number of rows. Rows are therefore padded with zeros to one of few numbers.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.detection.decode import HeadMaps


def rounded_rows(rows: int) -> int:
    """Return `rows` rounded up by at most a sixteenth, to one of 16 numbers in each octave."""
    step = 1 << max((rows - 1).bit_length() - 5, 0)
    return -(-rows // step) * step


def pad_rows(features: Tensor, value: float = 0) -> Tensor:
    """Pad rows (N, C) with rows of `value` to the number that `rounded_rows` gives."""
    missing = rounded_rows(len(features)) - len(features)
    return F.pad(features, (0, 0, 0, missing), value=value) if missing else features


def linear_rows(features: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Apply `torch.nn.functional.linear` to rows: (N, C) -> (N, outputs)."""
    device = features.device.type
    if device != "cpu" or not torch.is_autocast_enabled(device):
        return F.linear(features, weight, bias)
    return F.linear(pad_rows(features.to(torch.get_autocast_dtype(device))), weight, bias)[: len(features)]


CHUNK_VALUES = 1 << 20  # gathered at a time: on a CPU they stay in its cache; all at once would be memory-bound
GPU_CHUNK_VALUES = 1 << 28  # half a GiB in bfloat16; there each chunk costs launches


def rulebook_conv(features: Tensor, weight: Tensor, rulebook: Tensor, back: Tensor | None = None) -> Tensor:
    """Compute a convolution without bias at M output cells: (N, C) -> (M, outputs).

    Under autocast it computes in the lower precision, as a convolution would.

    Args:
        features: (N, C).
        weight: (outputs, C, *kernel) as PyTorch stores a convolution's, K cells in its kernel.
        rulebook: (M, K) int32 rows of `features`, N where there is none.
        back: (N, K) int32 the inverse, rows of the output, M where there is none; needed for the features' gradient.
            Of a submanifold convolution it is the rulebook with its taps reversed, and taken to be so if not given.
    """
    device = features.device.type
    if torch.is_autocast_enabled(device):
        features, weight = (tensor.to(torch.get_autocast_dtype(device)) for tensor in (features, weight))
    result: Tensor = _RulebookConv.apply(features, weight, rulebook, rulebook.flip(1) if back is None else back)
    return result


class _RulebookConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, rulebook: Tensor, back: Tensor) -> Tensor:
        ctx.save_for_backward(features, weight, rulebook, back)
        return _gathered_product(features, rulebook, _by_output(weight).T)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, Tensor | None, None, None]:
        features, weight, rulebook, back = ctx.saved_tensors
        gradient = gradients[0].to(features.dtype)
        of_features = of_weight = None
        if ctx.needs_input_grad[0]:
            by_tap = _by_output(weight).unflatten(1, (rulebook.shape[1], -1)).transpose(0, 1)  # (K, outputs, C)
            of_features = _gathered_product(gradient, back, by_tap.flatten(0, 1))
        if ctx.needs_input_grad[1]:
            of_weight = _weight_gradient(features, rulebook, gradient).to(weight.dtype)
            kernel = weight.shape[2:]
            of_weight = of_weight.unflatten(1, (*kernel, -1)).movedim(-1, 1)
        return of_features, of_weight, None, None


def _by_output(weight: Tensor) -> Tensor:
    """Permute (outputs, C, *kernel) to (outputs, K * C), without a copy if channels are last in memory."""
    return weight.movedim(1, -1).flatten(1)


def _gathered_product(features: Tensor, rulebook: Tensor, matrix: Tensor) -> Tensor:
    """Multiply the rows gathered by the rulebook (M, K), side by side, by the matrix (K * C, outputs)."""
    if len(rulebook) == 0:
        return features.new_zeros(0, matrix.shape[1])
    return torch.cat([(gathered @ matrix)[:rows] for rows, gathered in _chunks(features, rulebook)])


def _weight_gradient(features: Tensor, rulebook: Tensor, gradient: Tensor) -> Tensor:
    """Return the gradient of the weight, (outputs, K * C), summed over chunks in float32 at least."""
    total = torch.promote_types(features.dtype, torch.float32)
    matrix = torch.zeros(gradient.shape[1], rulebook.shape[1] * features.shape[1], dtype=total, device=features.device)
    first = 0
    for rows, gathered in _chunks(features, rulebook):
        matrix += pad_rows(gradient[first : first + rows]).T @ gathered
        first += rows
    return matrix


def _chunks(features: Tensor, rulebook: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Yield for each chunk its number of rows, and its gathered rows (m, K * C), followed by zeros."""
    padded = F.pad(features, (0, 0, 0, 1))
    values = rulebook.shape[1] * features.shape[1]
    at_once = GPU_CHUNK_VALUES if features.is_cuda else CHUNK_VALUES
    for part in rulebook.split(rounded_rows(max(at_once // values, 1))):
        entries = pad_rows(part, len(features))
        yield len(part), padded.index_select(0, entries.flatten()).view(len(entries), values)


def at_active_cells(norm: Callable[[Tensor], Tensor], features: Tensor) -> Tensor:
    """Apply a batch normalization of maps or volumes to active cells: (M, C) -> (M, C)."""
    return norm(features[:, :, None, None])[:, :, 0, 0]


NORM_EPS, NORM_MOMENTUM = 1e-3, 0.01  # as in SECOND and PointPillars


def as_map(cells: Tensor) -> Tensor:
    """Permute a channels-last map for convolutions: (B, H, W, C) -> (B, C, H, W).

    They lie so in memory after it, too, which suits convolutions; but on a CPU without AVX-512 their gradients then
    take twice the time, and the map is copied.
    """
    maps = cells.permute(0, 3, 1, 2)
    if cells.device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2":
        return maps.contiguous()
    return maps


def convolution_block(in_channels: int, channels: int, convs: int, *, stride: int = 2) -> nn.Sequential:
    """Build a 3x3 convolution with this stride and `convs` with stride 1, each with BatchNorm and ReLU.

    Table 1 of ASCA-PointPillars prints padding 0 for some strided convolutions and yet halves the maps exactly: one
    pixel of zeros is what both need.
    """
    layers = _normed(nn.Conv2d(in_channels, channels, 3, stride=stride, padding=1, bias=False), channels)
    for _ in range(convs):
        layers += _normed(nn.Conv2d(channels, channels, 3, padding=1, bias=False), channels)
    return nn.Sequential(*layers)


def upsampling(in_channels: int, channels: int, stride: int) -> nn.Sequential:
    """Build a transposed convolution whose kernel is its stride, with BatchNorm and ReLU."""
    return nn.Sequential(
        *_normed(nn.ConvTranspose2d(in_channels, channels, stride, stride=stride, bias=False), channels)
    )


class MapBackbone(nn.Module):
    """Blocks on a map, each upsampled to the head's resolution and concatenated (SECOND, PointPillars, PV-RCNN).

    Args:
        in_channels: of the map.
        block_channels: output channels of each block.
        block_convs: stride-1 convolutions after each block's first one.
        upsample_channels: output channels of each upsampling.
        strides: of each block's first convolution.
        head_stride: of the head's map.
        attention: a module after each block, before its upsampling and the next block; None for none.
    """

    def __init__(
        self,
        in_channels: int,
        block_channels: Sequence[int],
        block_convs: Sequence[int],
        upsample_channels: int,
        *,
        strides: Sequence[int],
        head_stride: int = 1,
        attention: Iterable[nn.Module] | None = None,
    ) -> None:
        super().__init__()
        self.blocks, self.deblocks, stride = nn.ModuleList(), nn.ModuleList(), 1
        self.attention = None if attention is None else nn.ModuleList(attention)
        for channels, convs, step in zip(block_channels, block_convs, strides, strict=True):
            stride *= step
            self.blocks.append(convolution_block(in_channels, channels, convs, stride=step))
            self.deblocks.append(upsampling(channels, upsample_channels, stride // head_stride))
            in_channels = channels
        self.out_channels = upsample_channels * len(self.blocks)

    def forward(self, canvas: Tensor) -> Tensor:
        """Apply the blocks: (B, C, H, W) -> (B, out_channels, h, w), with h, w = H, W / head_stride."""
        maps, attention = [], self.attention or [nn.Identity()] * len(self.blocks)
        for block, attend, deblock in zip(self.blocks, attention, self.deblocks, strict=True):
            canvas = attend(block(canvas))
            maps.append(deblock(canvas))
        return torch.cat(maps, dim=1)


def _normed(convolution: nn.Module, channels: int) -> list[nn.Module]:
    return [
        convolution,
        nn.BatchNorm2d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM),
        nn.ReLU(inplace=True),
    ]


POSITIVE_PRIOR = 0.01  # initial score of every anchor, which stabilizes focal loss (arXiv 1708.02002, 4.1)


class SSDHead(nn.Module):
    """Class logit, seven box residuals and two direction logits for each of A anchors per cell.

    An anchor belongs to one class and is only ever matched with that class, so it carries one class logit;
    `scores_per_anchor` is for the head of SECOND and PV-RCNN, whose every anchor has a logit for each class.
    """

    def __init__(self, in_channels: int, anchors_per_cell: int, scores_per_anchor: int = 1) -> None:
        super().__init__()
        self.scores = nn.Conv2d(in_channels, anchors_per_cell * scores_per_anchor, 1)
        self.boxes = nn.Conv2d(in_channels, anchors_per_cell * 7, 1)
        self.directions = nn.Conv2d(in_channels, anchors_per_cell * 2, 1)
        nn.init.constant_(self.scores.bias, -math.log((1 - POSITIVE_PRIOR) / POSITIVE_PRIOR))  # type: ignore[arg-type]
        nn.init.normal_(self.boxes.weight, std=0.001)

    def forward(self, features: Tensor) -> HeadMaps[Tensor]:
        """Apply the head: (B, C, H, W) -> scores (B, A, H, W), boxes (B, 7A, H, W), directions (B, 2A, H, W).

        With several scores per anchor there are so many times A of them, those of an anchor side by side.
        """
        return HeadMaps(self.scores(features), self.boxes(features), self.directions(features))

    def at_cells(self, features: Tensor) -> HeadMaps[Tensor]:
        """Apply the head at single cells: (M, C) -> scores (M, A), boxes (M, 7A), directions (M, 2A)."""
        joined = linear_rows(features, *self.joined())  # one product and one gradient of the features instead of three
        return HeadMaps(*joined.split(self.channels, dim=1))

    @property
    def channels(self) -> list[int]:
        """Output channels of scores, boxes and directions."""
        return [part.out_channels for part in (self.scores, self.boxes, self.directions)]

    def joined(self) -> tuple[Tensor, Tensor]:
        """Return the convolutions as one product: weight (outputs, C) and bias (outputs,), split by `channels`."""
        parts = self.scores, self.boxes, self.directions
        weight = torch.cat([part.weight[:, :, 0, 0] for part in parts])
        return weight, torch.cat([part.bias for part in parts if part.bias is not None])
