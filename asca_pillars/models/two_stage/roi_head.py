"""RoI-grid pooling and the heads of the second stage (PV-RCNN, section 3.3 and 3.4)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from asca_pillars.models.two_stage.point_mlp import mlp
from asca_pillars.models.two_stage.set_abstraction import SetAbstraction
from asca_pillars.models.two_stage.vector_pool import VectorPool


class RoiHead(nn.Module):
    """Keypoints around the grid points of each proposal -> its confidence and its residuals.

    Args:
        pools: what aggregates the keypoints around a grid point, one for each radius.
        grid_size: grid points along each axis of a box.
        roi_channels: of what is known of a proposal besides, appended to its pooled features.
        hidden: channels of the fully connected layers.
        dropout: between them.
    """

    def __init__(
        self,
        pools: Sequence[SetAbstraction | VectorPool],
        grid_size: int,
        roi_channels: int,
        hidden: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.cells = grid_size**3
        self.pools = nn.ModuleList(pools)
        pooled = sum(pool.out_channels for pool in pools)
        self.shared = nn.Sequential(*mlp(self.cells * pooled, [hidden, hidden], dropout))
        joined = hidden + roi_channels
        self.confidence = nn.Sequential(*mlp(joined, [hidden, hidden], dropout), nn.Linear(hidden, 1))
        self.residuals = nn.Sequential(*mlp(joined, [hidden, hidden], dropout), nn.Linear(hidden, 7))
        # An untrained head leaves proposals where they are.
        nn.init.normal_(self.residuals[-1].weight, std=0.001)  # type: ignore[arg-type]
        nn.init.zeros_(self.residuals[-1].bias)  # type: ignore[arg-type]

    def forward(
        self,
        keypoints: Tensor,
        features: Tensor,
        grid_points: Tensor,
        indices: Sequence[Tensor],
        roi_features: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Confidence logits (R,) and residuals (R, 7), see `encode_refinement`.

        Args:
            keypoints: (K, 3).
            features: (K, C).
            grid_points: (R * cells, 3), see `roi_grid_points`.
            indices: of each radius (R * cells, T) or, for VectorPool, (R * cells, T, 3) keypoints.
            roi_features: (R, roi_channels); None where there are no such channels.
        """
        pooled = [
            pool(keypoints, features, grid_points, index) for pool, index in zip(self.pools, indices, strict=True)
        ]
        grid = torch.cat(pooled, dim=1)  # (R * cells, C)
        shared = self.shared(grid.reshape(-1, self.cells * grid.shape[1]))
        joined = shared if roi_features is None else torch.cat([shared, roi_features], dim=1)
        return self.confidence(joined)[:, 0], self.residuals(joined)
