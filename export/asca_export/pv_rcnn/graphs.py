"""PV-RCNN as four ONNX graphs, normalization folded into the layers before it; nothing is scattered in them.

The sparse backbone over voxels is a chain of matrix products, in 8 bits too. Its first product reads positions in
metres and stays in floating point.
"""

import copy
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from onnx import TensorProto
from torch import Tensor, nn

from asca_deploy.bundle import BACKBONE, DEFORM, KEYPOINTS, REFINE, VOXELS, PvRcnnBundle
from asca_deploy.graph import Tensor as Declared
from asca_deploy.pv_rcnn import graphs as interfaces
from asca_deploy.pv_rcnn.graphs import OUT, VOXEL_VALUES
from asca_export.fast_forms import STEP_VALUE, FastBackbone
from asca_export.graphs import export_backbone, export_row_graph, graph_path
from asca_export.quantize import STEPS, TINY
from asca_export.sparse_forms import (
    RowGraph,
    count_steps,
    highest_outputs,
    linear,
    mixed_products,
    read_moments,
    round_products,
    scale_and_shift,
)
from asca_export.two_stage.graphs import fold_norms
from asca_pillars.models.pv_rcnn.layers import PvRcnn, SparseConvBlock, Surroundings, VoxelBackbone
from asca_pillars.models.two_stage.layers import RoiHead, SourceRows
from asca_pillars.ops.points.neighbors import PointScale
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES, SourceBalls, VoxelSetSettings

_PLACES = 1000  # samples of each scan and layer for rounding weights; with 27 taps their product is expensive


class VoxelSample(NamedTuple):
    """Inputs of the backbone for one scan."""

    features: Tensor
    """(N, 4) of the voxels, metres and reflectance."""
    rulebooks: Mapping[str, Tensor]
    """Rulebooks by the names of the graph's inputs."""


class VoxelProduct(NamedTuple):
    """A sparse convolution, followed by a ReLU."""

    name: str
    rulebook: str
    """The input of the graph that it gathers by."""
    level: str
    """Level of its outputs: conv1 to conv4, or OUT."""


class VoxelProducts(nn.Module):
    """A trained `VoxelBackbone` as matrix products by name, normalization in their weights.

    Args:
        backbone: not modified.
    """

    def __init__(self, backbone: VoxelBackbone) -> None:
        super().__init__()
        self.products, self.layers = nn.ModuleDict(), list[VoxelProduct]()
        for number, level in enumerate((*LEVEL_SOURCES, OUT)):
            convolutions = [(f"strided_{number}", backbone.down[number - 1])] if number else []
            if number < len(backbone.same):
                convolutions += [(f"same_{number}", layer) for layer in backbone.same[number].children()]
            for index, (rulebook, layer) in enumerate(convolutions):
                assert isinstance(layer, SparseConvBlock)
                self.layers.append(VoxelProduct(f"{level}_{index}", rulebook, level))
                self.products[self.layers[-1].name] = _folded(layer)

    def product(self, name: str) -> nn.Linear:
        """Return the product of this name: weight (outputs, taps * C) with the channels of a tap side by side."""
        product = self.products[name]
        assert isinstance(product, nn.Linear)
        return product

    def last_of(self, level: str) -> str:
        """Return the name of the last layer of this level."""
        return [layer.name for layer in self.layers if layer.level == level][-1]

    def passes(self, features: Tensor, rulebooks: Mapping[str, Tensor]) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield name, input (M, taps * C) and output (M, outputs) of each product in turn."""
        for layer in self.layers:
            padded = torch.cat([features, features.new_zeros(1, features.shape[1])])
            read = padded[rulebooks[layer.rulebook].long()].flatten(1)
            features = torch.relu(self.product(layer.name)(read))
            yield layer.name, read, features


class RoundedVoxels:
    """The backbone before and after its weights are rounded, see `int8.RoundedBackbone`.

    Args:
        backbone: in evaluation mode; not modified.
        samples: of the calibration scans, none of them empty.
        levels: what the graph returns.
    """

    def __init__(self, backbone: VoxelBackbone, samples: Sequence[VoxelSample], levels: Sequence[str]) -> None:
        self._exact, self._levels = VoxelProducts(backbone), levels
        self.steps = scale_voxels_to_steps(self._exact, samples)
        """(C,) value of a step of each product's output."""
        self._rounded = copy.deepcopy(self._exact)
        self.layers = [layer.name for layer in self._exact.layers[1:]]
        round_products(self._rounded, self.layers, read_moments(self._exact, samples, _PLACES))

    @property
    def out_steps(self) -> Tensor:
        """(C,) value of a step of the last level."""
        return self.steps[self._exact.last_of(OUT)]

    def write(self, path: Path, eight_bit: Sequence[str]) -> None:
        """Write the graph with these layers in 8 bits."""
        mixed = mixed_products(self._exact, self._rounded, eight_bit)
        export_voxels(mixed, path, self._levels, eight_bit, self.steps)


