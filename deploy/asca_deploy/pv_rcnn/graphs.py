"""Inputs and outputs of the graphs of a pv_rcnn bundle, by name, and the map between the first two."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from asca_deploy.bundle import PvRcnnBundle, PvRcnnSection
from asca_deploy.graph import Interface, Tensor
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.points.neighbors import ball_query
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES, SourceBalls, VoxelScan, VoxelSetSettings
from asca_pillars.ops.pv_rcnn.rulebooks import SUBMANIFOLD, VoxelLevel
from asca_pillars.ops.sparse.rulebooks import Shape

VOXEL_VALUES = 4
"""Values of a voxel that enter voxels.onnx: x, y, z, reflectance."""
OUT = "out"
"""Output of voxels.onnx for conv_out; the others have the names of sources."""

_KEPT_BYTES = 64 << 20


def map_channels(bundle: PvRcnnBundle) -> int:
    """Return the channels of the bird's-eye-view map."""
    return bundle.pv_rcnn.voxel_channels[-1] * bundle.spec.level_shapes[-1][0]


def map_type(bundle: PvRcnnBundle) -> str:
    """Return NumPy's name of the map's type; an 8-bit backbone has whole steps, with step 0 for 0."""
    return "float32" if bundle.precision == "float32" else "uint8"


def keeps_memory(section: PvRcnnSection) -> bool:
    """Return whether graphs keep the memory of a run for the next, by the size of RoI-grid pooling's gather.

    Kept, the published sizes take 2.0 GB for a whole scan, 0.8 GB otherwise, for 15 % more time. A small network saves
    that time.
    """
    settings = section.settings
    rows = settings.proposals.count * settings.grid_size**3 * (settings.vector_cells**3 or settings.grid_samples)
    return rows * section.keypoint_channels * 4 <= _KEPT_BYTES


def voxels_interface(bundle: PvRcnnBundle) -> Interface:
    """Return the interface of voxels.onnx: the sparse backbone."""
    inputs = {"features": Tensor("float32", (None, VOXEL_VALUES))}
    for number in range(len(LEVEL_SOURCES)):
        inputs[f"same_{number}"] = Tensor("int32", (None, SUBMANIFOLD.taps))
    for number, convolution in enumerate(bundle.spec.strided, start=1):
        inputs[f"strided_{number}"] = Tensor("int32", (None, convolution.taps))
    channels = dict(zip((*LEVEL_SOURCES, OUT), bundle.pv_rcnn.voxel_channels, strict=True))
    read = {sa.source for sa in bundle.pv_rcnn.settings.sources} | {OUT}
    outputs = {name: Tensor("float32", (None, width)) for name, width in channels.items() if name in read}
    return inputs, outputs | {OUT: Tensor(map_type(bundle), (None, channels[OUT]))}


def backbone_interface(bundle: PvRcnnBundle) -> Interface:
    """Return the interface of backbone.onnx: the backbone on the map, and the anchor head."""
    rows, columns = bundle.spec.map_shape
    anchors, classes = bundle.spec.anchors.shape[2], len(bundle.spec.classes)
    return {"canvas": Tensor(map_type(bundle), (1, rows, columns, map_channels(bundle)))}, {
        name: Tensor("float32", (1, rows, columns, channels * anchors))
        for name, channels in zip(HeadMaps._fields, (classes, 7, 2), strict=True)
    }


def keypoints_interface(bundle: PvRcnnBundle) -> Interface:
    """Return the interface of keypoints.onnx: voxel set abstraction and keypoint weighting."""
    channels = dict(zip(LEVEL_SOURCES, bundle.pv_rcnn.voxel_channels[:-1], strict=True))
    inputs = {
        "points": Tensor("float32", (None, 4)),
        "keypoints": Tensor("float32", (None, 3)),
        "bev": Tensor("float32", (None, map_channels(bundle))),
    }
    for number in range(len(bundle.pv_rcnn.settings.scale_radii_m)):
        inputs[f"scale_{number}_groups"] = Tensor("int32", (None, bundle.pv_rcnn.settings.scale_samples))
        if number:  # the finest is the keypoints
            inputs[f"scale_{number}_positions"] = Tensor("float32", (None, 3))
            inputs[f"scale_{number}_nearest"] = Tensor("int32", (None, 3))
            inputs[f"scale_{number}_nearest_weights"] = Tensor("float32", (None, 3))
    for sa in bundle.pv_rcnn.settings.sources:
        if sa.source != "points":
            inputs[sa.source] = Tensor("float32", (None, channels[sa.source]))
            inputs[f"{sa.source}_positions"] = Tensor("float32", (None, 3))
        for number, samples in enumerate(sa.samples):
            inputs[f"{sa.source}_ball_{number}"] = Tensor("int32", (None, samples))
        for number in range(bundle.pv_rcnn.settings.places(sa)):
            inputs[f"{sa.source}_place_{number}"] = Tensor("float32", (None, 3))
    return inputs, {"features": Tensor("float32", (None, bundle.pv_rcnn.keypoint_channels))}


