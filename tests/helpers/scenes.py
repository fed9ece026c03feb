"""Small made-up street scenes for tests: a flat ground, and boxes whose visible faces are covered with points."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import Calibration, KittiSplit, objects_from_boxes, write_calibration, write_image_set
from asca_pillars.data.kitti import write_labels as write_label_file
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.scan_reader import write_scan

# Rectangular, asymmetric, with a positive minimum.
GRID = PillarGrid(x_range_m=(4.8, 25.28), y_range_m=(-6.4, 7.68), v_max_m=0.32, zones=2)
SPEC = PillarSpec(grid=GRID, limits=PillarLimits(max_pillars=2000, max_points=24))
SIZES = {"Car": (3.9, 1.6, 1.56), "Pedestrian": (0.8, 0.6, 1.73), "Cyclist": (1.76, 0.6, 1.73)}
GROUND_Z_M = -1.73

CALIBRATION = Calibration(
    p2=np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]]),
    r0_rect=np.eye(3),
    camera_from_lidar=np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]),
)


def make_scene(seed: int, names: tuple[str, ...] = ("Car", "Car", "Pedestrian", "Cyclist")) -> tuple:
    """Points (N, 4), boxes (M, 7) and the given class names; the boxes stand apart in the camera's view."""
    rng = np.random.default_rng(seed)
    boxes = []
    for index, name in enumerate(names):
        x = 8 + 16 * (index + rng.uniform(0.1, 0.9)) / len(names)  # one behind the other, so that none collide
        length, width, height = np.array(SIZES[name]) * rng.uniform(0.9, 1.1, 3)
        boxes.append(
            [x, rng.uniform(-3, 3), GROUND_Z_M + height / 2, length, width, height, rng.uniform(-np.pi, np.pi)]
        )
    array = np.array(boxes, dtype=np.float32).reshape(-1, 7)
    surfaces = [_surface(box, rng) for box in array]
    ground = np.column_stack(
        [rng.uniform(5, 25, 2000), rng.uniform(-6, 7, 2000), np.full(2000, GROUND_Z_M), rng.uniform(0.1, 0.4, 2000)]
    )
    return np.concatenate([ground, *surfaces]).astype(np.float32), array, names


def write_dataset(root: Path, frames: int, val_frames: int = 1) -> Path:
    """A KITTI-layout folder of made-up scenes; the last `val_frames` are listed for validation."""
    split = KittiSplit(root)
    ids = [f"{number:06d}" for number in range(frames)]
    for number, frame_id in enumerate(ids):
        points, boxes, names = make_scene(number)
        write_scan(split.scan_path(frame_id), points)
        write_calibration(split.calib_path(frame_id), CALIBRATION)
        write_label_file(split.label_path(frame_id), objects_from_boxes(boxes, names, CALIBRATION))
    write_image_set(root, "train", ids[: frames - val_frames])
    write_image_set(root, "val", ids[frames - val_frames :])
    return root


def _surface(box: NDArray[np.float32], rng: np.random.Generator, points: int = 150) -> NDArray[np.float64]:
    """Points on the four sides of a box, tighter at its front so that its heading can be seen."""
    length, width, height, yaw = box[3:]
    local = rng.uniform(-0.5, 0.5, (points, 3))
    side = rng.integers(0, 4, points)
    local[side == 0, 0], local[side == 1, 0] = 0.5, -0.5
    local[side == 2, 1], local[side == 3, 1] = 0.5, -0.5
    reflectance = np.where(local[:, 0] > 0, 0.9, 0.1)
    local *= (length, width, height)
    x = np.cos(yaw) * local[:, 0] - np.sin(yaw) * local[:, 1] + box[0]
    y = np.sin(yaw) * local[:, 0] + np.cos(yaw) * local[:, 1] + box[1]
    return np.column_stack([x, y, local[:, 2] + box[2], reflectance])
