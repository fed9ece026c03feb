"""Frames of a few scored objects."""

from dataclasses import replace
from typing import Any

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.objects import FrameObjects, frame_objects

NAMES = ("Car", "Pedestrian", "Cyclist")
SIZES_HWL = {"Pedestrian": (1.7, 0.6, 0.8), "Person_sitting": (1.3, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8)}
CAR_HWL = (1.5, 1.6, 4.0)
IMAGE = (100.0, 100.0, 160.0, 150.0)


def item(kind: str, x: float, z: float, score: float | None = None, **changes: Any) -> KittiObject:
    """An object that counts at every difficulty, heading to the right; its image box says nothing of its place."""
    height, width, length = SIZES_HWL.get(kind, CAR_HWL)
    made = KittiObject(kind, 0.0, 0, 0.0, IMAGE, height, width, length, x, 1.6, z, 0.0, score)
    return replace(made, **changes)


def frame(*objects: KittiObject, name: str = "0") -> FrameObjects:
    return frame_objects(name, objects)
