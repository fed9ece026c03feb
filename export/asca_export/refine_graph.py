"""The second stage as an ONNX graph, its normalization folded into the layers before it."""

import copy
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from asca_deploy.refine_pipeline import OUTPUTS
from asca_export.graphs import export_graph
from asca_pillars.models.refine.pillar_refiner import PillarRefiner, RefineInputs
from asca_pillars.models.refine.set_abstraction import SetAbstraction
from asca_pillars.models.refine.vector_pool import VectorPool
from asca_pillars.points.refine_geometry import ROI_FEATURES, RefineSettings

M = TypeVar("M", bound=nn.Module)


class Shift(nn.Module):
    """What is left of a normalization whose scale has gone into the weights before it: (rows, C) + (C,)."""

    def __init__(self, shift: Tensor) -> None:
        super().__init__()
        self.shift = nn.Parameter(shift, requires_grad=False)

    def forward(self, rows: Tensor) -> Tensor:
        """Add the shift."""
        return rows + self.shift


def fold_norms(network: M) -> M:
    """A copy without normalization of point features that computes the same in evaluation mode."""
    folded = copy.deepcopy(network).eval()
    with torch.no_grad():
        for module in folded.modules():
            if isinstance(module, SetAbstraction):
                for index, norm in enumerate(module.norms):
                    module.norms[index] = _fold(module.layers[index], norm)  # type: ignore[arg-type]
            elif isinstance(module, VectorPool):
                module.norm = _fold_vectors(module)  # type: ignore[assignment]
            elif isinstance(module, nn.Sequential):
                for index in range(1, len(module)):
                    if isinstance(norm := module[index], nn.BatchNorm1d):
                        module[index] = _fold(module[index - 1], norm)  # type: ignore[arg-type]
    return folded


def _fold(layer: nn.Linear, norm: nn.BatchNorm1d) -> Shift:
    scale, shift = _scale_and_shift(norm)
    layer.weight *= scale[:, None]
    return Shift(shift)


def _fold_vectors(pool: VectorPool) -> Shift:
    scale, shift = _scale_and_shift(pool.norm)
    pool.features.weight *= scale[:, None]
    pool.places.mul_(scale.view(len(pool.places), 1, -1))
    return Shift(shift)


def _scale_and_shift(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    assert norm.running_var is not None and norm.running_mean is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return scale, norm.bias - norm.running_mean * scale


class _Flat(nn.Module):
    """The second stage with one argument for each input of the graph."""

    def __init__(self, refiner: PillarRefiner, balls: int) -> None:
        super().__init__()
        self.refiner, self.balls = refiner, balls

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """(R,) confidence logits and (R, 7) residuals."""
        points, keypoints, bev, *indices, roi_features = inputs
        balls, grid_points, grids = indices[: self.balls], indices[self.balls], indices[self.balls + 1 :]
        found = self.refiner(
            RefineInputs(points, keypoints, bev, tuple(balls), grid_points, tuple(grids), roi_features)
        )
        return found.confidence, found.residuals


def export_refine(
    refiner: PillarRefiner, settings: RefineSettings, bev_channels: int, classes: int, path: Path
) -> None:
    """Write refine.onnx: see `asca_deploy.refine_pipeline.refine_interface`; every number of rows is dynamic."""
    points, keypoints, rois = 24, 6, 3  # sizes of the example that the tracer sees; none is kept
    cells = settings.grid_size**3
    rng = np.random.default_rng(0)

    def indices(rows: int, samples: int, among: int) -> Tensor:
        return torch.from_numpy(rng.integers(0, among + 1, (rows, samples)).astype(np.int32))

    balls, grids = len(settings.ball_radii_m), len(settings.grid_radii_m)
    example = (
        torch.rand(points, 4),
        torch.rand(keypoints, 3),
        torch.rand(keypoints, bev_channels),
        *(indices(keypoints, settings.ball_samples, points) for _ in range(balls)),
        torch.rand(rois * cells, 3),
        *(indices(rois * cells, settings.grid_samples, keypoints) for _ in range(grids)),
        torch.rand(rois, classes + ROI_FEATURES),
    )
    n, k, r = (torch.export.Dim(name) for name in ("point_rows", "keypoint_rows", "proposal_rows"))
    rows = [n, k, k, *[k] * balls, cells * r, *[cells * r] * grids, r]
    names = ["points", "keypoints", "bev", *(f"ball_{i}" for i in range(balls)), "grid_points"]
    export_graph(
        _Flat(fold_norms(refiner), balls),
        example,
        path,
        input_names=[*names, *(f"grid_{i}" for i in range(grids)), "roi_features"],
        output_names=list(OUTPUTS),
        dynamic_shapes=(tuple({0: size} for size in rows),),
    )
