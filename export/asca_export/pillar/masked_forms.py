"""A sparse neck as dense convolutions with masks: the same function of a pseudo-image, with shapes that are fixed.

Runtimes that want one shape for all scans (OpenVINO, TensorRT) and devices on which a dense convolution costs less than
gathering take this form. Masks are maximum pools of which cells hold a pillar, by the rules of
`ops.pillar.neck_rulebooks`.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_export.fast_forms import FastBackbone, Stage
from asca_pillars.models.pillar.neck import SparseRPNNeck
from asca_pillars.models.pillar.network import PillarDetector

NEVER = -1.0e4
"""Logit where no cell is active; float16 holds it."""

_LEAST = 2.0**-24
"""The smallest positive float16."""


class MarkedEncoder(nn.Module):
    """Encoder whose features are never exactly zero, so that a cell of zeros is one without a pillar."""

    def __init__(self, encode: nn.Module) -> None:
        super().__init__()
        self.encode = encode

    def forward(self, features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
        """Point features (M, 9) and their pillars -> unitless pillar features (P, C), see `PillarEncoder`."""
        encoded = self.encode(features, pillar_index, point_counts)
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
