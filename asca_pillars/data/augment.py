"""Training frames before they become tensors: read, with objects inserted, augmented at random."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import AugmentConfig, Config
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, Motion, read_frame
from asca_pillars.data.insertion.insert_objects import Inserter, insert_objects, prepare_inserter
from asca_pillars.data.open_split import open_split
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.geometry.frame_change import transform_points
from asca_pillars.geometry.overlap import bev_intersection

FEWEST_POINTS = 5  # kept of a cut object; with fewer it could not be detected
WIDEST_CUT = 0.5  # fraction of an object's extent in azimuth or elevation


def corrupt_objects(
    points: NDArray[np.float32],
    boxes: NDArray[np.float32],
    config: AugmentConfig,
    rng: np.random.Generator,
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float32]:
    """Scale the reflectance of the points inside each box, add noise to them and cut some out.

    Args:
        points: (N, 4) x, y, z in metres (LiDAR frame), reflectance 0..1; not changed.
        boxes: (M, 7) labelled boxes, LiDAR frame.
        config: the augmentations and their strength.
        rng: random generator.
        sensor_m: position of the sensor in the points' frame, from which azimuth and elevation of cuts are measured.

    Returns:
        (K, 4), K <= N, without the points that were cut out.
    """
    brighten, shake = config.object_reflectance_gain != (1, 1), config.object_jitter_m > 0
    if not (brighten or shake or config.object_cut_probability):
        return points
    points = points.copy()
    kept = np.ones(len(points), dtype=bool)
    for inside in points_in_boxes(points, boxes).T:
        indices = np.flatnonzero(inside)
        if brighten:
            points[indices, 3] = _with_random_gain(points[indices, 3], config.object_reflectance_gain, rng)
        if shake:
            points[indices, :3] += rng.normal(0, config.object_jitter_m, (len(indices), 3))
        if config.object_cut_probability and rng.random() < config.object_cut_probability:
            rows = indices[kept[indices]]
            cut = _cut(points[rows, :3] - np.array(sensor_m, np.float32), rng)
            if len(rows) - np.count_nonzero(cut) >= FEWEST_POINTS:
                kept[rows[cut]] = False
    return points[kept]


def _with_random_gain(
    reflectance: NDArray[np.float32], gain: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.float32]:
    low, high = gain
    factor = np.exp(rng.uniform(np.log(low), np.log(high)))  # doubling is as likely as halving
    return np.minimum(reflectance * factor, 1).astype(np.float32)


def change_reflectance(points: NDArray[np.float32], config: AugmentConfig, rng: np.random.Generator) -> None:
    """Scale the reflectance of all points (N, 4), in place, and overwrite it in some samples: some sensors report none.

    Half of the overwritten samples get 0 for a random share of the points, the other half one value for all.
    """
    if config.reflectance_gain != (1, 1):
        points[:, 3] = _with_random_gain(points[:, 3], config.reflectance_gain, rng)
    if not config.reflectance_loss_probability or rng.random() >= config.reflectance_loss_probability:
        return
    if rng.random() < 0.5:
        points[rng.random(len(points)) < rng.random(), 3] = 0
    else:
        points[:, 3] = rng.random()


def _cut(xyz: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return the mask of an object's points (N, 3) in a random azimuth sector, or in a random group of rings.

    Something thin in front takes away a sector of azimuth, a hedge or a beam that fails a range of elevation.
    """
    if not len(xyz):
        return np.zeros(0, dtype=bool)
    if rng.random() < 0.5:
        center = xyz.mean(axis=0)  # angles relative to the object's own direction do not wrap
        along = xyz[:, 0] * center[0] + xyz[:, 1] * center[1]
        across = xyz[:, 1] * center[0] - xyz[:, 0] * center[1]
        angle = np.arctan2(across, along)
    else:
        angle = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    extent = np.ptp(angle)
    width = rng.uniform(0, WIDEST_CUT) * extent
    start = angle.min() + rng.uniform(0, 1) * (extent - width)
    return (angle >= start) & (angle <= start + width)


OBJECT_TRIES = 10  # sampled poses of an object before it keeps its old one


