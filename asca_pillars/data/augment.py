"""Random changes of a labelled frame, every one drawn from the generator that is passed in."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asca_pillars.config.tree import AugmentConfig
from asca_pillars.data.corruption import corrupt_objects, lose_reflectance
from asca_pillars.data.frames import LabeledFrame, Motion
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.geometry.overlap import bev_intersection
from asca_pillars.geometry.rotations import transform_points

OBJECT_TRIES = 10  # draws of one object's new pose before it stays where it is


def augment(
    frame: LabeledFrame,
    config: AugmentConfig,
    rng: np.random.Generator,
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> LabeledFrame:
    """Per-object noise, corruption, flip, rotation, scaling, height shift and point dropout, in this order.

    Args:
        frame: it stays as it was.
        config: which changes, and how strong.
        rng: draws them.
        sensor_m: where the sensor is in the frame of the points.
    """
    frame = replace(frame, points=frame.points.copy(), boxes=frame.boxes.copy())
    move_objects(frame, config, rng)
    frame = replace(frame, points=corrupt_objects(frame.points, frame.boxes, config, rng, sensor_m))
    lose_reflectance(frame.points, config, rng)
    motion = Motion(
        flipped=rng.random() < config.flip_probability,
        rotation_rad=rng.uniform(-config.rotation_rad, config.rotation_rad),
        scale=rng.uniform(*config.scale),
        shift_z_m=rng.uniform(-config.shift_z_m, config.shift_z_m),
    )
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
                # Looked up only now: where labelled boxes overlap, a point goes with the first that takes it.
                own = points_in_boxes(frame.points, frame.boxes[index : index + 1])[:, 0]
                local = frame.points[own, :3] - frame.boxes[index, :3]
                transform_points(local[:, :2], _rotation(turn_rad), out=local[:, :2])
                frame.points[own, :3] = local + moved[:3]
                frame.boxes[index] = moved
                break


def _rotation(angle_rad: float) -> NDArray[np.float32]:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]], dtype=np.float32)
