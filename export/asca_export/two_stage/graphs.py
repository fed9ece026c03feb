"""The second stage as an ONNX graph, in the forms that run fastest, and what 8 bits change in it."""

import copy
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)
from torch.nn.utils.fusion import fuse_linear_bn_eval

from asca_deploy.bundle import RefineSection
from asca_deploy.two_stage.pipeline import grid_names, refine_interface
from asca_export.graphs import export_row_graph
from asca_export.sparse_forms import scale_and_shift
from asca_pillars.models.two_stage.layers import PillarRefiner, SetAbstraction, SourceRows, VectorPool
from asca_pillars.ops.points.neighbors import BallGroup, GroupedBalls
from asca_pillars.ops.two_stage.prepare import RefineSettings


class _Layers(nn.Module):
    """The layers of a trained `SetAbstraction` with their normalization in them; not modified."""

    def __init__(self, trained: SetAbstraction) -> None:
        super().__init__()
        layers = [_folded(*pair) for pair in zip(trained.layers, trained.norms, strict=True)]
        self.layers = nn.ModuleList(layers)
        self.first, self.last = layers[0], layers[-1]
        self.out_channels = trained.out_channels

    def after_first(self, pairs: Tensor) -> Tensor:
        """Apply the layers after the first, up to the last one's shift: (pairs, channels) -> (pairs, channels)."""
        for layer in self.layers[1:-1]:
            pairs = layer(torch.relu(pairs))
        return torch.relu(pairs) @ self.last.weight.T if len(self.layers) > 1 else pairs

    def first_bias(self) -> Tensor | None:
        """Return the first layer's bias; None if that layer is the last one too."""
        return self.first.bias if len(self.layers) > 1 else None


class GatheredSetAbstraction(_Layers):
    """Set abstraction on balls whose points have been gathered; points have fewer channels than the first output."""

    def forward(self, _positions: None, _features: None, _queries: Tensor, balls: Tensor) -> Tensor:
        """Aggregate [p_j - q ; f_j] of each ball, (Q, T, 3 + C), zeros for empty entries, -> (Q, out_channels)."""
        pairs = F.linear(balls.flatten(0, 1), self.first.weight, self.first_bias())
        largest = self.after_first(pairs).unflatten(0, balls.shape[:2]).amax(dim=1)
        return torch.relu(largest + self.last.bias)


class GroupedSetAbstraction(_Layers):
    """Set abstraction on grouped balls (`ops.points.neighbors`): the first layer runs once per point and query."""

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, balls: GroupedBalls[Tensor]) -> Tensor:
        """Compute `SetAbstraction.forward`: (Q, out_channels)."""
        # Both get a row for nothing: zeros, and the first layer's shift alone.
        points = F.pad(torch.cat([positions, features], dim=1), (0, 0, 0, 1)) @ self.first.weight.T
        away = F.linear(F.pad(queries, (0, 0, 0, 1)), -self.first.weight[:, :3], self.first_bias())
        largest = []
        for group in balls.groups:
            queries_of_pairs = group.queries[:, None].expand(group.members.shape)  # adding row by row takes longer
            pairs = points.index_select(0, group.members.flatten()) + away.index_select(0, queries_of_pairs.flatten())
            largest.append(self.after_first(pairs).unflatten(0, group.members.shape).amax(dim=1))
        return torch.relu(torch.cat(largest).index_select(0, balls.rows) + self.last.bias)


def _folded(layer: nn.Module, norm: nn.Module) -> nn.Linear:
    assert isinstance(layer, nn.Linear) and isinstance(norm, nn.BatchNorm1d)
    return fuse_linear_bn_eval(layer, norm)


M = TypeVar("M", bound=nn.Module)


class Shift(nn.Module):
    """Shift of a normalization whose scale is folded into the preceding weights: (rows, C) + (C,)."""

    def __init__(self, shift: Tensor) -> None:
        super().__init__()
        self.shift = nn.Parameter(shift, requires_grad=False)

    def forward(self, rows: Tensor) -> Tensor:
        """Add the shift."""
        return rows + self.shift


def fold_norms(network: M) -> M:
    """Return a copy without normalization of point features that computes the same in evaluation mode."""
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
                        module[index - 1] = fuse_linear_bn_eval(module[index - 1], norm)  # type: ignore[type-var]
                        module[index] = nn.Identity()
    return folded


