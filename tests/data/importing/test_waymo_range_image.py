"""Points of a range image, pixel by pixel with scipy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asca_pillars.data.importing.waymo_range_image import LidarCalibration, range_image_points

HEIGHT, WIDTH = 3, 8
SENSOR, SENSOR_M = Rotation.from_euler("xyz", [0.05, -0.1, 0.7]), np.array([1.4, 0.2, 2.0])
CAR, CAR_M = Rotation.from_euler("xyz", [-0.1, 0.2, 2.5]), np.array([100.0, -50.0, 3.0])


def placed(turn: Rotation, place_m: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), place_m
    return matrix


def drawn_image(rng: np.random.Generator) -> np.ndarray:
    """Every other pixel has a return."""
    image = rng.uniform(3, 40, (HEIGHT, WIDTH, 4)).astype(np.float32)
    image[..., 0] *= np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 2
    return image


def seen(image: np.ndarray, upwards_rad: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
    """Row, column and point in the vehicle's frame of each return; lasers from the lowest up."""
    turned = np.arctan2(SENSOR.as_matrix()[1, 0], SENSOR.as_matrix()[0, 0])
    found = []
    for row, column in np.argwhere(image[..., 0] > 0).tolist():
        # The first column looks straight behind the vehicle, the next ones go clockwise as seen from above.
        azimuth = np.pi - 2 * np.pi * (column + 0.5) / WIDTH - turned
        ray = Rotation.from_euler("yz", [-upwards_rad[HEIGHT - 1 - row], azimuth]).apply([image[row, column, 0], 0, 0])
        found.append((row, column, SENSOR.apply(ray) + SENSOR_M))
    return found


@pytest.mark.parametrize("even", [False, True])
def test_every_return_lies_on_its_beam(even: bool) -> None:
    """Waymo gives one sensor's beams one by one, and of the others the ends of a span that is cut into even parts."""
    low, high, image = -0.5, 0.1, drawn_image(np.random.default_rng(0))
    upwards = np.array([low + (number + 0.5) / HEIGHT * (high - low) for number in range(HEIGHT)])
    given = upwards if even else np.array([-0.45, -0.1, 0.05])
    calibration = LidarCalibration(placed(SENSOR, SENSOR_M), None if even else given, low, high)
    points = range_image_points(image, calibration)
    assert len(points) == HEIGHT * WIDTH // 2
    np.testing.assert_allclose(points[:, :3], [point for *_, point in seen(image, given)], atol=1e-5)


def test_a_car_that_leans_while_it_turns_is_taken_back_to_one_time() -> None:
    rng = np.random.default_rng(1)
    image, upwards = drawn_image(rng), np.array([-0.4, -0.1, 0.05])
    poses = np.concatenate([rng.uniform(-0.5, 0.5, (HEIGHT, WIDTH, 3)), rng.uniform(-9, 9, (HEIGHT, WIDTH, 3))], axis=2)
    calibration = LidarCalibration(placed(SENSOR, SENSOR_M), upwards, 0.0, 0.0)
    points = range_image_points(image, calibration, poses.astype(np.float32), placed(CAR, CAR_M))
    expected = []
    for row, column, point in seen(image, upwards):
        turn, place_m = Rotation.from_euler("xyz", poses[row, column, :3]), poses[row, column, 3:]
        expected.append(CAR.inv().apply(turn.apply(point) + place_m - CAR_M))
    np.testing.assert_allclose(points[:, :3], expected, atol=1e-4)
