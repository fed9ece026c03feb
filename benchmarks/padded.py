"""The network in the usual PyTorch form: pillars padded to `max_points`, scans to `max_pillars`, eager float32.

Written from the papers' description of the input tensor, (P, N, 9) with zeros for missing points, and with the
weights of our own model. Our detector keeps the points flat instead; the results are the same.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.detections import Detections
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.prepare import FEATURES, Pillars
from asca_pillars.ops.pillar.spec import PillarSpec


@dataclass(frozen=True)
class PaddedDetector:
    """Trained network in evaluation mode, run on padded pillars.

    Attributes:
        network: the network; its attention must not be `point`, which works on points.
        all_pillars: pad to `max_pillars` like the papers' tensor; otherwise only to the number of pillars.
        channels_last: memory format of the network, faster for convolutions on a CPU.

    Raises:
        ConfigError: the network has point attention.
    """

    network: PillarDetector
    spec: PillarSpec
    all_pillars: bool = True
    channels_last: bool = False

    def __post_init__(self) -> None:
        if self.network.encode.point_attention is not None:
            raise ConfigError(
                "cpa point attends among the points of a pillar; give a config with linear, channel, paper or none"
            )

    def __call__(self, points: NDArray[np.float32]) -> Detections:
        """Detect in (N, 4) x, y, z in metres and reflectance -> boxes, best first."""
        maps = self.head_maps(points)
        return self.spec.decode(HeadMaps(*(part.numpy() for part in maps)))

    @torch.inference_mode()
    def head_maps(self, points: NDArray[np.float32]) -> HeadMaps[Tensor]:
        """Compute the head maps: (N, 4) -> maps (A, H, W), (7A, H, W), (2A, H, W)."""
        pillars = self.spec.pillarize(points)
        table, counts = self._pad(pillars)
        features = self._encode(table, counts)[: len(pillars.cells)]  # (P, C)
        canvas = self._scatter(features, torch.from_numpy(pillars.cells))
        maps = self.network.head(self.network.neck(canvas))
        return HeadMaps(*(part[0] for part in maps))

    def _pad(self, pillars: Pillars) -> tuple[Tensor, Tensor]:
        """Return the points of each pillar (P', N, 9), padded with zeros, and their numbers (P',)."""
        found, limits = len(pillars.cells), self.spec.limits
        rows = limits.max_pillars if self.all_pillars else found
        table = np.zeros((rows, limits.max_points, len(FEATURES)), np.float32)
        starts = np.cumsum(pillars.point_counts) - pillars.point_counts
        slots = np.arange(len(pillars.features)) - np.repeat(starts, pillars.point_counts)
        table[pillars.pillar_index, slots] = pillars.features
        counts = np.zeros(rows, np.int64)
        counts[:found] = pillars.point_counts
        return torch.from_numpy(table), torch.from_numpy(counts)

    def _encode(self, table: Tensor, counts: Tensor) -> Tensor:
        """Encode pillars: (P', N, 9) -> (P', C); rows without points are zero."""
        encode = self.network.encode
        rows, slots, _ = table.shape
        linear = encode.linear(table)  # (P', N, C)
        points = torch.relu(encode.norm(linear.view(rows * slots, -1))).view(rows, slots, -1)
        real = torch.arange(slots) < counts[:, None]
        pillars = (points * real[..., None]).amax(dim=1)  # after a ReLU, zero never exceeds a real point
        if encode.pillar_attention is not None:
            pillars = encode.pillar_attention(pillars)
        return pillars

    def _scatter(self, features: Tensor, cells: Tensor) -> Tensor:
        """Scatter features: (P, C) -> pseudo-image (1, C, ny, nx)."""
        ny, nx = self.spec.grid.ny, self.spec.grid.nx
        canvas = torch.zeros(features.shape[1], ny * nx)
        canvas[:, cells] = features.T
        image = canvas.view(1, -1, ny, nx)
        return image.to(memory_format=torch.channels_last) if self.channels_last else image
