"""Detection head: single-shot (SSD), one 1x1 convolution per output (section 3.1 and 3.4 of the paper)."""

import math

import torch
from torch import Tensor, nn

from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.row_product import linear_rows

POSITIVE_PRIOR = 0.01  # what an untrained head says of every anchor: focal loss starts calm (arXiv 1708.02002, 4.1)


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
        """(B, C, H, W) -> scores (B, A, H, W), boxes (B, 7A, H, W), directions (B, 2A, H, W).

        With several scores per anchor there are so many times A of them, those of an anchor side by side.
        """
        return HeadMaps(self.scores(features), self.boxes(features), self.directions(features))

    def at_cells(self, features: Tensor) -> HeadMaps[Tensor]:
        """The same at single cells: (M, C) -> scores (M, A), boxes (M, 7A), directions (M, 2A)."""
        joined = linear_rows(features, *self.joined())  # one product and one gradient of the features instead of three
        return HeadMaps(*joined.split(self.channels, dim=1))

    @property
    def channels(self) -> list[int]:
        """Of scores, boxes and directions."""
        return [part.out_channels for part in (self.scores, self.boxes, self.directions)]

    def joined(self) -> tuple[Tensor, Tensor]:
        """The three convolutions as one product: weight (outputs, C) and bias (outputs,), split by `channels`."""
        parts = self.scores, self.boxes, self.directions
        weight = torch.cat([part.weight[:, :, 0, 0] for part in parts])
        return weight, torch.cat([part.bias for part in parts if part.bias is not None])