def deform_interface(bundle: PvRcnnBundle) -> Interface:
    """Return the interface of deform.onnx: the shifted positions of keypoints for each deformed source."""
    channels = dict(zip(LEVEL_SOURCES, bundle.pv_rcnn.voxel_channels[:-1], strict=True))
    settings = bundle.pv_rcnn.settings
    inputs, outputs = {"keypoints": Tensor("float32", (None, 3))}, {}
    for sa in settings.deformed:
        inputs[sa.source] = Tensor("float32", (None, channels[sa.source]))
        inputs[f"{sa.source}_positions"] = Tensor("float32", (None, 3))
        for number, samples in enumerate(sa.samples):
            inputs[f"{sa.source}_ball_{number}"] = Tensor("int32", (None, samples))
        if settings.needs_three_nearest:
            inputs[f"{sa.source}_nearest"] = Tensor("int32", (None, 3))
            inputs[f"{sa.source}_nearest_weights"] = Tensor("float32", (None, 3))
        for number in range(settings.places(sa)):
            outputs[f"{sa.source}_place_{number}"] = Tensor("float32", (None, 3))
    return inputs, outputs


def refine_interface(bundle: PvRcnnBundle) -> Interface:
    """Return the interface of refine.onnx: RoI-grid pooling and the heads of the second stage."""
    settings = bundle.pv_rcnn.settings
    inputs = {
        "keypoints": Tensor("float32", (None, 3)),
        "features": Tensor("float32", (None, bundle.pv_rcnn.keypoint_channels)),
        "grid_points": Tensor("float32", (None, 3)),
    }
    for number in range(len(settings.grid_radii_m)):
        around = (settings.vector_cells**3, 3) if settings.vector_cells else (settings.grid_samples,)
        inputs[f"grid_{number}"] = Tensor("int32", (None, *around))
    return inputs, {"confidence": Tensor("float32", (None,)), "residuals": Tensor("float32", (None, 7))}


def voxel_inputs(features: NDArray[np.float32], levels: Sequence[VoxelLevel[NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the inputs of voxels.onnx for a scan with voxel features (N, 4), metres and reflectance."""
    same = {f"same_{number}": level.same for number, level in enumerate(levels[:-1])}
    strided = {f"strided_{number}": level.strided for number, level in enumerate(levels) if number}
    return {"features": features, **same, **strided}


def keypoint_inputs(
    scan: VoxelScan,
    sources: Sequence[SourceBalls],
    levels: Mapping[str, NDArray[np.float32]],
    bev: NDArray[np.float32],
    balls_of: Sequence[Sequence[NDArray[np.int32]]],
) -> dict[str, NDArray[Any]]:
    """Return the inputs of keypoints.onnx: features (N, C) of levels, (K, C) of the map, balls."""
    given: dict[str, NDArray[Any]] = {"points": scan.points, "keypoints": scan.keypoints, "bev": bev}
    for number, scale in enumerate(scan.scales):
        given |= {f"scale_{number}_{part}": array for part, array in scale._asdict().items()}
    for sa, positions, balls in zip(sources, scan.positions, balls_of, strict=True):
        if sa.source != "points":
            given |= {sa.source: levels[sa.source], f"{sa.source}_positions": positions}
        given |= {f"{sa.source}_ball_{number}": indices for number, indices in enumerate(balls)}
    return given


def deform_inputs(
    scan: VoxelScan, settings: VoxelSetSettings, levels: Mapping[str, NDArray[np.float32]]
) -> dict[str, NDArray[Any]]:
    """Return the inputs of deform.onnx: features (N, C) of levels by name, and the keypoints' neighbors."""
    given: dict[str, NDArray[Any]] = {"keypoints": scan.keypoints}
    for number, sa in enumerate(settings.sources):
        if sa in settings.deformed:
            given |= {
                sa.source: levels[sa.source],
                f"{sa.source}_positions": scan.positions[number],
            }
            given |= {f"{sa.source}_ball_{ball}": index for ball, index in enumerate(scan.ball_indices[number])}
            given[f"{sa.source}_nearest"] = scan.nearest[number]
            given[f"{sa.source}_nearest_weights"] = scan.nearest_weights[number]
    return given


def balls_around(
    scan: VoxelScan, settings: VoxelSetSettings, places: Mapping[str, NDArray[np.float32]]
) -> list[list[NDArray[np.int32]]]:
    """Return the ball indices (K, samples) of each source and radius around places (K, 3), metres."""
    balls = []
    for number, sa in enumerate(settings.sources):
        count = settings.places(sa)
        centers = [
            places[f"{sa.source}_place_{min(ball, count - 1)}"] for ball in range(len(sa.radii_m) if count else 0)
        ]
        balls.append(
            [
                ball_query(scan.positions[number], center, radius_m, samples)
                for center, radius_m, samples in zip(centers, sa.radii_m, sa.samples, strict=True)
            ]
            if count
            else list(scan.ball_indices[number])
        )
    return balls


class VoxelCanvas:
    """The map (1, H, W, C), channels last, C being the voxels of a column one above the other (PV-RCNN, section 3.1).

    Allocated once and kept from scan to scan; only the cells of the scan before are cleared.

    Args:
        shape: of the last level, cells along z, y, x.
        channels: C.
        dtype: of what is scattered: float32, or uint8 for whole steps.
    """

    def __init__(self, shape: Shape, channels: int, dtype: DTypeLike = np.float32) -> None:
        height, rows, columns = shape
        self.image: NDArray[Any] = np.zeros((1, rows, columns, channels), dtype)
        self.rows = self.image.reshape(-1, channels)
        """(H * W, C), the same memory."""
        self._voxels = self.image.reshape(-1, channels // height)
        self._occupied = np.empty(0, np.int64)

    def scatter(self, features: NDArray[Any], cells: NDArray[np.int64]) -> None:
        """Write the features (N, C / nz) of the active voxels; every other one is zero.

        Args:
            features: of the voxels.
            cells: (N,) their flat indices, z running fastest, each once.
        """
        self._voxels[self._occupied] = 0
        self._voxels[cells] = features
        self._occupied = cells
