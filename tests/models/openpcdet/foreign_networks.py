"""Networks with the names, shapes and orders that OpenPCDet documents, in plain dense PyTorch, with random weights."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn


def random_weights(module: nn.Module, seed: int = 0) -> nn.Module:
    """Weights, and statistics that are none of the initial ones."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in (*module.named_parameters(), *module.named_buffers()):
            if name.endswith("running_var"):
                value.uniform_(0.3, 1.0, generator=generator)
            elif value.is_floating_point():
                value.normal_(0, 0.3 if value.ndim == 1 else value[0].numel() ** -0.5, generator=generator)
    return module.eval()


def write_foreign(path: Path, state: dict[str, Tensor]) -> Path:
    """A file as OpenPCDet's training writes it."""
    counter = torch.zeros(1, dtype=torch.int64)
    content: dict[str, Any] = {"epoch": 80, "it": 18560, "model_state": state | {"global_step": counter}}
    torch.save(content | {"optimizer_state": None, "version": "pcdet+0.3.0"}, path)
    return path


class MapBackbone(nn.Module):
    """BaseBEVBackbone; each block begins with a padding of zeros."""

    def __init__(
        self, channels: int, widths: Sequence[int], convs: Sequence[int], strides: Sequence[int], up: int
    ) -> None:
        super().__init__()
        self.blocks, self.deblocks, total = nn.ModuleList(), nn.ModuleList(), 1
        for width, count, stride in zip(widths, convs, strides, strict=True):
            total *= stride
            layers: list[nn.Module] = [nn.ZeroPad2d(1), nn.Conv2d(channels, width, 3, stride, bias=False)]
            for number in range(count + 1):
                layers += [nn.BatchNorm2d(width, eps=1e-3), nn.ReLU()]
                layers += [nn.Conv2d(width, width, 3, padding=1, bias=False)] if number < count else []
            self.blocks.append(nn.Sequential(*layers))
            step = total // strides[0]
            upsampling = nn.ConvTranspose2d(width, up, step, step, bias=False)
            self.deblocks.append(nn.Sequential(upsampling, nn.BatchNorm2d(up, eps=1e-3), nn.ReLU()))
            channels = width

    def forward(self, features: Tensor) -> Tensor:
        maps = []
        for block, deblock in zip(self.blocks, self.deblocks, strict=True):
            features = block(features)
            maps.append(deblock(features))
        return torch.cat(maps, dim=1)


class AnchorHead(nn.Module):
    """AnchorHeadSingle: every anchor has a score for every class."""

    def __init__(self, channels: int, anchors: int, classes: int) -> None:
        super().__init__()
        self.conv_cls = nn.Conv2d(channels, anchors * classes, 1)
        self.conv_box = nn.Conv2d(channels, anchors * 7, 1)
        self.conv_dir_cls = nn.Conv2d(channels, anchors * 2, 1)

    def forward(self, features: Tensor) -> list[Tensor]:
        return [layer(features) for layer in self.children()]


class PillarLayer(nn.Module):
    """PFNLayer, the last of one: padded points (P, slots, 10) -> the maximum over all slots, zeros included."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(10, channels, bias=False)
        self.norm = nn.BatchNorm1d(channels, eps=1e-3)

    def forward(self, padded: Tensor) -> Tensor:
        values = self.norm(self.linear(padded).permute(0, 2, 1)).permute(0, 2, 1)
        return torch.relu(values).max(dim=1).values


class PointPillars(nn.Module):
    """PillarVFE, BaseBEVBackbone and AnchorHeadSingle."""

    vfe: Any

    def __init__(self, channels: int, widths: Sequence[int], convs: Sequence[int], up: int, classes: int) -> None:
        super().__init__()
        self.vfe = nn.Module()
        self.vfe.pfn_layers = nn.ModuleList([PillarLayer(channels)])
        self.backbone_2d = MapBackbone(channels, widths, convs, (2, 2, 2), up)
        self.dense_head = AnchorHead(3 * up, 2 * classes, classes)


def mlp_2d(channels: int, widths: Sequence[int]) -> nn.Sequential:
    """Of a set abstraction: convolutions with a 1x1 kernel on (B, C, queries, samples)."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Conv2d(channels, width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU()]
        channels = width
    return nn.Sequential(*layers)


