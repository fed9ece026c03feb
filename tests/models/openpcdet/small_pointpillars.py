"""A small PointPillars whose weights are imported; its parts and its boxes, compared with somebody else's."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from asca_pillars.config.pillar import NetworkConfig
from asca_pillars.detection.decode import HeadMaps, PostProcess
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits, Pillars
from asca_pillars.ops.pillar.spec import PillarSpec
from tests.export.tiny import SCANS

GRID = PillarGrid((4.8, 25.28), (-6.4, 8.96), (-3.0, 1.5), v_max_m=0.32, v_y_m=0.32, zones=1)
SLOTS = 6
SPEC = PillarSpec(
    post=PostProcess(nms_iou=0.01, candidates=200, max_detections=60),
    grid=GRID,
    limits=PillarLimits(2000, SLOTS),
    anchor_places="ends",
    anchor_scores="every",
)
NETWORK = NetworkConfig(
    cpa="none",
    pillar_channels=12,
    block_channels=(10, 12, 14),
    block_convs=(1, 2, 1),
    upsample_channels=8,
    empty_slots=True,
)


def padded(pillars: Pillars, *, legacy: bool = False) -> Tensor:
    """(P, slots, 10) as they make them of kept points: from coordinates and indices alone, zeros behind them.

    With `legacy` (mmdetection3d) the offsets to the center are written over x, y and z.
    """
    found = np.zeros((len(pillars.cells), SLOTS, 10), np.float32)
    for pillar, cell in enumerate(pillars.cells):
        points = pillars.features[pillars.pillar_index == pillar, :4]
        row, column = divmod(int(cell), GRID.nx)
        from_center = points[:, :3] - (4.8 + (column + 0.5) * 0.32, -6.4 + (row + 0.5) * 0.32, (1.5 - 3.0) / 2)
        places = from_center if legacy else points[:, :3]
        from_mean = points[:, :3] - points[:, :3].mean(0)
        found[pillar, : len(points)] = np.hstack([places, points[:, 3:], from_mean, from_center])
    return torch.from_numpy(found)


def assert_same_parts(
    detector: PillarDetector,
    encode: Callable[[Pillars], Tensor],
    backbone: Callable[[Tensor], Tensor],
    head: Callable[[Tensor], Sequence[Tensor]],
) -> None:
    """Every part of our detector gives what their part gives of the same scan."""
    pillars = SPEC.pillarize(SCANS[0])
    full = pillars.point_counts == SLOTS
    assert full.any() and not full.all(), "pillars with empty slots and without"
    batch = batch_pillars([pillars])
    with torch.inference_mode():
        theirs = encode(pillars)
        ours = detector.encode(batch.features, batch.pillar_index, batch.point_counts)
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
        canvas = torch.zeros(GRID.ny * GRID.nx, 12)
        canvas[torch.from_numpy(pillars.cells)] = theirs
        features = backbone(canvas.T.reshape(1, 12, GRID.ny, GRID.nx))
        torch.testing.assert_close(detector.neck(detector.scatter(ours, batch.cells, batch.frame_cells)), features)
        for name, ours_map, their_map in zip(HeadMaps._fields, detector(batch), head(features), strict=True):
            torch.testing.assert_close(ours_map, their_map, atol=1e-4, rtol=1e-4, msg=name)


def assert_same_boxes(
    spec: PillarSpec, places: Callable[[int, float, float], Tensor], anchors: Sequence[Sequence[float]], offset: float
) -> None:
    """The best boxes of maps of noise are those that their code decodes.

    Args:
        spec: of our decoder.
        places: where anchors stand along an axis of so many cells, between two ends in metres.
        anchors: length, width, height and bottom of the anchors of each class, as published, metres.
        offset: where the direction bins begin, radians.
    """
    height, width = GRID.head_shape
    rng = np.random.default_rng(0)
    maps = HeadMaps(*(rng.normal(0, 0.5, (6 * size, height, width)).astype(np.float32) for size in (3, 7, 2)))
    scores, residuals, directions = (torch.from_numpy(part).permute(1, 2, 0) for part in maps)
    published = torch.tensor(anchors)
    grid = torch.zeros(height, width, 3, 2, 7)
    grid[..., 0] = places(width, 4.8, 25.28)[None, :, None, None]
    grid[..., 1] = places(height, -6.4, 8.96)[:, None, None, None]
    grid[..., 2] = published[:, None, 3]
    grid[..., 3:6] = published[:, None, :3]
    grid[..., 6] = torch.tensor([0, 1.57])
    xa, ya, za, dxa, dya, dza, ra = grid.reshape(-1, 7).split(1, dim=1)
    xt, yt, zt, dxt, dyt, dzt, rt = residuals.reshape(-1, 7).split(1, dim=1)
    diagonal = torch.sqrt(dxa**2 + dya**2)
    yaw = rt + ra - offset
    yaw = yaw - torch.floor(yaw / math.pi) * math.pi + offset
    yaw = yaw + math.pi * directions.reshape(-1, 2).argmax(dim=1, keepdim=True)
    center = [xt * diagonal + xa, yt * diagonal + ya, zt * dza + za + dza / 2]
    boxes = torch.cat([*center, torch.exp(dxt) * dxa, torch.exp(dyt) * dya, torch.exp(dzt) * dza, yaw], dim=1)

    best, labels = scores.reshape(-1, 3).sigmoid().max(dim=1)
    order = torch.argsort(-best)
    chosen, threshold = order[:30], float(best[order[29:31]].mean())
    post = PostProcess(nms_iou=1.0, max_detections=1000, candidates=1000)
    found = dataclasses.replace(spec, post=post).with_score_threshold(threshold).decode(maps)
    assert len(found) == 30 and set(found.names) == {"Pedestrian", "Cyclist", "Car"}
    np.testing.assert_allclose(found.scores, best[chosen], atol=1e-6)
    np.testing.assert_array_equal(found.labels, labels[chosen])
    theirs = boxes[chosen].double().numpy()
    np.testing.assert_allclose(found.boxes[:, :6], theirs[:, :6], atol=1e-4)
    turned = np.exp(1j * found.boxes[:, 6]) / np.exp(1j * theirs[:, 6])
    np.testing.assert_allclose(turned, 1, atol=2e-3)  # turned anchors: 1.57 and half of pi
    apart = np.abs((theirs[:, 6] - offset) % np.pi - np.pi / 2)
    assert (apart < np.pi / 4).any(), "where bins that begin elsewhere would turn boxes round"
