"""Equivalent forms of the trained network that run fastest; the export proves the equivalence.

- A batch normalization after a convolution is part of its weights.
- A transposed convolution whose kernel equals its stride writes every output once: it is a 1x1 convolution to stride^2
  times the channels and a depth-to-space. Runtimes have fast code for the former of the two, and for the latter too
  when channels come last: then it moves whole runs of memory.
- The head's three 1x1 convolutions read the same map: with channels last they are one matrix product, whose results
  stay in floating point when everything before it is 8-bit.
- Bias and ReLU keep the order of numbers, so the PFN layer takes the maximum over a pillar's points before both: they
  then cost a pass over the pillars, of which there are several times fewer. The layer is a graph of its own, because a
  runtime with a compiled loop for it is faster than any graph.
- The pseudo-image comes with the first convolution's padding in it, and may come in steps of its own: scale and offset
  of each channel go into that convolution's weights. Offsets are exact because nothing is padded after them.

`MaskedBackbone` is a sparse neck as dense convolutions with masks: the same function of a pseudo-image, with shapes
that are fixed. Runtimes that want one shape for all scans (OpenVINO, TensorRT) and devices on which a dense convolution
costs less than gathering take this form. Masks are maximum pools of which cells hold a pillar, by the rules of
`ops.pillar.neck_rulebooks`.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from asca_pillars.models.map_backbone import SSDHead
from asca_pillars.models.pillar.encoder import PillarEncoder, pillar_max
from asca_pillars.models.pillar.neck import SparseRPNNeck
from asca_pillars.models.pillar.network import PillarDetector

# Value of one step of an 8-bit tensor in the graph: any number would do but one, which OpenVINO leaves out and
# then takes the tensor for a float.
STEP_VALUE = 1 / 64


class CanvasSteps(NamedTuple):
    """Quantization of a pseudo-image: its real value is scale * (step - empty), by channel."""

    scale: Tensor
    """(C,) positive."""
    empty: Tensor
    """(C,) whole numbers 0..255: the step that stands for zero."""


class NeckAndHead(Protocol):
    """A detector with blocks on a map, each followed by an upsampling, and a head of 1x1 convolutions."""

    @property
    def neck(self) -> Any:
        """The neck, with `blocks` and `deblocks`."""

    @property
    def head(self) -> Any:
        """An `SSDHead`."""


class Stage(NamedTuple):
    """One block of the neck and what brings its map back to the head's resolution, by the names of their modules."""

    convolutions: dict[str, nn.Conv2d]
    upsample_name: str
    upsample: "Upsample"


class SplitEncoder(NamedTuple):
    """An encoder as two modules, the second of which takes what the first returns for the pillars."""

    pfn: "PfnLayer"
    attention: nn.Module


def split_encoder(encode: PillarEncoder) -> SplitEncoder | None:
    """Return the encoder, in evaluation mode, split after the PFN layer; None where it cannot be split.

    Attention over points, or a pillar's empty slots, need each point's feature, not the largest alone.
    """
    if encode.point_attention is not None or encode.slots:
        return None
    return SplitEncoder(PfnLayer(encode), encode.pillar_attention or nn.Identity())


