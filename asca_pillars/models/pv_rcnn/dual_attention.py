"""Residual dual attention on a map (AFE-RCNN, section 3.1): channels, then places, after polarized self-attention."""

import torch
from torch import Tensor, nn

_RESIDUAL_WEIGHT = 0.1  # epsilon of eq. (5)


class DualAttention(nn.Module):
    """Eq. (1)-(5) with the widths of polarized self-attention (arXiv 2107.00782).

    Args:
        channels: C of the map.
        residual: X + 0.1 O_s (eq. 5); without it O_s alone, the paper's Table 5 compares the two.
    """

    def __init__(self, channels: int, *, residual: bool) -> None:
        super().__init__()
        half = max(channels // 2, 1)
        self.residual = residual
        self.channel_value = nn.Conv2d(channels, half, 1)
        self.channel_query = nn.Conv2d(channels, 1, 1, bias=False)  # the softmax over places would not see a bias
        self.channel_out = nn.Linear(half, channels)
        self.channel_norm = nn.LayerNorm(channels)
        self.place_value = nn.Conv2d(channels, half, 1)
        self.place_query = nn.Conv2d(channels, half, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Unitless (B, C, H, W) -> the same shape."""
        attended = self.by_place(self.by_channel(features))
        return features + _RESIDUAL_WEIGHT * attended if self.residual else attended

    def by_channel(self, features: Tensor) -> Tensor:
        """Eq. (1) and (2): a weight in (0, 1) for each channel of unitless (B, C, H, W)."""
        values = self.channel_value(features).flatten(2)  # (B, C / 2, HW)
        shares = torch.softmax(self.channel_query(features).flatten(2), dim=2)  # (B, 1, HW)
        pooled = (values @ shares.transpose(1, 2))[:, :, 0]
        weights = torch.sigmoid(self.channel_norm(self.channel_out(pooled)))
        return features * weights[:, :, None, None]

    def by_place(self, features: Tensor) -> Tensor:
        """Eq. (3) and (4): a weight in (0, 1) for each place of unitless (B, C, H, W)."""
        values = self.place_value(features)  # (B, C / 2, H, W)
        shares = torch.softmax(self.place_query(features).mean(dim=(2, 3)), dim=1)  # (B, C / 2)
        return features * torch.sigmoid((values * shares[:, :, None, None]).sum(dim=1, keepdim=True))
