"""Quantization of the backbone to 8 bits: per-channel steps of activations, jointly rounded weights.

Most of a pseudo-image is empty, where a trained network has the same small values everywhere. Rounding them makes the
same error all over the map, which grows from layer to layer and costs more precision than anything else. Therefore:

- a channel's step is its largest value on the calibration scans / 255, then stretched until its value in empty space is
  a whole number of steps. Steps of single channels are free: between a ReLU and the next layer a positive factor moves
  into the weights on both sides, exactly;
- weights are rounded one after the other, and those not yet rounded make up for what it changed on the calibration
  scans (GPTQ, arXiv 2210.17323); the bias makes up for what remains in empty space.

Weights are signed 7-bit per output channel. Seven, because CPUs without VNNI add pairs of products u8 x s8 in 16 bits:
2 x 255 x 64 fits, 2 x 255 x 127 does not, and they would saturate silently.
"""

from collections.abc import Collection, Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_export.fast_forms import STEP_VALUE, CanvasSteps, FastBackbone

HEAD = "head"
STEPS = 255
WEIGHT_STEPS = 64
EMPTY_SIZE = 256  # cells to a side; the deepest convolution of the paper's neck sees 99 of them
PLACES = 8000  # samples of each scan and layer for rounding weights
_DAMPING = 0.001  # of the moments' mean diagonal, for inputs of little variance
_SHRINK = 0.95  # a range may lose this much of its end where that spares it coarser steps
TINY = 1e-6  # a channel that is never above it is as good as empty; its step must not be 0


def canvas_steps(pillar_features: Iterable[NDArray[np.float32]]) -> CanvasSteps:
    """Return the steps of a canvas for the features of all these scans, (P, C) each, and exactly zero."""
    lows, highs = zip(*((features.min(axis=0), features.max(axis=0)) for features in pillar_features), strict=True)
    low, high = np.minimum(np.min(lows, axis=0), 0.0), np.maximum(np.max(highs, axis=0), 0.0)
    scale = np.maximum((high - low) / STEPS, TINY).astype(np.float32)
    empty = np.clip(np.round(-low / scale), 0, STEPS).astype(np.float32)
    return CanvasSteps(torch.from_numpy(scale), torch.from_numpy(empty))


def layer_names(backbone: FastBackbone) -> list[str]:
    """Return the layers that can compute in 8 bits, by the names of their modules."""
    return [name for name, layer in backbone.named_modules() if isinstance(layer, nn.Conv2d)] + [HEAD]


@torch.no_grad()
def scale_to_steps(backbone: FastBackbone, canvases: Iterable[NDArray[np.uint8]], steps: CanvasSteps) -> None:
    """Change the weights so that activations count steps, 0 to 255 times STEP_VALUE; the results stay the same.

    Args:
        backbone: made with `steps`; changed in place.
        canvases: (1, H, W, C) of the calibration scans, the padding that the backbone takes included.
    """
    highest: dict[str, Tensor] = {}
    for canvas in canvases:
        for name, pass_ in _passes(backbone, torch.from_numpy(canvas) * STEP_VALUE):
            high = pass_.output.amax(dim=(0, 2, 3))
            highest[name] = torch.maximum(highest[name], high) if name in highest else high
    empty = {name: _center(pass_.output) for name, pass_ in _passes(backbone, _empty_canvas(backbone, steps))}
    stages = backbone.stages()
    for i, (convolutions, upsample_name, upsample) in enumerate(stages):
        names = list(convolutions)
        after_block = [
            upsample.convolution,
            *(next(iter(stage.convolutions.values())) for stage in stages[i + 1 : i + 2]),
        ]
        for j, name in enumerate(names):
            step = highest[name].clamp_min(TINY) / STEPS
            whole = torch.floor(empty[name] / step / _SHRINK)
            step = torch.where(whole > 0, empty[name] / whole.clamp_min(1), step)
            _count(convolutions[name], step)
            for reader in [convolutions[names[j + 1]]] if j + 1 < len(names) else after_block:
                reader.weight.mul_(step[:, None, None] / STEP_VALUE)
        # The outputs for the places of one cell become neighbors in one channel.
        channels = upsample.channels
        step = highest[upsample_name].reshape(-1, channels).amax(dim=0).clamp_min(TINY) / STEPS
        _count(upsample.convolution, step.repeat(upsample.stride**2))
        backbone.head.weight[i * channels : (i + 1) * channels].mul_(step[:, None] / STEP_VALUE)


class Moments(NamedTuple):
    """Moments of the inputs of a backbone's layers."""

    empty: dict[str, Tensor]
    """(inputs,) in empty space, by layer."""
    squares: dict[str, Tensor]
    """(inputs * window, same): mean product of the differences from empty space, by layer."""