def _fold(layer: nn.Linear, norm: nn.BatchNorm1d) -> Shift:
    scale, shift = scale_and_shift(norm)
    layer.weight *= scale[:, None]
    return Shift(shift)


def _fold_vectors(pool: VectorPool) -> Shift:
    scale, shift = scale_and_shift(pool.norm)
    pool.features.weight *= scale[:, None]
    pool.places.mul_(scale.view(len(pool.places), 1, -1))
    return Shift(shift)


class _Flat(nn.Module):
    """The second stage in fast forms, with one argument for each of `inputs`, the names of the graph's."""

    def __init__(self, refiner: PillarRefiner, settings: RefineSettings, inputs: list[str]) -> None:
        super().__init__()
        fast = fold_norms(refiner)
        fast.encode.balls = nn.ModuleList(map(GatheredSetAbstraction, _set_abstractions(refiner.encode.balls)))
        fast.head.pools = nn.ModuleList(map(GroupedSetAbstraction, _set_abstractions(refiner.head.pools)))
        self.refiner, self.settings, self.inputs = fast, settings, inputs

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return (R,) confidence logits and (R, 7) residuals."""
        named: Any = dict(zip(self.inputs, inputs, strict=True))
        keypoints = named["keypoints"]
        balls = [named[f"ball_{number}"] for number in range(len(self.settings.ball_radii_m))]
        gathered: Any = SourceRows(None, None)  # type: ignore[arg-type]
        features, _ = self.refiner.encode([gathered], keypoints, named["bev"], balls)
        grids = [
            GroupedBalls(
                tuple(BallGroup(*(named[name] for name in group)) for group in names.groups), named[names.rows]
            )
            for names in _grids(self.settings)
        ]
        confidence, residuals = self.refiner.head(
            keypoints, features, named["grid_points"], grids, named["roi_features"]
        )
        return confidence, residuals


def _grids(settings: RefineSettings) -> list[GroupedBalls[str]]:
    return [grid_names(number, settings.grid_samples) for number in range(len(settings.grid_radii_m))]


def _set_abstractions(modules: nn.ModuleList) -> list[SetAbstraction]:
    layers = [module for module in modules if isinstance(module, SetAbstraction)]
    assert len(layers) == len(modules)
    return layers


def export_refine(refiner: PillarRefiner, section: RefineSection, classes: int, path: Path) -> None:
    """Write refine.onnx: see `asca_deploy.two_stage.pipeline.refine_interface`; every number of rows is dynamic."""
    settings, (inputs, outputs) = section.neighbors, refine_interface(section, classes)
    rows = dict.fromkeys(inputs, "keypoints") | {"roi_features": "proposals", "grid_points": "proposals"}
    for names in _grids(settings):
        rows[names.rows] = "proposals"
        for group in names.groups:
            rows |= dict.fromkeys(group, group.queries)
    of_cells = dict.fromkeys(("grid_points", *(names.rows for names in _grids(settings))), settings.grid_size**3)
    export_row_graph(_Flat(refiner, settings, list(inputs)), path, inputs, rows, outputs, of_cells)


def scale_bev(refine: onnx.ModelProto, factors: NDArray[np.float32]) -> onnx.ModelProto:
    """Return a copy of the second stage's graph whose input `bev` is multiplied by `factors` (C,) first."""
    model = onnx.ModelProto()
    model.CopyFrom(refine)
    for node in model.graph.node:
        node.input[:] = ["bev.values" if name == "bev" else name for name in node.input]
    model.graph.initializer.append(numpy_helper.from_array(factors, "bev.factors"))
    model.graph.node.insert(0, helper.make_node("Mul", ["bev", "bev.factors"], ["bev.values"], name="bev.values"))
    onnx.checker.check_model(model)
    return model


_LARGE = 4096  # weights; the small matrices multiply positions, which rounded weights would move by centimetres


def halve_matrices(refine: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of the second stage's graph whose large matrices are stored as float16.

    The runtime casts them back once, when it opens the graph, and computes in float32.
    """
    model = onnx.ModelProto()
    model.CopyFrom(refine)
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype == np.float32 and values.ndim == 2 and values.size >= _LARGE:
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
            model.graph.node.insert(0, helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    onnx.checker.check_model(model)
    return model