@torch.library.custom_op("asca::product_max", mutates_args=())
def product_max(features: Tensor, weight: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    """Return the maximum of `features @ weight` over the points of each pillar: (M, 9) -> (P, C), see `pillar_max`."""
    return pillar_max(features @ weight, pillar_index, point_counts)


@product_max.register_fake
def _(features: Tensor, weight: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    return features.new_empty(point_counts.shape[0], weight.shape[1])


class PfnLayer(nn.Module):
    """Linear, max over the points of a pillar, bias, ReLU; see `PillarEncoder`, which stays as it is."""

    def __init__(self, encode: PillarEncoder) -> None:
        super().__init__()
        linear = fuse_linear_bn_eval(encode.linear, encode.norm)
        self.weight, self.bias = nn.Parameter(linear.weight.T.contiguous()), linear.bias

    def forward(
        self, features: Tensor, pillar_index: Tensor, point_counts: Tensor
    ) -> tuple[Tensor, nn.Parameter, nn.Parameter]:
        """Point features (M, 9) and their pillars -> maxima (P, C), and the parameters: weight (9, C), bias (C,)."""
        largest = product_max(features, self.weight, pillar_index, point_counts)
        return torch.relu(largest + self.bias), self.weight, self.bias


class FastBackbone(nn.Module):
    """Neck and head of a trained detector as one graph in fast forms.

    Args:
        detector: in evaluation mode; not modified.
        steps: of the pseudo-image, which then holds STEP_VALUE times the step; None for real values.
        padded: whether the pseudo-image comes with the first convolution's padding.
        attention: a module after each block, if there is any.
    """

    def __init__(
        self,
        detector: NeckAndHead,
        steps: CanvasSteps | None = None,
        *,
        padded: bool = True,
        attention: Iterable[nn.Module] | None = None,
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_folded(block) for block in detector.neck.blocks)
        self.upsamples = nn.ModuleList(Upsample(deblock) for deblock in detector.neck.deblocks)
        self.attention = nn.ModuleList(attention or [nn.Identity()] * len(self.blocks))
        self.head = _Head(detector.head)
        self.border = int(padded)
        """Rows and columns of padding that the pseudo-image comes with."""
        first = next(iter(self.stages()[0].convolutions.values()))
        if padded:
            first.padding = (0, 0)
        if steps is not None:
            _fold_scale(first, steps, padded=padded)

    def stages(self) -> list[Stage]:
        """Return the blocks, from the finest map to the coarsest."""
        stages = []
        for i, (block, upsample) in enumerate(zip(self.blocks, self.upsamples, strict=True)):
            assert isinstance(block, nn.Sequential) and isinstance(upsample, Upsample)
            convolutions = {f"blocks.{i}.{j}": layer for j, layer in enumerate(block) if isinstance(layer, nn.Conv2d)}
            stages.append(Stage(convolutions, f"upsamples.{i}.convolution", upsample))
        return stages

    def forward(self, canvas: Tensor) -> tuple[Tensor, ...]:
        """Run: (1, ny + 1, nx + 1, C) -> scores (1, H, W, A), boxes (1, H, W, 7A), directions (1, H, W, 2A).

        Without padding in it the pseudo-image is (1, ny, nx, C).
        """
        features, maps = canvas.permute(0, 3, 1, 2), []
        for block, attend, upsample in zip(self.blocks, self.attention, self.upsamples, strict=True):
            features = attend(block(features))
            maps.append(upsample(features))
        return self.head(torch.cat(maps, dim=-1))


class Upsample(nn.Module):
    """Transposed convolution, normalization, ReLU -> 1x1 convolution, ReLU, depth-to-space: (1, C, H, W) -> NHWC."""

    def __init__(self, deblock: nn.Module) -> None:
        super().__init__()
        transposed, norm, _ = deblock.children()
        assert isinstance(transposed, nn.ConvTranspose2d) and isinstance(norm, nn.BatchNorm2d)
        fused = fuse_conv_bn_eval(transposed, norm, transpose=True)
        assert fused.bias is not None
        if fused.kernel_size != fused.stride:
            raise ValueError(f"kernel {fused.kernel_size} and stride {fused.stride} differ: outputs overlap")
        self.stride, self.channels = fused.stride[0], fused.out_channels
        self.convolution = nn.Conv2d(fused.in_channels, self.channels * self.stride**2, 1)
        assert self.convolution.bias is not None
        with torch.no_grad():
            weight = fused.weight.permute(2, 3, 1, 0)  # (row, column) within the stride, then channel: as written below
            self.convolution.weight.copy_(weight.reshape(-1, fused.in_channels, 1, 1))
            self.convolution.bias.copy_(fused.bias.repeat(self.stride**2))

    def forward(self, features: Tensor) -> Tensor:
        """Upsample (1, C, H, W) -> (1, stride * H, stride * W, channels)."""
        upsampled = torch.relu(self.convolution(features)).permute(0, 2, 3, 1)
        if self.stride == 1:
            return upsampled
        _, height, width, _ = upsampled.shape
        # A row of the output takes `run` values of one input cell, then those of the next.
        run = self.stride * self.channels
        rows = upsampled.reshape(height, width, self.stride, run).permute(0, 2, 1, 3)
        return rows.reshape(1, height * self.stride, width * self.stride, self.channels)


class _Head(nn.Module):
    """The head's convolutions as one matrix product: (1, H, W, C) -> its maps, channels last."""

    def __init__(self, head: SSDHead) -> None:
        super().__init__()
        weight, bias = head.joined()
        self.weight, self.bias = nn.Parameter(weight.T.contiguous()), nn.Parameter(bias)
        self.channels = head.channels

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        # Adding the biases behind the split keeps onnxruntime from joining product and sum into a float-only operator.
        maps = torch.split(features @ self.weight, self.channels, dim=-1)
        return tuple(part + bias for part, bias in zip(maps, self.bias.split(self.channels), strict=True))


def _folded(block: nn.Module) -> nn.Sequential:
    """Fold normalizations into convolutions: convolution, ReLU, ..."""
    children, layers = list(block.children()), []
    for convolution, norm in zip(children[0::3], children[1::3], strict=True):
        assert isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
        layers += [fuse_conv_bn_eval(convolution, norm), nn.ReLU()]
    return nn.Sequential(*layers)


def _fold_scale(first: nn.Conv2d, steps: CanvasSteps, *, padded: bool) -> None:
    """Let the first convolution read steps."""
    assert first.bias is not None
    assert padded or not steps.empty.any(), "a convolution pads with zeros"
    with torch.no_grad():
        first.weight.mul_(steps.scale[:, None, None] / STEP_VALUE)
        first.bias.sub_((first.weight * steps.empty[:, None, None]).sum(dim=(1, 2, 3)) * STEP_VALUE)


NEVER = -1.0e4
"""Logit where no cell is active; float16 holds it."""

_LEAST = 2.0**-24
"""The smallest positive float16."""


class MarkedEncoder(nn.Module):
    """Encoder whose features are never exactly zero, so that a cell of zeros is one without a pillar."""

    def __init__(self, encode: nn.Module) -> None:
        super().__init__()
        self.encode = encode

    def forward(self, *inputs: Tensor) -> Tensor:
        """Inputs of the encoder -> pillar features (P, C), see `PillarEncoder`."""
        encoded = self.encode(*inputs)
        return torch.where(encoded == 0, _LEAST, encoded)


class MaskedBackbone(nn.Module):
    """Neck and head of a detector with a sparse neck on a pseudo-image of features that `MarkedEncoder` gives.

    Args:
        detector: in evaluation mode; not modified.
    """

    def __init__(self, detector: PillarDetector) -> None:
        super().__init__()
        assert isinstance(detector.neck, SparseRPNNeck)
        self.rule = detector.neck.rule
        self.dense = FastBackbone(detector)
        self.border = self.dense.border

    def stages(self) -> list[Stage]:
        """Return the stages of `FastBackbone`."""
        return self.dense.stages()

    def forward(self, canvas: Tensor) -> tuple[Tensor, ...]:
        """Unitless (1, ny + 1, nx + 1, C) -> scores, boxes and directions as `FastBackbone`, scores NEVER elsewhere."""
        active = (canvas.abs().amax(dim=-1) > 0).to(canvas.dtype)[:, None]  # (1, 1, ny + 1, nx + 1)
        features, maps, seen = canvas.permute(0, 3, 1, 2), [], []
        for number, stage in enumerate(self.stages()):
            for index, convolution in enumerate(stage.convolutions.values()):
                if index == 0:
                    active = F.max_pool2d(active, 3, stride=2, padding=min(number, 1))  # the first's is in the canvas
                    cells = active
                elif index == 1 and number == 0 and self.rule == "fine":
                    cells = F.max_pool2d(active, 3, stride=1, padding=1)  # the coarser levels do not see the growth
                features = torch.relu(convolution(features)) * cells
            seen.append(_repeated(cells, stage.upsample.stride))
            maps.append(stage.upsample(features) * seen[-1])
        scores, *others = self.dense.head(torch.cat(maps, dim=-1))
        return torch.where(torch.cat(seen, dim=-1).amax(dim=-1, keepdim=True) > 0, scores, NEVER), *others


def _repeated(cells: Tensor, stride: int) -> Tensor:
    """Repeat each cell of a mask for the head cells below it: (1, 1, H, W) -> (1, stride * H, stride * W, 1)."""
    _, _, height, width = cells.shape
    wide = cells[0, 0, :, None, :, None].expand(height, stride, width, stride)
    return wide.reshape(1, height * stride, width * stride, 1)