def augment(
    frame: LabeledFrame,
    config: AugmentConfig,
    rng: np.random.Generator,
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> LabeledFrame:
    """Apply object noise, corruption, flip, rotation, scaling, height shift and point dropout, in this order.

    Args:
        frame: not changed.
        config: the augmentations and their strength.
        rng: random generator.
        sensor_m: position of the sensor in the frame of the points.
    """
    frame = replace(frame, points=frame.points.copy(), boxes=frame.boxes.copy())
    move_objects(frame, config, rng)
    frame = replace(frame, points=corrupt_objects(frame.points, frame.boxes, config, rng, sensor_m))
    change_reflectance(frame.points, config, rng)
    motion = Motion(
        flipped=rng.random() < config.flip_probability,
        rotation_rad=rng.uniform(-config.rotation_rad, config.rotation_rad),
        scale=rng.uniform(*config.scale),
        shift_z_m=rng.uniform(-config.shift_z_m, config.shift_z_m),
    )
    # Drawn only where it is asked for: other configurations see the samples that they always saw.
    if config.flip_x_probability and rng.random() < config.flip_x_probability:
        motion = motion._replace(flipped=not motion.flipped, rotation_rad=motion.rotation_rad + math.pi)
    move_scene(frame, motion)
    kept = rng.random(len(frame.points)) >= rng.uniform(0, config.point_dropout)
    return replace(frame, points=frame.points[kept], motion=motion)


def move_scene(frame: LabeledFrame, motion: Motion) -> None:
    """Move points and boxes, in place."""
    if motion.flipped:
        flip_y(frame)
    rotate(frame, motion.rotation_rad)
    scale(frame, motion.scale)
    frame.points[:, 2] += motion.shift_z_m
    frame.boxes[:, 2] += motion.shift_z_m


def flip_y(frame: LabeledFrame) -> None:
    """Mirror the frame, in place, about the x axis: left becomes right."""
    frame.points[:, 1] *= -1
    frame.boxes[:, 1] *= -1
    frame.boxes[:, 6] = wrap_angle(-frame.boxes[:, 6])


def rotate(frame: LabeledFrame, angle_rad: float) -> None:
    """Turn the frame, in place, counter-clockwise about the z axis."""
    rotation = _rotation(angle_rad)
    for rows in (frame.points, frame.boxes):
        transform_points(rows[:, :2], rotation, out=rows[:, :2])
    frame.boxes[:, 6] = wrap_angle(frame.boxes[:, 6] + np.float32(angle_rad))


def scale(frame: LabeledFrame, factor: float) -> None:
    """Scale the frame, in place, about the origin."""
    frame.points[:, :3] *= factor
    frame.boxes[:, :6] *= factor


def move_objects(frame: LabeledFrame, config: AugmentConfig, rng: np.random.Generator) -> None:
    """Shift and turn each object with its points, in place, unless it would run into another one (SECOND, 3.2)."""
    if not len(frame.boxes) or (config.object_shift_m == 0 and config.object_rotation_rad == 0):
        return
    for index in range(len(frame.boxes)):
        others = np.delete(frame.boxes, index, axis=0)
        for _ in range(OBJECT_TRIES):
            shift_m = rng.normal(0, config.object_shift_m, 3)
            turn_rad = rng.uniform(-config.object_rotation_rad, config.object_rotation_rad)
            moved = frame.boxes[index].copy()
            moved[:3] += shift_m
            moved[6] = wrap_angle(moved[6] + turn_rad)
            if not bev_intersection(moved[None], others).any():
                # Looked up only now: where labelled boxes overlap, a point belongs to the first one that selects it.
                inside = points_in_boxes(frame.points, frame.boxes[index : index + 1])[:, 0]
                local = frame.points[inside, :3] - frame.boxes[index, :3]
                transform_points(local[:, :2], _rotation(turn_rad), out=local[:, :2])
                frame.points[inside, :3] = local + moved[:3]
                frame.boxes[index] = moved
                break


def _rotation(angle_rad: float) -> NDArray[np.float32]:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]], dtype=np.float32)


@dataclass(frozen=True)
class TrainingFrames:
    """Frames of one list, augmented if `augmentation` is given.

    The result depends on the seed, the epoch and the frame alone.

    Attributes:
        split: the list.
        spec: spec with the classes.
        camera_view: keep only the points within the camera image.
        min_points: an object with fewer points inside its box is IGNORED.
        augmentation: random changes; None for validation.
        inserter: inserts objects of other frames before augmentation.
        seed: seed of all random draws.
    """

    split: LabeledSplit
    spec: DetectorSpec
    camera_view: bool
    min_points: int
    augmentation: AugmentConfig | None = None
    inserter: Inserter | None = None
    seed: int = 0

    @cached_property
    def frame_ids(self) -> tuple[str, ...]:
        """Frame ids of the list; DatasetError if it is missing or wrong."""
        return self.split.frame_ids

    def draw(self, epoch: int, number: int) -> tuple[LabeledFrame, np.random.Generator | None]:
        """Return frame `number` in an epoch, and the random generator after it; None without augmentation.

        Raises:
            DatasetError, ScanError: a file of the frame is missing or damaged.
        """
        rng = None if self.augmentation is None else np.random.default_rng((self.seed, epoch, number))
        frame = read_frame(
            self.split,
            self.frame_ids[number],
            self.spec.class_names,
            camera_view=self.camera_view,
            min_points=self.min_points,
        )
        if self.inserter is not None and self.inserter.settings.inserts_in(epoch):
            # A separate generator: all other random numbers are the same without insertion.
            frame = insert_objects(frame, self.inserter, np.random.default_rng((self.seed, epoch, number, 1)))
        if self.augmentation is not None and rng is not None:
            x_m, y_m, z_m = self.split.to_sensor.inverse.shift_m.tolist()
            frame = augment(frame, self.augmentation, rng, (x_m, y_m, z_m))
        return frame, rng


def open_frames(root: str | Path, config: Config, *, training: bool, reporter: Reporter = SILENT) -> TrainingFrames:
    """Open the training or validation frames of `config`; the object database is built if it is missing.

    Raises:
        DatasetError: a missing list, scan, label or calibration file; a class to insert that no frame has.
    """
    data, spec, insert = config.data, config.model.spec, config.augment.insert
    split = open_split(root, data.train_set if training else data.val_set)
    inserts = training and insert.method != "none"
    return TrainingFrames(
        split,
        spec,
        camera_view=data.camera_view and split.has_camera,
        min_points=data.min_points,
        augmentation=config.augment if training else None,
        inserter=prepare_inserter(split, spec, data, insert, reporter) if inserts else None,
        seed=config.train.seed,
    )
