"""Waymo's range images as points in the vehicle's frame, by the formulas of its published tools (v2, `lidar_utils`).

A row is a laser, from the highest down; a column is an azimuth, the first one behind the sensor, turning clockwise. A
pixel holds range (m), intensity, elongation and whether it is in a no-label zone; a range of 0 means no return.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.rotations import rotations_from_roll_pitch_yaw

Doubles = NDArray[np.float64]
_CHANNELS = 2
"""Channels used: range and intensity."""
_FAR_M = 1000.0
"""Larger ranges are invalid."""


class LidarCalibration(NamedTuple):
    """Calibration of one sensor."""

    vehicle_from_lidar: Doubles
    """(4, 4) extrinsics."""
    inclinations_rad: Doubles | None
    """(H,) elevation of the lasers from the lowest up; None: evenly spaced."""
    lowest_rad: float
    highest_rad: float


def range_image_points(
    image: NDArray[np.float32],
    calibration: LidarCalibration,
    pixel_poses: NDArray[np.float32] | None = None,
    world_from_vehicle: Doubles | None = None,
) -> NDArray[np.float32]:
    """Return points (N, 4) x, y, z in metres, vehicle's frame at the label time, and intensity mapped to 0..1 by tanh.

    Args:
        image: (H, W, 4).
        calibration: calibration of the sensor.
        pixel_poses: (H, W, 6) roll, pitch, yaw, x, y, z of the vehicle in the world when a pixel was measured; None:
            it did not move.
        world_from_vehicle: (4, 4) at the label time; with `pixel_poses`.

    Raises:
        ValueError: the image has other channels, or another number of rows than the sensor has lasers, or than the
            poses.
    """
    height, width, channels = image.shape
    lasers = height if calibration.inclinations_rad is None else len(calibration.inclinations_rad)
    if channels < _CHANNELS or height != lasers:
        raise ValueError(f"a range image of shape {list(image.shape)} for {lasers} lasers")
    if pixel_poses is not None and pixel_poses.shape != (height, width, 6):
        raise ValueError(f"poses of shape {list(pixel_poses.shape)} for a range image of {list(image.shape)}")
    rows, columns = np.nonzero((image[..., 0] > 0) & (image[..., 0] < _FAR_M))
    extrinsic = calibration.vehicle_from_lidar
    upwards = calibration.inclinations_rad
    if upwards is None:
        span = calibration.highest_rad - calibration.lowest_rad
        upwards = (np.arange(height) + 0.5) / height * span + calibration.lowest_rad
    inclination = upwards[::-1][rows]
    turned = np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    azimuth = (2 * (width - columns - 0.5) / width - 1) * np.pi - turned
    distance = image[rows, columns, 0].astype(np.float64)
    flat = np.cos(inclination) * distance
    points = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(inclination) * distance], axis=1)
    points = points @ extrinsic[:3, :3].T + extrinsic[:3, 3]
    if pixel_poses is not None and world_from_vehicle is not None:
        poses = pixel_poses[rows, columns].astype(np.float64)
        world = np.einsum("nij,nj->ni", rotations_from_roll_pitch_yaw(poses[:, :3]), points) + poses[:, 3:]
        points = (world - world_from_vehicle[:3, 3]) @ world_from_vehicle[:3, :3]
    reflectance = np.tanh(np.maximum(image[rows, columns, 1], 0))
    found = np.column_stack([points, reflectance])
    return found[(np.abs(found) < np.finfo(np.float32).max).all(axis=1)].astype(np.float32)
