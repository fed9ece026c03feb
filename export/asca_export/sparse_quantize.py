"""The sparse backbone in 8 bits, as `quantize` does it for the dense one; here no empty space has to be rounded.

A channel's step is its largest value on the calibration scans / 255. Weights are rounded together (GPTQ), and the bias
makes up for what rounding changes in the mean. The head's weights are rounded for the cells with the highest scores,
which boxes are decoded from.
"""

import copy
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor, nn

from asca_export.fast_forms import STEP_VALUE, CanvasSteps
from asca_export.quantize import HEAD, PLACES, STEPS, TINY, round_together
from asca_export.sparse_forms import SparseBackbone
from asca_pillars.ops.pillar.neck_rulebooks import NeckRulebooks

BEST_CELLS = 32  # highest-scoring cells of each scan and anchor for rounding the head
OTHER_CELLS = 64  # other cells of each scan, so that background scores stay low


class SparseSample(NamedTuple):
    """Inputs of the backbone for one scan."""

    features: Tensor
    """(P, C) pillar features."""
    rulebooks: NeckRulebooks[Tensor]

    def quantize_features(self, steps: CanvasSteps) -> "SparseSample":
        """Return the sample with features rounded to whole steps, times STEP_VALUE."""
        whole = (self.features / steps.scale + steps.empty).round().clamp(0, STEPS)
        return self._replace(features=whole * STEP_VALUE)


class RowProducts(Protocol):
    """Matrix products by name, one after the other."""

    products: nn.ModuleDict

    def product(self, name: str) -> nn.Linear:
        """Return the product of this name."""

    def passes(self, *sample: Any) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield name, input (M, n) and output (M, outputs) of each product in turn, unitless."""


Backbone = TypeVar("Backbone", bound=RowProducts)


class InputMoments(NamedTuple):
    """Moments of a product's inputs: mean (n,), and mean product of the differences from it (n, n)."""

    mean: Tensor
    squares: Tensor


@torch.no_grad()
def scale_rows_to_steps(backbone: SparseBackbone, samples: Iterable[SparseSample]) -> None:
    """Change the weights so that rows count steps, 0 to 255 times STEP_VALUE; the results stay the same.

    Args:
        backbone: made with the steps of the samples; changed in place.
        samples: of the calibration scans, in steps.
    """
    highest = highest_outputs(backbone, samples)
    head, first_channel = backbone.product(HEAD), 0
    names = [[layer.name for layer in level.convolutions] for level in backbone.levels]
    for number, level in enumerate(backbone.levels):
        following = [*names[number][1:], None]
        for name, next_name in zip(names[number], following, strict=True):
            step = highest[name].clamp_min(TINY) / STEPS
            count_steps(backbone.product(name), step)
            readers = [next_name] if next_name else [level.upsample, *(block[0] for block in names[number + 1 :][:1])]
            for reader in readers:
                weight = backbone.product(reader).weight
                weight.view(len(weight), -1, len(step)).mul_(step / STEP_VALUE)
        channels = len(highest[level.upsample]) // level.stride**2  # the places of a channel end up in one column
        step = highest[level.upsample].view(-1, channels).amax(dim=0).clamp_min(TINY) / STEPS
        count_steps(backbone.product(level.upsample), step.repeat(level.stride**2))
        head.weight[:, first_channel : first_channel + channels] *= step / STEP_VALUE
        first_channel += channels


def highest_outputs(backbone: RowProducts, samples: Iterable[tuple[Any, ...]]) -> dict[str, Tensor]:
    """Return the largest value (C,) of each channel of what every product gives, by name; at least 0."""
    highest: dict[str, Tensor] = {}
    for sample in samples:
        for name, _, output in backbone.passes(*sample):
            before = highest.get(name, output.new_zeros(output.shape[1]))
            highest[name] = torch.cat([output, before[None]]).amax(dim=0)
    return highest


@torch.no_grad()
def read_moments(
    backbone: RowProducts, samples: Sequence[tuple[Any, ...]], places: int = PLACES
) -> dict[str, InputMoments]:
    """Return moments of what every product reads on the calibration scans, at so many places of each at most.

    A head's are those of the cells with its highest scores, and of a few others.
    """
    generator = torch.Generator().manual_seed(0)
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for sample in samples:
        for name, read, output in backbone.passes(*sample):
            chosen = torch.randperm(len(read), generator=generator)[:places]
            if name == HEAD and isinstance(backbone, SparseBackbone):
                scores = output[:, : backbone.head_channels[0]]
                best = scores.topk(min(BEST_CELLS, len(scores)), dim=0).indices.flatten()
                chosen = torch.cat([best, chosen[:OTHER_CELLS]])
            rows = read[chosen].double()
            mean, squares = rows.sum(dim=0) / max(len(rows), 1), rows.T @ rows / max(len(rows), 1)
            before = sums.get(name, (torch.zeros_like(mean), torch.zeros_like(squares)))
            sums[name] = before[0] + mean / len(samples), before[1] + squares / len(samples)
    return {
        name: InputMoments(mean.float(), (squares - torch.outer(mean, mean)).float())
        for name, (mean, squares) in sums.items()
    }


@torch.no_grad()
def round_products(backbone: RowProducts, layers: Collection[str], moments: dict[str, InputMoments]) -> None:
    """Round the weights of `layers` to what 8-bit arithmetic will use, in place."""
    for name in layers:
        product = backbone.product(name)
        rounded = round_together(product.weight, moments[name].squares)
        product.bias.add_((product.weight - rounded) @ moments[name].mean)
        product.weight.copy_(rounded)


def mixed_products(exact: Backbone, rounded: Backbone, eight_bit: Iterable[str]) -> Backbone:
    """Return a copy of `exact` with the rounded products of these names."""
    mixed = copy.deepcopy(exact)
    for name in eight_bit:
        mixed.products[name] = rounded.products[name]
    return mixed


def count_steps(product: nn.Linear, step: Tensor) -> None:
    """Let the outputs count unitless steps (outputs,), STEP_VALUE for each."""
    product.weight.mul_(STEP_VALUE / step[:, None])
    product.bias.mul_(STEP_VALUE / step)
