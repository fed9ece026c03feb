"""PV-RCNN as four ONNX graphs, normalization folded into the layers before it; nothing is scattered in them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from asca_deploy.bundle import BACKBONE, DEFORM, KEYPOINTS, REFINE, VOXELS, PvRcnnBundle
from asca_deploy.graph import Tensor as Declared
from asca_deploy.pv_rcnn import graphs as interfaces
from asca_export.fast_forms import FastBackbone
from asca_export.graphs import export_backbone, export_row_graph, graph_path
from asca_export.pv_rcnn.voxel_forms import VoxelProducts, export_voxels
from asca_export.two_stage.graphs import fold_norms
from asca_pillars.models.pv_rcnn.layers import PvRcnn, Surroundings
from asca_pillars.models.two_stage.layers import RoiHead, SourceRows
from asca_pillars.ops.points.neighbors import PointScale
from asca_pillars.ops.pv_rcnn.prepare import SourceBalls, VoxelSetSettings


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
    of_source = {f"{each.source}{suffix}": each.source for each in sources for suffix in ("", "_positions")}
    return {name: of_source.get(name) or _scale_row(name) or "keypoints" for name in inputs}


def _scale_row(name: str) -> str:
    """Return the scale of an input's rows: scale_1 for scale_1_groups and scale_2_nearest, "" for keypoints."""
    if not (found := re.fullmatch(r"scale_(\d+)_(groups|positions|nearest|nearest_weights)", name)):
        return ""
    scale = int(found[1]) - found[2].startswith("nearest")
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
        for each in self.settings.sources:
            if each.source == "points":
                rows.append(SourceRows(points[:, :3], points[:, 3:]))
            else:
                features = next(left)
                rows.append(SourceRows(next(left), features))
            indices += [next(left) for _ in each.radii_m]
            places = [next(left) for _ in range(self.settings.places(each))] or [keypoints]
            centers += [places[min(ball, len(places) - 1)] for ball in range(len(each.radii_m))]
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
        for each in self.settings.deformed:
            features, positions = next(left), next(left)
            balls = [next(left) for _ in each.radii_m]
            nearest = (next(left), next(left)) if self.settings.needs_three_nearest else ()
            places += self.deform[each.source](Surroundings(features, positions, keypoints, balls, *nearest))
        return tuple(places)


class _Refine(nn.Module):
    """The second stage's head, with one argument for each input of the graph."""

    def __init__(self, head: RoiHead) -> None:
        super().__init__()
        self.head = head

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        keypoints, features, grid_points, *indices = inputs
        found: tuple[Tensor, Tensor] = self.head(keypoints, features, grid_points, indices)
        return found
