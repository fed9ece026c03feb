"""KITTI's calibration: from the LiDAR to the rectified camera and to the left color image.

Frames: LiDAR x forward, y left, z up. Rectified camera x right, y down, z forward. Both in metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import atomic_path, read_text
from asca_pillars.geometry.boxes import corners
from asca_pillars.geometry.frame_change import transform_columns

DEFAULT_IMAGE_SIZE_WH = (1242, 375)
NEAR_PLANE_M = 0.1
"""Smallest depth of visible points: pixels of nearer ones would be meaningless."""

BOX_EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)])
"""Twelve edges of a box as pairs of rows of `geometry.boxes.corners`."""

# Key in the file, key in the tracking benchmark, and shape of the matrix.
_KEYS = (
    ("P2", "P2", (3, 4)),
    ("R0_rect", "R_rect", (3, 3)),
    ("Tr_velo_to_cam", "Tr_velo_cam", (3, 4)),
)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of one frame, float64.

    `p2` (3, 4) projects the rectified camera frame to pixels of the left color image, `r0_rect` (3, 3)
    rectifies the reference camera, `camera_from_lidar` (3, 4) is KITTI's Tr_velo_to_cam.
    """

    p2: NDArray[np.float64]
    r0_rect: NDArray[np.float64]
    camera_from_lidar: NDArray[np.float64]

    @cached_property
    def rect_from_lidar_matrix(self) -> NDArray[np.float64]:
        """(4, 4): homogeneous LiDAR coordinates to the rectified camera frame, R0_rect · Tr_velo_to_cam."""
        matrix = np.eye(4)
        matrix[:3] = self.r0_rect @ self.camera_from_lidar
        return matrix

    @cached_property
    def lidar_from_rect_matrix(self) -> NDArray[np.float64]:
        """(4, 4), LiDAR from rectified camera: the true inverse; stored rotations are orthonormal to 7 digits only."""
        return np.linalg.inv(self.rect_from_lidar_matrix).astype(np.float64)

    def rect_from_lidar(self, points_xyz: NDArray[np.floating]) -> NDArray[np.float64]:
        """Transform (..., 3) LiDAR metres to (..., 3) metres in the rectified camera frame."""
        return _transform(self.rect_from_lidar_matrix, points_xyz)

    def lidar_from_rect(self, points_xyz: NDArray[np.floating]) -> NDArray[np.float64]:
        """Transform (..., 3) metres in the rectified camera frame to (..., 3) LiDAR metres."""
        return _transform(self.lidar_from_rect_matrix, points_xyz)

    def project(self, points_lidar: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project LiDAR points (..., >=3) to pixels (..., 2) and depths (...), metres before the image plane.

        Pixels of points nearer than `NEAR_PLANE_M`, or behind the camera, are NaN.
        """
        image = _transform(self.p2, self.rect_from_lidar(points_lidar[..., :3]))
        depth_m = image[..., 2]
        divisor = np.where(depth_m >= NEAR_PLANE_M, depth_m, np.nan)
        return image[..., :2] / divisor[..., None], depth_m


def in_image(
    points_lidar: NDArray[np.floating],
    calib: Calibration,
    image_size_wh: Sequence[int] = DEFAULT_IMAGE_SIZE_WH,
) -> NDArray[np.bool_]:
    """Return the mask (...) of the LiDAR points (..., >=3) in front of the camera that project into the image.

    KITTI labels only the camera's field of view, so training points are cropped to it.
    """
    # Coordinates as rows, and sums in place: several times faster than short rows and temporary arrays.
    xyz = np.ascontiguousarray(points_lidar[..., :3].reshape(-1, 3).T, np.float64)
    rect = transform_columns(xyz, calib.rect_from_lidar_matrix[:3, :3], calib.rect_from_lidar_matrix[:3, 3])
    image = transform_columns(rect, calib.p2[:, :3], calib.p2[:, 3])
    before = image[2] >= NEAR_PLANE_M
    image[:2] /= np.where(before, image[2], 1.0)
    (u, v), (width, height) = image[:2], image_size_wh
    inside = before & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return inside.reshape(points_lidar.shape[:-1])


def project_edges(boxes: NDArray[np.floating], calib: Calibration) -> NDArray[np.float64]:
    """Project the edges of LiDAR boxes (N, 7) to the image: (N, 12, 2, 2) = box, edge (`BOX_EDGES`), end, pixel.

    Edges that cross the near plane are cut there; those behind it are NaN.
    """
    # The depth before the image plane is P2's third row: edges are cut after P2, before the division.
    image = _transform(calib.p2, calib.rect_from_lidar(corners(boxes).astype(np.float64)))
    ends = image[:, BOX_EDGES]
    near, far = ends[:, :, :, 2].min(axis=2), ends[:, :, :, 2].max(axis=2)
    crossing = (near < NEAR_PLANE_M) & (far >= NEAR_PLANE_M)
    start, direction = ends[:, :, 0], ends[:, :, 1] - ends[:, :, 0]
    along = (NEAR_PLANE_M - start[..., 2]) / np.where(crossing, direction[..., 2], 1.0)
    cut = start + along[..., None] * direction
    ends = np.where((crossing[..., None] & (ends[..., 2] < NEAR_PLANE_M))[..., None], cut[:, :, None], ends)
    divisor = np.where(far >= NEAR_PLANE_M, 1.0, np.nan)[..., None] * np.maximum(ends[..., 2], NEAR_PLANE_M)
    pixels: NDArray[np.float64] = ends[..., :2] / divisor[..., None]
    return pixels


def image_boxes(
    boxes: NDArray[np.floating],
    calib: Calibration,
    image_size_wh: Sequence[int] = DEFAULT_IMAGE_SIZE_WH,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the 2D boxes of LiDAR boxes (N, 7): pixels (N, 4) x1, y1, x2, y2 and the truncation (N,) in 0..1.

    Pixels are clipped to the image as KITTI does, to 0 .. width-1 and 0 .. height-1; truncation is the share
    of the unclipped rectangle that was cut away. A box behind the camera or beside the image gets
    -1, -1, -1, -1 and truncation 1.
    """
    ends = project_edges(boxes, calib).reshape(len(boxes), 2 * len(BOX_EDGES), 2)
    behind = np.isnan(ends[:, :, 0])
    low = np.where(behind[..., None], np.inf, ends).min(axis=1, initial=np.inf)
    high = np.where(behind[..., None], -np.inf, ends).max(axis=1, initial=-np.inf)
    limit = np.asarray(image_size_wh) - 1.0
    outside = ((high <= 0) | (low >= limit)).any(axis=1)
    # Boxes outside get any finite rectangle, so that the arithmetic below has no infinities.
    low, high = np.where(outside[:, None], 0.0, low), np.where(outside[:, None], 1.0, high)
    clipped_low, clipped_high = np.clip(low, 0, limit), np.clip(high, 0, limit)
    area = np.maximum((high - low).prod(axis=1), 1e-9)
    truncated = 1.0 - (clipped_high - clipped_low).prod(axis=1) / area
    pixels = np.concatenate([clipped_low, clipped_high], axis=1)
    return np.where(outside[:, None], -1.0, pixels), np.where(outside, 1.0, np.clip(truncated, 0, 1))


def calibration_of_scan(path: Path) -> Path | None:
    """Return the calibration file that belongs to a scan in KITTI's layout; None for scans in another."""
    calib_path = path.parent.parent / "calib" / f"{path.stem}.txt"
    return calib_path if path.parent.name == "velodyne" and calib_path.exists() else None


def read_calibration(path: str | Path) -> Calibration:
    """Read a KITTI calibration file of the object or the tracking benchmark.

    Raises:
        DatasetError: the file is missing, lacks a matrix, or holds one that cannot be a calibration.
    """
    try:
        text = read_text(path, DatasetError, errors="replace")
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot read the calibration ({error.strerror}); every scan needs calib/<frame id>.txt"
        ) from error
    lines = {words[0].rstrip(":"): words[1:] for line in text.splitlines() if (words := line.split())}
    matrices = [_matrix(path, lines, *key) for key in _KEYS]
    for (key, _, _), matrix in list(zip(_KEYS, matrices, strict=True))[1:]:
        # An all-zero matrix, as some converters write it, would otherwise cause NaN boxes later.
        if np.abs(matrix[:, :3] @ matrix[:, :3].T - np.eye(3)).max() > 0.01:
            raise DatasetError(f"{path}: {key} is not a rotation; restore the file")
    if not abs(np.linalg.det(matrices[0][:, :3])) > 0:
        raise DatasetError(f"{path}: {_KEYS[0][0]} is not a projection: no point would be in the image; restore it")
    return Calibration(*matrices)


