"""Layers on point features: set abstraction (PointNet++) and VectorPool (PV-RCNN++, arXiv 2102.00463)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.ops.points.neighbors import cube_cells_m

NORM_EPS, NORM_MOMENTUM = 1e-5, 0.1  # PV-RCNN's of point features: torch's own


def mlp(in_channels: int, widths: Sequence[int], dropout: float = 0.0) -> list[nn.Module]:
    """Build Linear, BatchNorm, ReLU for each width; dropout between them."""
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


class SetAbstraction(nn.Module):
    """MLP(3 + C -> widths) on [p_j - q ; f_j] for the points j of the ball around q, then the maximum.

    The first layer is linear, so W [p_j - q ; f_j] = W [p_j ; f_j] - W [q ; 0]: once for each point and once for each
    query instead of once for each pair, exact up to rounding. It must stay in float32, because p_j and q are large and
    their difference is small.

    Args:
        in_channels: C, features of a point; may be 0.
        widths: output channels of the layers, each with BatchNorm and ReLU.
    """

    def __init__(self, in_channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        inputs = [3 + in_channels, *widths[:-1]]
        self.layers = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in zip(inputs, widths, strict=True))
        self.norms = nn.ModuleList(nn.BatchNorm1d(width, eps=NORM_EPS, momentum=NORM_MOMENTUM) for width in widths)
        self.out_channels = widths[-1]

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Return features of the queries, (Q, out_channels), see `grouped`."""
        return self.grouped(positions, features, queries, indices).max(dim=1).values

    def grouped(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Return the output of the MLP for each point of each ball, (Q, T, out_channels).

        Args:
            positions: (N, 3) of the points, metres, in the frame of the queries.
            features: (N, C).
            queries: (Q, 3).
            indices: (Q, T) points of each ball, see `ball_query`; N stands for nothing. An empty ball is a row of
                zeros, so its features are MLP(0).
        """
        first: Tensor = self.layers[0].weight  # type: ignore[assignment]  # (widths[0], 3 + C)
        points = F.linear(torch.cat([positions, features], dim=1), first)  # (N, widths[0])
        points = F.pad(points, (0, 0, 0, 1))  # row N
        found = (indices[:, :1] < positions.shape[0]).to(points.dtype)
        centers = F.linear(queries, first[:, :3]) * found  # (Q, widths[0])
        grouped = points.index_select(0, indices.reshape(-1)).unflatten(0, indices.shape) - centers[:, None]
        return self.after_first(grouped.flatten(0, 1)).unflatten(0, indices.shape)

    def after_first(self, pairs: Tensor) -> Tensor:
        """Apply the layers after the first: (Q * T, channels) -> (Q * T, channels)."""
        pairs = torch.relu(self.norms[0](pairs))
        for layer, norm in zip(self.layers[1:], self.norms[1:], strict=True):
            pairs = torch.relu(norm(layer(pairs)))
        return pairs


def first_occurrences(indices: Tensor, count: int) -> Tensor:
    """Return (Q, T) 1 for points that `ball_query` found, 0 for repetitions of the first one and for index `count`."""
    again = (indices[:, 1:] != indices[:, :1]) & (indices[:, 1:] < count)
    return torch.cat([indices[:, :1] < count, again], dim=1).float()


_NEAREST = 3
_LEAST_DISTANCE_M = 1e-8  # lower bound, for a point at a cell's center


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
        """Return features of the queries, (Q, out_channels).

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
        """Return [a_i - v_t ; h_t] W_t of one cell, (Q, cell_channels)."""
        found = (index < padded.shape[0] - 1).to(padded.dtype)  # (Q, 3)
        near = padded.index_select(0, index.reshape(-1)).unflatten(0, index.shape)
        away = (near - centers[:, None]) * found[..., None]  # a_i - v_t
        # Not `+`: onnxscript takes so small an addition for none.
        shares = found / away.square().sum(dim=2).sqrt().clamp(min=_LEAST_DISTANCE_M)
        shares = shares / shares.sum(dim=1, keepdim=True).clamp(min=_LEAST_DISTANCE_M)
        rows = of_points.index_select(0, index.reshape(-1)).unflatten(0, index.shape)  # (Q, 3, cell_channels)
        return away.flatten(1) @ place + (rows * shares[..., None]).sum(dim=1)
