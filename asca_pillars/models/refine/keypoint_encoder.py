"""Features of keypoints: voxel set abstraction's raw points and map, and keypoint weighting (PV-RCNN, 3.2, 3.3)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from asca_pillars.models.refine.set_abstraction import NORM_EPS, NORM_MOMENTUM, SetAbstraction


class KeypointEncoder(nn.Module):
    """Raw points around a keypoint at several radii, and the first stage's map under it, fused and weighted.

    Args:
        point_channels: of a raw point besides its position: 1, reflectance.
        bev_channels: of the first stage's map.
        radii: how many balls around each keypoint.
        widths: of the MLP of each ball.
        out_channels: of the fused feature.
    """

    def __init__(
        self, point_channels: int, bev_channels: int, radii: int, widths: Sequence[int], out_channels: int
    ) -> None:
        super().__init__()
        self.balls = nn.ModuleList(SetAbstraction(point_channels, widths) for _ in range(radii))
        joined = radii * widths[-1] + bev_channels
        self.fuse = nn.Sequential(*mlp(joined, [out_channels]))
        self.weigh = nn.Sequential(*mlp(joined, [out_channels, out_channels]), nn.Linear(out_channels, 1))
        self.out_channels = out_channels

    def forward(
        self, points: Tensor, keypoints: Tensor, bev: Tensor, indices: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Weighted features (K, out_channels), and logits (K,) of a keypoint's being part of an object.

        Args:
            points: (N, 3 + point_channels).
            keypoints: (K, 3).
            bev: (K, bev_channels) the map at the keypoints.
            indices: of each radius (K, T) points.
        """
        found = [
            ball(points[:, :3], points[:, 3:], keypoints, index)
            for ball, index in zip(self.balls, indices, strict=True)
        ]
        joined = torch.cat([*found, bev], dim=1)
        logits = self.weigh(joined)
        return self.fuse(joined) * torch.sigmoid(logits), logits[:, 0]


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