@torch.no_grad()
def scale_voxels_to_steps(backbone: VoxelProducts, samples: Sequence[VoxelSample]) -> dict[str, Tensor]:
    """Change the weights so that rows count steps, 0 to 255 times STEP_VALUE; return the value of a step.

    Args:
        backbone: changed in place.
        samples: of the calibration scans.

    Returns:
        (C,) of each product's outputs.
    """
    highest = highest_outputs(backbone, samples)
    steps = {name: high.clamp_min(TINY) / STEPS for name, high in highest.items()}
    names = [layer.name for layer in backbone.layers]
    for name, following in zip(names, [*names[1:], None], strict=True):
        count_steps(backbone.product(name), steps[name])
        if following:
            weight = backbone.product(following).weight
            weight.view(len(weight), -1, len(steps[name])).mul_(steps[name] / STEP_VALUE)
    return steps


def export_voxels(
    backbone: VoxelProducts,
    path: Path,
    levels: Collection[str],
    eight_bit: Collection[str] = (),
    steps: Mapping[str, Tensor] | None = None,
) -> None:
    """Write voxels.onnx: voxel features (N, 4) and the int32 rulebooks -> features (M, C) of every level that is read.

    Args:
        backbone: scaled to steps, if there are `steps`.
        path: of the file.
        levels: the graph's outputs, real values in float32; of OUT uint8 steps, if there are any.
        eight_bit: products that compute in 8 bits, their weights already rounded; others in float.
        steps: rows behind the first product are uint8, a step worth this (C,).
    """
    graph, counted = RowGraph(backbone.product, eight_bit), steps is not None
    rows = graph.add_input("features", TensorProto.FLOAT, "voxels", VOXEL_VALUES)
    missing = np.zeros(VOXEL_VALUES, np.float32)
    for number, layer in enumerate(backbone.layers):
        product = backbone.product(layer.name)
        read = graph.gather(layer.name, rows, missing, layer.rulebook, product.in_features // len(missing))
        results = graph.product(layer.name, read, steps=counted and number > 0)
        rows = graph.relu(layer.name, results, steps=counted)
        missing = np.zeros(product.out_features, np.uint8 if counted else np.float32)
        if layer.level not in levels or layer.name != backbone.last_of(layer.level):
            continue
        if steps is None or layer.level == OUT:
            graph.named("Identity", [layer.level], rows)
        else:
            factors = graph.constant(layer.name, "factors", (steps[layer.name] / STEP_VALUE).numpy())
            graph.named("Mul", [layer.level], graph.in_float(layer.name, "level", rows), factors)
        kind = TensorProto.UINT8 if counted and layer.level == OUT else TensorProto.FLOAT
        graph.add_output(layer.level, kind, f"{layer.level}_voxels", product.out_features)
    graph.save(path, "voxels")


def _folded(layer: SparseConvBlock) -> nn.Linear:
    weight, (scale, shift) = layer.convolution.weight.detach(), scale_and_shift(layer.norm)
    matrix = (weight * scale.detach()[:, None, None, None, None]).flatten(2).transpose(1, 2).flatten(1)
    return linear(matrix, shift.detach())


def export_pv_rcnn_graphs(network: PvRcnn, bundle: PvRcnnBundle, folder: Path) -> None:
    """Write the graphs that `bundle` describes, see `asca_deploy.pv_rcnn.graphs`; every number of rows is dynamic."""
    export_refine_head(network, bundle, graph_path(folder, REFINE))
    network = fold_norms(network)
    _, levels = interfaces.voxels_interface(bundle)
    export_voxels(VoxelProducts(network.voxels), graph_path(folder, VOXELS), levels)
    backbone = FastBackbone(network, padded=False, attention=network.neck.attention)
    export_backbone(backbone, bundle.spec.map_shape, graph_path(folder, BACKBONE))
    inputs, _ = interfaces.keypoints_interface(bundle)
    sources = bundle.pv_rcnn.settings.sources
    rows = _source_rows(inputs, sources) | {"points": "points"}
    keypoints = _Keypoints(network, bundle.pv_rcnn.settings)
    export_row_graph(keypoints, graph_path(folder, KEYPOINTS), inputs, rows, ["features"])
    if bundle.pv_rcnn.settings.deformed:
        export_deform(network, bundle, graph_path(folder, DEFORM))


def export_refine_head(network: PvRcnn, bundle: PvRcnnBundle, path: Path) -> None:
    """Write refine.onnx alone: RoI-grid pooling and the second stage's heads, without normalization."""
    head = fold_norms(network.refine)
    inputs, outputs = interfaces.refine_interface(bundle)
    rows = {name: "keypoints" if name in ("keypoints", "features") else "proposals" for name in inputs}
    of_cells = {name: head.cells for name, row in rows.items() if row == "proposals"}
    export_row_graph(_Refine(head), path, inputs, rows, outputs, of_cells)


def export_deform(network: PvRcnn, bundle: PvRcnnBundle, path: Path) -> None:
    """Write deform.onnx alone: the shifted positions of keypoints for each deformed source."""
    inputs, outputs = interfaces.deform_interface(bundle)
    export_row_graph(_Deform(network), path, inputs, _source_rows(inputs, bundle.pv_rcnn.settings.sources), outputs)


def _source_rows(inputs: Mapping[str, Declared], sources: Sequence[SourceBalls]) -> dict[str, str]:
    """Return by input what its rows are: voxels of a source, positions of a scale, or keypoints."""
    of_source = {f"{sa.source}{suffix}": sa.source for sa in sources for suffix in ("", "_positions")}
    return {name: of_source.get(name) or _scale_row(name) or "keypoints" for name in inputs}


def _scale_row(name: str) -> str:
    """Return the scale of an input's rows: scale_1 for scale_1_groups and scale_2_nearest, "" for keypoints."""
    if not (match := re.fullmatch(r"scale_(\d+)_(groups|positions|nearest|nearest_weights)", name)):
        return ""
    scale = int(match[1]) - match[2].startswith("nearest")
    return f"scale_{scale}" if scale else ""


class _Keypoints(nn.Module):
    """Voxel set abstraction and keypoint weighting with one argument for each input of the graph."""

    def __init__(self, network: PvRcnn, settings: VoxelSetSettings) -> None:
        super().__init__()
        self.encode, self.scales, self.settings = network.encode, network.scales, settings

    def forward(self, *inputs: Tensor) -> Tensor:
        points, keypoints, bev, *rest = inputs
        rows, indices, centers, left = [], [], [], iter(rest)
        if self.scales is not None:
            bev = torch.cat([self.scales(points, self._point_scales(keypoints, left)), bev], dim=1)
        for sa in self.settings.sources:
            if sa.source == "points":
                rows.append(SourceRows(points[:, :3], points[:, 3:]))
            else:
                features = next(left)
                rows.append(SourceRows(next(left), features))
            indices += [next(left) for _ in sa.radii_m]
            places = [next(left) for _ in range(self.settings.places(sa))] or [keypoints]
            centers += [places[min(ball, len(places) - 1)] for ball in range(len(sa.radii_m))]
        features, _ = self.encode(rows, keypoints, bev, indices, centers)
        return features

    def _point_scales(self, keypoints: Tensor, left: Iterator[Tensor]) -> list[PointScale[Tensor]]:
        groups = next(left)
        scales = [PointScale(keypoints, groups, groups[:0], keypoints[:0])]
        for _ in self.settings.scale_radii_m[1:]:
            groups, positions = next(left), next(left)
            scales.append(PointScale(positions, groups, next(left), next(left)))
        return scales


class _Deform(nn.Module):
    """The shifts of all deformed sources, with one argument for each input of the graph."""

    def __init__(self, network: PvRcnn) -> None:
        super().__init__()
        self.deform, self.settings = network.deform, network.settings

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        keypoints, *rest = inputs
        left, places = iter(rest), []
        for sa in self.settings.deformed:
            features, positions = next(left), next(left)
            balls = [next(left) for _ in sa.radii_m]
            nearest = (next(left), next(left)) if self.settings.needs_three_nearest else ()
            places += self.deform[sa.source](Surroundings(features, positions, keypoints, balls, *nearest))
        return tuple(places)


class _Refine(nn.Module):
    """The second stage's head, with one argument for each input of the graph."""

    def __init__(self, head: RoiHead) -> None:
        super().__init__()
        self.head = head

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        keypoints, features, grid_points, *indices = inputs
        refined: tuple[Tensor, Tensor] = self.head(keypoints, features, grid_points, indices)
        return refined