def write_calibration(path: str | Path, calib: Calibration) -> None:
    """Write all seven lines of a KITTI calibration file.

    Only P2, R0_rect and Tr_velo_to_cam are known here, but other tools refuse a file that lacks the rest:
    P0, P1 and P3 repeat P2's intrinsics without a baseline (three more cameras at the reference camera's
    place), and the IMU is put at the LiDAR. Nothing in 3D detection reads these four.
    """
    reference = calib.p2.copy()
    reference[:, 3] = 0.0
    lines = {
        "P0": reference,
        "P1": reference,
        "P2": calib.p2,
        "P3": reference,
        "R0_rect": calib.r0_rect,
        "Tr_velo_to_cam": calib.camera_from_lidar,
        "Tr_imu_to_velo": np.eye(4)[:3],
    }
    with atomic_path(path) as temporary:
        text = "".join(f"{key}: {' '.join(f'{v:.12e}' for v in m.ravel())}\n" for key, m in lines.items())
        temporary.write_text(text, encoding="ascii")


def _transform(matrix: NDArray[np.float64], points: NDArray[np.floating]) -> NDArray[np.float64]:
    shape = (*points.shape[:-1], len(matrix[:3]))
    columns = points.reshape(-1, 3).T.astype(np.float64)
    return transform_columns(columns, matrix[:3, :3], matrix[:3, 3]).T.reshape(shape)


def _matrix(
    path: str | Path, lines: dict[str, list[str]], key: str, other_key: str, shape: tuple[int, int]
) -> NDArray[np.float64]:
    words = lines.get(key, lines.get(other_key))
    if words is None:
        raise DatasetError(
            f"{path}: no line '{key}:'; a KITTI calibration file has P0 to P3, R0_rect and Tr_velo_to_cam"
        )
    if len(words) != shape[0] * shape[1]:
        raise DatasetError(
            f"{path}: {key} has {len(words)} values where {shape[0] * shape[1]} are needed; restore the file"
        )
    try:
        matrix = np.array([float(word) for word in words]).reshape(shape)
    except ValueError as error:
        raise DatasetError(f"{path}: {key}: {error}; restore the file") from error
    if not (np.abs(matrix) < 1e9).all():
        raise DatasetError(f"{path}: {key} holds a value that is not finite or above 1e9; restore the file")
    return matrix
