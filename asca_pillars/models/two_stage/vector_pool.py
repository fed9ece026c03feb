"""VectorPool (PV-RCNN++, arXiv 2102.00463; AV PV-RCNN, section 3.7): weights of its own for each cell of a cube."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.point_mlp import NORM_EPS, NORM_MOMENTUM, mlp
from asca_pillars.ops.points.neighbors import cube_cells_m

_NEAREST = 3
_LEAST_DISTANCE_M = 1e-8  # of a point that stands where a cell's center is


class VectorPool(nn.Module):
    """MLP(U_1 ; ... ; U_T) with U_t = ReLU(BatchNorm([a_i - v_t ; h_t] W_t)) for the T cells of a cube (eq. 13 to 15).

    h_t W_t is the mean, by inverse distance, of what h_i W_t is for the three points i: W_t is applied once to each
    point instead of once to each query.

    Args:
        in_channels: of a point.
        half_length_m: half the length of the cube.
        cells: of the cube along each axis, so that T = cells^3.
        cell_channels: outputs of each W_t.
        widths: of the MLP.
    """

    centers: Tensor

    def __init__(
        self, in_channels: int, half_length_m: float, cells: int, cell_channels: int, widths: Sequence[int]
    ) -> None:
        super().__init__()
        self.register_buffer("centers", torch.from_numpy(cube_cells_m(half_length_m, cells)), persistent=False)
        count = cells**3
        self.places = nn.Parameter(torch.empty(count, 3 * _NEAREST, cell_channels))
        self.features = nn.Linear(in_channels, count * cell_channels, bias=False)
        for weight in (self.places, self.features.weight):  # both are parts of W_t
            nn.init.uniform_(weight, -((3 * _NEAREST + in_channels) ** -0.5), (3 * _NEAREST + in_channels) ** -0.5)
        self.norm = nn.BatchNorm1d(count * cell_channels, eps=NORM_EPS, momentum=NORM_MOMENTUM)
        self.mlp = nn.Sequential(*mlp(count * cell_channels, widths))
        self.out_channels = widths[-1]

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Features of the queries, (Q, out_channels).

        Args:
            positions: (N, 3) of the points, metres, in the frame of the queries.
            features: (N, in_channels).
            queries: (Q, 3).
            indices: (Q, T, 3) points nearest to each cell, see `nearest_in_cubes`; N stands for nothing: zeros.
        """
        # h_i W_t of every point, cell by cell, and zeros for N
        of_points = F.pad(self.features(features), (0, 0, 0, 1)).unflatten(1, (len(self.centers), -1)).transpose(0, 1)
        padded = F.pad(positions, (0, 0, 0, 1))
        cells = [
            self._cell(self.places[cell], of_points[cell], padded, queries + self.centers[cell], indices[:, cell])
            for cell in range(len(self.centers))  # all at once they take more time and memory
        ]
        pooled: Tensor = self.mlp(torch.relu(self.norm(torch.cat(cells, dim=1))))
        return pooled

    @staticmethod
    def _cell(place: Tensor, of_points: Tensor, padded: Tensor, centers: Tensor, index: Tensor) -> Tensor:
        """[a_i - v_t ; h_t] W_t of one cell, (Q, cell_channels)."""
        found = (index < padded.shape[0] - 1).to(padded.dtype)  # (Q, 3)
        near = padded.index_select(0, index.reshape(-1)).unflatten(0, index.shape)
        away = (near - centers[:, None]) * found[..., None]  # a_i - v_t
        # Not `+`: onnxscript takes so small an addition for none.
        shares = found / away.square().sum(dim=2).sqrt().clamp(min=_LEAST_DISTANCE_M)
        shares = shares / shares.sum(dim=1, keepdim=True).clamp(min=_LEAST_DISTANCE_M)
        rows = of_points.index_select(0, index.reshape(-1)).unflatten(0, index.shape)  # (Q, 3, cell_channels)
        return away.flatten(1) @ place + (rows * shares[..., None]).sum(dim=1)
