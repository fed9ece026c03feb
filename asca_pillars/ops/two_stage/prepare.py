"""Host computation of the second stage for one scan: neighbors of keypoints and of the proposals' grid points."""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.points.neighbors import ball_query, nearest_in_cubes
from asca_pillars.ops.points.sampling import points_near_boxes
from asca_pillars.ops.two_stage.decode import roi_grid_points
from asca_pillars.ops.two_stage.first_stage import SecondStageInputs

ROI_FEATURES = 4
"""Columns of `roi_features` besides the one-hot class."""


@dataclass(frozen=True)
class GridSettings(Strict):
    """RoI-grid pooling (PV-RCNN, section 3.3).

    Attributes:
        grid_size: grid points along each axis of a proposal.
        grid_radii_m: around grid points, in which keypoints are aggregated.
        grid_samples: of each of these balls at most.
    """

    grid_size: int = 4
    grid_radii_m: tuple[float, ...] = (0.8, 1.6)
    grid_samples: int = 16


@dataclass(frozen=True)
class RefineSettings(GridSettings):
    """Balls and grids of the second stage."""

    ball_radii_m: tuple[float, ...] = (0.4, 0.8)
    """Radii of the balls around keypoints in which raw points are aggregated."""
    ball_samples: int = 16

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            values = value if isinstance(value, tuple) else (value,)
            if not values or not all(0 < number < math.inf for number in values):
                raise ConfigError(f"{field.name} {value} of the second stage must be positive and finite")


class GridNeighbors(NamedTuple):
    """The grid points of R proposals and the keypoints around them."""

    points: NDArray[np.float32]
    """(R * cells, 3), metres, LiDAR frame."""
    indices: tuple[NDArray[np.int32], ...]
    """Ball indices (R * cells, samples) for each radius, or the nearest in each cell of a cube (R * cells, T, 3); the
    number of keypoints marks an empty entry."""


@dataclass(frozen=True)
class RefineScan:
    """Input of the second stage for one scan; `models.two_stage.layers.RefineInputs` describes the arrays."""

    points: NDArray[np.float32]
    keypoints: NDArray[np.float32]
    bev: NDArray[np.float32]
    ball_indices: tuple[NDArray[np.int32], ...]
    grid_points: NDArray[np.float32]
    grid_indices: tuple[NDArray[np.int32], ...]
    roi_features: NDArray[np.float32]


def refine_scan(
    points: NDArray[np.float32],
    proposed: SecondStageInputs,
    proposals: Detections,
    settings: RefineSettings,
    executor: Executor | None = None,
) -> RefineScan:
    """Return the neighbors for some proposals of a scan, in their order.

    Args:
        points: (N, 4) of the scan.
        proposed: first-stage results of it.
        proposals: those of them to be refined.
        executor: of a thread for the grids' neighbours, while those of the keypoints are sought in this one.
    """
    keypoints = proposed.keypoints
    pending = None if executor is None else executor.submit(grid_neighbors, keypoints, proposals.boxes, settings)
    # Points that no ball around a keypoint can reach are not worth sorting.
    all_boxes = proposed.proposals.boxes
    margin_m = max(settings.ball_radii_m) + _keypoint_margin_m(keypoints, all_boxes)
    near = points_near_boxes(points, all_boxes, margin_m)
    balls = tuple(ball_query(near, keypoints, radius_m, settings.ball_samples) for radius_m in settings.ball_radii_m)
    grid = grid_neighbors(keypoints, proposals.boxes, settings) if pending is None else pending.result()
    return RefineScan(
        points=near,
        keypoints=keypoints,
        bev=proposed.bev,
        ball_indices=balls,
        grid_points=grid.points,
        grid_indices=grid.indices,
        roi_features=roi_features(proposals),
    )


def grid_neighbors(
    keypoints: NDArray[np.float32], boxes: NDArray[np.float32], settings: GridSettings, vector_cells: int = 0
) -> GridNeighbors:
    """Return the neighbors for RoI-grid pooling (PV-RCNN, section 3.3) of boxes (R, 7) among keypoints (K, 3), metres.

    These are balls, or with `vector_cells` along each axis the cells of cubes whose half length is the radius.
    """
    points = np.ascontiguousarray(roi_grid_points(boxes, settings.grid_size).reshape(-1, 3), np.float32)
    return GridNeighbors(
        points,
        tuple(
            nearest_in_cubes(keypoints, points, radius_m, vector_cells)
            if vector_cells
            else ball_query(keypoints, points, radius_m, settings.grid_samples)
            for radius_m in settings.grid_radii_m
        ),
    )


def roi_features(proposals: Detections) -> NDArray[np.float32]:
    """Return RoI features: class (one-hot), logit of the score, length, width, height.

    Shape (R, classes + ROI_FEATURES). One head serves all classes, whose boxes differ.
    """
    classes = np.eye(len(proposals.class_names), dtype=np.float32)[proposals.labels]
    score = np.clip(proposals.scores, 1e-4, 1 - 1e-4)[:, None]
    return np.concatenate([classes, np.log(score / (1 - score)), proposals.boxes[:, 3:6]], axis=1, dtype=np.float32)


def _keypoint_margin_m(keypoints: NDArray[np.float32], boxes: NDArray[np.float32]) -> float:
    """Return the largest distance of a keypoint from the circle around the nearest box, at least 0."""
    if not len(keypoints) or not len(boxes):
        return 0.0
    reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
    dx, dy = (keypoints[:, None, axis] - boxes[None, :, axis] for axis in range(2))
    away = np.sqrt(dx * dx + dy * dy) - reach  # several times as fast as hypot
    return max(float(away.min(axis=1).max()), 0.0)