def fully_connected(channels: int, hidden: int, out: int | None) -> nn.Sequential:
    """Of the second stage: convolutions along one axis on (B, C, 1), with dropout after the first."""
    layers: list[nn.Module] = []
    for number in range(2):
        layers += [nn.Conv1d(channels, hidden, 1, bias=False), nn.BatchNorm1d(hidden), nn.ReLU()]
        layers += [nn.Dropout(0.3)] if number == 0 else []
        channels = hidden
    return nn.Sequential(*layers, *([] if out is None else [nn.Conv1d(channels, out, 1)]))


def foreground(channels: int, hidden: int) -> nn.Sequential:
    """Return the layers that weigh keypoints."""
    return nn.Sequential(
        *(nn.Linear(channels, hidden, bias=False), nn.BatchNorm1d(hidden), nn.ReLU()),
        *(nn.Linear(hidden, hidden, bias=False), nn.BatchNorm1d(hidden), nn.ReLU()),
        nn.Linear(hidden, 1),
    )


class SparseLayer(nn.Sequential):
    """A convolution of spconv, kept dense here, with its normalization."""

    def __init__(self, channels: int, width: int, kernel: tuple[int, int, int]) -> None:
        super().__init__(nn.Conv3d(channels, width, kernel, bias=False), nn.BatchNorm1d(width, eps=1e-3))


class PvRcnn(nn.Module):
    """VoxelBackBone8x, BaseBEVBackbone, AnchorHeadSingle, VoxelSetAbstraction, PointHeadSimple and PVRCNNHead.

    Args:
        widths: of conv1 to conv4 and conv_out.
        balls: of raw points (first) and of the levels that are read: channels of the source, radii, MLP.
    """

    backbone_3d: Any
    pfe: Any
    point_head: Any
    roi_head: Any

    def __init__(
        self,
        widths: Sequence[int],
        neck: tuple[Sequence[int], Sequence[int], int],
        classes: int,
        balls: Sequence[tuple[int, int, Sequence[int]]],
        keypoint: int,
        weighting: int,
        grid: tuple[int, int, Sequence[int], int],
    ) -> None:
        super().__init__()
        self.backbone_3d = nn.Module()
        self.backbone_3d.conv_input = SparseLayer(4, widths[0], (3, 3, 3))
        self.backbone_3d.conv1 = nn.Sequential(SparseLayer(widths[0], widths[0], (3, 3, 3)))
        for level in range(1, 4):
            before, width = widths[level - 1], widths[level]
            convolutions = [SparseLayer(read, width, (3, 3, 3)) for read in (before, width, width)]
            setattr(self.backbone_3d, f"conv{level + 1}", nn.Sequential(*convolutions))
        self.backbone_3d.conv_out = SparseLayer(widths[3], widths[4], (3, 1, 1))
        self.backbone_2d = MapBackbone(2 * widths[4], neck[0], neck[1], (1, 2), neck[2])
        self.dense_head = AnchorHead(2 * neck[2], 2 * classes, classes)
        self.pfe = nn.Module()
        layers = []
        for channels, radii, mlp in balls:
            layers.append(nn.Module())
            layers[-1].mlps = nn.ModuleList(mlp_2d(3 + channels, mlp) for _ in range(radii))
        self.pfe.SA_rawpoints, self.pfe.SA_layers = layers[0], nn.ModuleList(layers[1:])
        joined = 2 * widths[4] + sum(radii * mlp[-1] for _, radii, mlp in balls)
        self.pfe.vsa_point_feature_fusion = nn.Sequential(
            nn.Linear(joined, keypoint, bias=False), nn.BatchNorm1d(keypoint), nn.ReLU()
        )
        self.point_head = nn.Module()
        self.point_head.cls_layers = foreground(joined, weighting)
        size, radii, mlp, hidden = grid
        self.roi_head = nn.Module()
        self.roi_head.roi_grid_pool_layer = nn.Module()
        self.roi_head.roi_grid_pool_layer.mlps = nn.ModuleList(mlp_2d(3 + keypoint, mlp) for _ in range(radii))
        self.roi_head.shared_fc_layer = fully_connected(size**3 * radii * mlp[-1], hidden, None)
        self.roi_head.cls_layers = fully_connected(hidden, hidden, 1)
        self.roi_head.reg_layers = fully_connected(hidden, hidden, 7)


def pooled(mlp: nn.Module, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
    """A set abstraction pair by pair; an empty ball is a row of zeros: (Q, channels)."""
    found = (indices < len(positions))[..., None]
    safe = indices.long().clamp(max=max(len(positions) - 1, 0))
    pairs = torch.cat([positions[safe] - queries[:, None], features[safe]], dim=2) * found  # (Q, T, 3 + C)
    return mlp(pairs.permute(2, 0, 1)[None]).max(dim=3).values[0].T