@torch.no_grad()
def input_moments(backbone: FastBackbone, canvases: Iterable[NDArray[np.uint8]], steps: CanvasSteps) -> Moments:
    """Return moments of what every layer reads on the calibration scans.

    Args:
        backbone: scaled to steps.
        canvases: likewise.
    """
    empty = {name: _center(pass_.input) for name, pass_ in _passes(backbone, _empty_canvas(backbone, steps))}
    generator = torch.Generator().manual_seed(0)
    squares: dict[str, Tensor] = {}
    for number, canvas in enumerate(canvases, start=1):
        for name, pass_ in _passes(backbone, torch.from_numpy(canvas) * STEP_VALUE):
            moved = pass_.input - empty[name][:, None, None]
            size, stride, padding = pass_.window
            windows = F.unfold(moved, size, stride=stride, padding=padding)[0]  # (inputs * window, places)
            alive = windows.abs().amax(dim=0).nonzero()[:, 0]
            chosen = windows[:, alive[torch.randperm(len(alive), generator=generator)[:PLACES]]]
            mean = chosen @ chosen.T / max(chosen.shape[1], 1)
            squares[name] = mean if number == 1 else squares[name] + (mean - squares[name]) / number
    return Moments(empty, squares)


@torch.no_grad()
def round_weights(backbone: FastBackbone, layers: Collection[str], moments: Moments) -> None:
    """Round the weights of `layers` to what 8-bit arithmetic will use.

    Args:
        backbone: scaled to steps; changed in place.
        layers: some of `layer_names`.
        moments: of this backbone.
    """
    for name, empty in moments.empty.items():
        layer = backbone.get_submodule(name)
        parameter, bias = layer.get_parameter("weight"), layer.get_parameter("bias")
        weight = parameter.T if name == HEAD else parameter.flatten(1)  # (outputs, inputs * window)
        rounded = round_together(weight, moments.squares[name]) if name in layers else weight
        read = (empty / STEP_VALUE).round() * STEP_VALUE
        sums, rounded_sums = (values.unflatten(1, (len(empty), -1)).sum(dim=2) for values in (weight, rounded))
        bias.add_(sums @ empty - rounded_sums @ read)
        parameter.copy_(rounded.T if name == HEAD else rounded.reshape(parameter.shape))


def round_together(weight: Tensor, squares: Tensor) -> Tensor:
    """Round weights (outputs, n) jointly to a grid of 2 WEIGHT_STEPS + 1 values per output.

    The largest weight of an output stays at the end of its grid, from which the graph's writer takes the grid's unit.
    """
    largest, peak = weight.abs().max(dim=1)
    unit = largest.clamp_min(TINY) / WEIGHT_STEPS
    damping = _DAMPING * squares.diagonal().mean().clamp_min(TINY)
    inverse = torch.linalg.inv(squares.double() + damping * torch.eye(len(squares)))
    factor = torch.linalg.cholesky(inverse, upper=True).float()
    left, rounded = weight.clone(), torch.empty_like(weight)
    for k in range(weight.shape[1]):
        whole = (left[:, k] / unit).round().clamp(-WEIGHT_STEPS, WEIGHT_STEPS)
        rounded[:, k] = torch.where(peak == k, weight[:, k].sign() * WEIGHT_STEPS, whole) * unit
        lost = (left[:, k] - rounded[:, k]) / factor[k, k]
        left[:, k:] -= lost[:, None] * factor[k, k:]
    return rounded


class _Pass(NamedTuple):
    """Inputs and outputs of one layer for one scan."""

    input: Tensor
    """(1, inputs, H, W)"""
    output: Tensor
    """(1, outputs, H, W) after the ReLU; of the head, its input."""
    window: tuple[int, int, int]
    """Kernel size, stride and padding."""


def _passes(backbone: FastBackbone, canvas: Tensor) -> Iterator[tuple[str, _Pass]]:
    features, maps = canvas.permute(0, 3, 1, 2), []
    for convolutions, upsample_name, upsample in backbone.stages():
        for name, convolution in convolutions.items():
            output = torch.relu(convolution(features))
            window = (convolution.kernel_size[0], convolution.stride[0], int(convolution.padding[0]))
            yield name, _Pass(features, output, window)
            features = output
        yield upsample_name, _Pass(features, torch.relu(upsample.convolution(features)), (1, 1, 0))
        maps.append(upsample(features))
    joined = torch.cat(maps, dim=-1).permute(0, 3, 1, 2)
    yield HEAD, _Pass(joined, joined, (1, 1, 0))


def _empty_canvas(backbone: FastBackbone, steps: CanvasSteps) -> Tensor:
    size = EMPTY_SIZE + backbone.border
    return (steps.empty * STEP_VALUE).expand(1, size, size, -1)


def _center(values: Tensor) -> Tensor:
    """Return (C,) of (1, C, H, W), far from any border; of upsampled maps the mean over the places of one cell."""
    _, _, height, width = values.shape
    return values[0, :, height // 2 :, width // 2 :][:, :4, :4].mean(dim=(1, 2))


def _count(layer: nn.Conv2d, step: Tensor) -> None:
    """Let the outputs count steps."""
    assert layer.bias is not None
    layer.weight.mul_(STEP_VALUE / step[:, None, None, None])
    layer.bias.mul_(STEP_VALUE / step)
