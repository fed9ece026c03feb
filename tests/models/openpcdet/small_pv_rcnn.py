"""A small PV-RCNN whose weights are imported, and its parts, compared one by one."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config
from asca_pillars.models.pv_rcnn.layers import PvRcnn as OurNetwork
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid
from asca_pillars.ops.two_stage.prepare import grid_neighbors
from tests.models.openpcdet.foreign_networks import PvRcnn, pooled
from tests.models.pv_rcnn import tiny_pv_rcnn
from tests.models.pv_rcnn.tiny_pv_rcnn import SETTINGS, batch, frame
from tests.ops.sparse.dense_volumes import at_cells, dense

SPEC = dataclasses.replace(  # with the strides of the published model, which has no other kernels
    tiny_pv_rcnn.SPEC, grid=VoxelGrid((4.8, 24.0), (-6.4, 6.4), (-3.0, 1.0), (0.2, 0.2, 0.1)), last_stride=2
)
MODEL = dataclasses.replace(tiny_pv_rcnn.MODEL, spec=SPEC)


def assert_same_parts(theirs: PvRcnn, ours: OurNetwork) -> None:
    """Every part of MODEL's network gives what their part gives of the same input."""
    backbone, pfe, head = theirs.backbone_3d, theirs.pfe, theirs.roi_head
    blocks = [
        [backbone.conv_input, *backbone.conv1],
        backbone.conv2,
        backbone.conv3,
        backbone.conv4,
        [backbone.conv_out],
    ]
    detector = PvRcnnDetector(MODEL, ours).eval()
    scans = batch(detector, frame(0)).scans
    with torch.inference_mode():
        first = ours.propose(scans)
        volumes = voxel_volumes(blocks, scans)
        for level, volume, own in zip(first.levels, volumes, scans.levels, strict=True):
            torch.testing.assert_close(
                level.double(), torch.from_numpy(at_cells(volume, own.cells.numpy())), atol=1e-4, rtol=1e-4
            )
        seen_from_above = volumes[-1].float().flatten(1, 2)  # (1, C * D, H, W)
        for ours_map, their_map in zip(first.maps, theirs.dense_head(theirs.backbone_2d(seen_from_above)), strict=True):
            torch.testing.assert_close(ours_map, their_map, atol=1e-4, rtol=1e-3)

        described, logits = ours.encode_keypoints(scans, first.levels, first.canvas)
        cells = seen_from_above[0].flatten(1).T
        parts: Any = [sum(cells[scans.bev_cells[:, i]] * scans.bev_weights[:, i, None] for i in range(4))]
        sources = {"points": scans.points[:, 3:], "conv2": first.levels[1], "conv4": first.levels[3]}
        balls = iter(scans.ball_indices)
        layers = (pfe.SA_rawpoints, *pfe.SA_layers)
        for layer, positions, rows in zip(layers, scans.positions, sources.values(), strict=True):
            parts += [pooled(mlp, positions, rows, scans.keypoints, next(balls)) for mlp in layer.mlps]
        joined = torch.cat(parts, dim=1)  # theirs: map, raw points, levels
        their_logits = theirs.point_head.cls_layers(joined)
        torch.testing.assert_close(logits, their_logits[:, 0], atol=1e-4, rtol=1e-3)
        their_features = pfe.vsa_point_feature_fusion(joined) * torch.sigmoid(their_logits)
        torch.testing.assert_close(described, their_features, atol=1e-4, rtol=1e-3)

        boxes = frame(0).boxes[:3]
        grid = grid_neighbors(scans.keypoints.numpy(), boxes, SETTINGS)
        indices, points = [torch.from_numpy(index) for index in grid.indices], torch.from_numpy(grid.points)
        confidence, residuals = ours.refine(scans.keypoints, described, points, indices)
        pairs = zip(head.roi_grid_pool_layer.mlps, indices, strict=True)
        balls_of = [pooled(mlp, scans.keypoints, described, points, index) for mlp, index in pairs]
        of_grid = torch.cat(balls_of, dim=1).view(len(boxes), SETTINGS.grid_size**3, -1)
        shared = head.shared_fc_layer(of_grid.permute(0, 2, 1).reshape(len(boxes), -1, 1))
        torch.testing.assert_close(confidence, head.cls_layers(shared)[:, 0, 0], atol=1e-4, rtol=1e-3)
        torch.testing.assert_close(residuals, head.reg_layers(shared)[..., 0], atol=1e-4, rtol=1e-3)


def voxel_volumes(blocks: Sequence[Sequence[Any]], scans: Any) -> list[Tensor]:
    """Dense volumes (1, C, D, H, W) of conv1 to conv4 and conv_out, zero where no voxel is active."""
    volume, volumes = dense(scans.features.numpy(), scans.levels[0].cells.numpy(), SPEC.level_shapes[0]), []
    for number, block in enumerate(blocks):
        cells = scans.levels[number].cells.numpy()
        for place, (convolution, norm) in enumerate(block):
            stride: Any = 1
            padding: Any = 1
            if number and place == 0:
                stride, padding = SPEC.strided[number - 1].stride, SPEC.strided[number - 1].padding
            volume = F.conv3d(volume, convolution.weight.double(), stride=stride, padding=padding)
            active = torch.relu(norm.double()(torch.from_numpy(at_cells(volume, cells))))
            norm.float()
            volume = dense(active.numpy(), cells, SPEC.level_shapes[number])
        volumes.append(volume)
    return volumes


CONFIG = Config(name="foreign", model=MODEL)
LAYOUTS = {"1.x": (2, 3, 4, 1, 0), "2.x, native": (2, 3, 4, 0, 1), "2.x": (0, 2, 3, 4, 1)}
"""Of a dense kernel (out, in, z, y, x), the order in which spconv has its axes."""
CHANNELS = {"points": 1, "conv2": 6, "conv4": 8}
PUBLISHED_CHANNELS = {"points": 1, "conv1": 16, "conv2": 32, "conv3": 64, "conv4": 64}


def in_layout(state: dict[str, Tensor], layout: str, prefix: str = "backbone_3d") -> dict[str, Tensor]:
    axes = LAYOUTS[layout]
    return {
        name: value.permute(axes).contiguous() if name.startswith(prefix) and value.ndim == 5 else value
        for name, value in state.items()
    }


def foreign_pv_rcnn(kind: Callable[..., Any], model: PvRcnnModel = MODEL, channels: dict[str, int] = CHANNELS) -> Any:
    """Somebody else's PV-RCNN of this kind, of the sizes of our model."""
    network, settings = model.network, model.settings
    balls = [
        (channels[each.source], len(each.radii_m), widths)
        for each, widths in zip(settings.sources, network.source_widths, strict=True)
    ]
    neck = network.block_channels, network.block_convs, network.upsample_channels
    grid = settings.grid_size, len(settings.grid_radii_m), network.grid_widths, network.hidden
    return kind(network.voxel_channels, neck, 3, balls, network.keypoint_channels, network.weighting_channels, grid)
