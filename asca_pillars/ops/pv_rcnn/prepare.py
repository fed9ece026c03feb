"""Host computation of PV-RCNN for one scan: voxels, rulebooks, keypoints and their neighbors (3.1, 3.2)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.detections import ScanCounts
from asca_pillars.detection.proposals import AnchorProposals
from asca_pillars.ops.points.neighbors import PointScale, ball_query, point_scales, three_nearest
from asca_pillars.ops.points.sampling import bilinear_cells, farthest_points
from asca_pillars.ops.pv_rcnn.rulebooks import VoxelLevel, VoxelRulebookBuilder
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.pv_rcnn.voxels import voxelize
from asca_pillars.ops.two_stage.prepare import GridSettings

Deform = Literal["none", "paper", "authors", "authors_frozen"]
Source = Literal["points", "conv1", "conv2", "conv3", "conv4"]
LEVEL_SOURCES: tuple[Source, ...] = ("conv1", "conv2", "conv3", "conv4")
MOST_VECTOR_CELLS = 7
"""Upper bound of cells along an axis of a cube; with more, weights outnumber the keypoints that train them."""


def _are_radii(radii_m: Sequence[float]) -> bool:
    return all(0 < radius < math.inf for radius in radii_m)


@dataclass(frozen=True)
class SourceBalls(Strict):
    """Set abstraction (SA) of one source: balls around a keypoint that it aggregates.

    Attributes:
        source: raw points, or the voxels of a level of the backbone.
        radii_m: of the balls.
        samples: of each ball at most.
    """

    source: Source
    radii_m: tuple[float, ...]
    samples: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.radii_m or len(self.radii_m) != len(self.samples):
            raise ConfigError(f"{self.source}: radii_m {self.radii_m} and samples {self.samples} must go in pairs")
        if not _are_radii(self.radii_m) or min(self.samples) < 1:
            raise ConfigError(
                f"{self.source}: radii_m {self.radii_m} and samples {self.samples} must be positive and finite"
            )


@dataclass(frozen=True)
class VoxelSetSettings(GridSettings):
    """Keypoints, proposals and neighbors of PV-RCNN; the defaults are the published ones on KITTI.

    Attributes:
        keypoints: of a scan, at most.
        sources: aggregated by keypoints besides the bird's-eye-view map.
        scale_radii_m: of groups of raw points at scales that have all keypoints, a quarter of them, a sixteenth, ...,
            the finest first (AFE-RCNN's adaptive features); none without.
        scale_samples: of each of these groups at most.
        deform: centers of keypoints' balls. `none`: the keypoints. `paper`: a position predicted from their
            surroundings, one for each level (Deformable PV-RCNN). `authors`: one for each level and radius, as in that
            paper's code. `authors_frozen`: likewise, learning nothing through the place, as that code does.
        proposals: which of the first stage's boxes are refined.
        vector_cells: 0, or along each axis of a cube around a grid point, with `grid_radii_m` as half its length:
            VectorPool interpolates the keypoints nearest to each cell instead of aggregating balls (AV PV-RCNN).
    """

    keypoints: int = 2048
    sources: tuple[SourceBalls, ...] = (
        SourceBalls("points", (0.4, 0.8), (16, 16)),
        SourceBalls("conv1", (0.4, 0.8), (16, 16)),
        SourceBalls("conv2", (0.8, 1.2), (16, 32)),
        SourceBalls("conv3", (1.2, 2.4), (16, 32)),
        SourceBalls("conv4", (2.4, 4.8), (16, 32)),
    )
    scale_radii_m: tuple[float, ...] = ()
    scale_samples: int = 16
    deform: Deform = "none"
    proposals: AnchorProposals = field(default_factory=AnchorProposals)
    grid_size: int = 6
    vector_cells: int = 0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in ("keypoints", "grid_size", "grid_samples") and value < 1:
                raise ConfigError(f"{item.name} {value} must be at least 1")
        if not self.grid_radii_m or not _are_radii(self.grid_radii_m):
            raise ConfigError(f"grid_radii_m {list(self.grid_radii_m)} must be positive and finite, one at least")
        if not 0 <= self.vector_cells <= MOST_VECTOR_CELLS:
            raise ConfigError(f"vector_cells {self.vector_cells} must lie between 0 and {MOST_VECTOR_CELLS}")
        if not _are_radii(self.scale_radii_m) or self.scale_samples < 2:
            raise ConfigError(
                f"scale_radii_m {list(self.scale_radii_m)} must be positive and finite, "
                f"scale_samples {self.scale_samples} at least 2"
            )
        names = [sa.source for sa in self.sources]
        if len(set(names)) < len(names):
            raise ConfigError(f"sources {', '.join(names)} must be different ones")
        if self.deform != "none" and not self.deformed:
            raise ConfigError(f"deform {self.deform} shifts where voxels are looked for; add a level to sources")

    @property
    def deformed(self) -> tuple[SourceBalls, ...]:
        """Sources aggregated around shifted positions: the levels, if there is deformation."""
        return tuple(sa for sa in self.sources if self.deform != "none" and sa.source != "points")

    @property
    def needs_three_nearest(self) -> bool:
        """True if the three nearest voxels of a keypoint are needed."""
        return self.deform == "paper"

    def places(self, sa: SourceBalls) -> int:
        """Return the number of shifted positions per keypoint for this source; 0: the keypoint's own position."""
        if sa not in self.deformed:
            return 0
        return 1 if self.deform == "paper" else len(sa.radii_m)


class VoxelScan(NamedTuple):
    """One scan as PV-RCNN takes it."""

    features: NDArray[np.float32]
    """(N, 4) of the voxels, see `Voxels`."""
    levels: tuple[VoxelLevel[NDArray[Any]], ...]
    """conv1 to conv4 and conv_out."""
    points: NDArray[np.float32]
    """(P, 4) x, y, z in metres, LiDAR frame, and reflectance, of the points in the ranges."""
    keypoints: NDArray[np.float32]
    """(K, 3), metres, LiDAR frame."""
    positions: tuple[NDArray[np.float32], ...]
    """Positions (N, 3) that the indices of each source refer to: points, or voxel centers; metres."""
    ball_indices: tuple[tuple[NDArray[np.int32], ...], ...]
    """Ball indices (K, samples) for each source and radius."""
    nearest: tuple[NDArray[np.int32], ...]
    """Nearest voxels (K, 3) for each source, see `three_nearest`; (0, 3) where they are not needed."""
    nearest_weights: tuple[NDArray[np.float32], ...]
    bev_cells: NDArray[np.int32]
    """(K, 4) flat indices into the bird's-eye-view map, see `bilinear_cells`."""
    bev_weights: NDArray[np.float32]
    """(K, 4)."""
    scales: tuple[PointScale[NDArray[Any]], ...]
    """Scales of raw points around keypoints, finest first; empty where they are not needed."""
    counts: ScanCounts


def voxel_scan(
    points: NDArray[np.float32], spec: VoxelSpec, settings: VoxelSetSettings, builder: VoxelRulebookBuilder
) -> VoxelScan:
    """Return voxels, rulebooks, keypoints and their neighbors of the finite points (N, 4) of one scan.

    Args:
        points: x, y, z in metres, LiDAR frame, and reflectance.
        spec: the detector's.
        settings: likewise.
        builder: of `spec`; its memory is written over by the next scan, what is returned is not.
    """
    return with_neighbors(points, voxel_levels(points, spec, builder), spec, settings)


class VoxelizedScan(NamedTuple):
    """The part of a scan that the sparse backbone reads."""

    features: NDArray[np.float32]
    """(N, 4)."""
    levels: tuple[VoxelLevel[NDArray[Any]], ...]
    counts: ScanCounts


def voxel_levels(points: NDArray[np.float32], spec: VoxelSpec, builder: VoxelRulebookBuilder) -> VoxelizedScan:
    """Return voxels and rulebooks of finite points (N, 4), metres, LiDAR frame, see `voxel_scan`."""
    voxels = voxelize(points, spec.grid, builder.maps[0])
    counts = ScanCounts(len(points), voxels.points_outside, 0)
    return VoxelizedScan(voxels.features, tuple(builder.build()), counts)


def with_neighbors(
    points: NDArray[np.float32], voxelized: VoxelizedScan, spec: VoxelSpec, settings: VoxelSetSettings
) -> VoxelScan:
    """Return the scan with keypoints among the points (N, 4), metres, LiDAR frame, and neighbors, see `voxel_scan`."""
    features, levels, counts = voxelized
    inside = np.ascontiguousarray(points[spec.grid.inside(points)])
    keypoints = np.ascontiguousarray(inside[farthest_points(inside, settings.keypoints), :3])
    positions = tuple(_positions(sa.source, inside, levels, spec) for sa in settings.sources)
    balls = tuple(
        tuple(ball_query(where, keypoints, radius, count) for radius, count in zip(sa.radii_m, sa.samples, strict=True))
        for sa, where in zip(settings.sources, positions, strict=True)
    )
    asked = settings.deformed if settings.needs_three_nearest else ()
    nearest = [
        three_nearest(where, keypoints if sa in asked else keypoints[:0])
        for sa, where in zip(settings.sources, positions, strict=True)
    ]
    return VoxelScan(
        features,
        levels,
        inside,
        keypoints,
        positions,
        balls,
        tuple(indices for indices, _ in nearest),
        tuple(weights for _, weights in nearest),
        *bilinear_cells(keypoints, *spec.map_places_m()),
        point_scales(inside, keypoints, settings.scale_radii_m, settings.scale_samples),
        counts,
    )


def _positions(
    source: Source, points: NDArray[np.float32], levels: tuple[VoxelLevel[NDArray[Any]], ...], spec: VoxelSpec
) -> NDArray[np.float32]:
    if source == "points":
        return np.ascontiguousarray(points[:, :3])
    number = LEVEL_SOURCES.index(source)
    return spec.grid.centers_m(levels[number].cells, spec.level_shapes[number], spec.level_strides[number])
