"""Fully connected layers on rows of point features, each with its normalization."""

from collections.abc import Sequence

from torch import nn

NORM_EPS, NORM_MOMENTUM = 1e-5, 0.1  # PV-RCNN's of point features: torch's own


def mlp(in_channels: int, widths: Sequence[int], dropout: float = 0.0) -> list[nn.Module]:
    """Linear, BatchNorm, ReLU for each width; dropout between them."""
    layers: list[nn.Module] = []
    for width in widths:
        if layers and dropout:
            layers.append(nn.Dropout(dropout))
        layers += [
            nn.Linear(in_channels, width, bias=False),
            nn.BatchNorm1d(width, eps=NORM_EPS, momentum=NORM_MOMENTUM),
            nn.ReLU(),
        ]
        in_channels = width
    return layers
