"""Pictures of training frames: the network's input with the labelled boxes."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from asca_pillars.base.files import atomic_directory, portable_name, write_json
from asca_pillars.base.own_files import json_object, require_replaceable
from asca_pillars.config.tree import Config
from asca_pillars.data.augment import TrainingFrames, open_frames
from asca_pillars.data.frames import LabeledFrame, Motion, within_ranges
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.pictures.drawing import BoxLayer, Image
from asca_pillars.pictures.visualize import class_color, draw_layers, write_png

MADE_BY = "inspection.json"
PICTURES_FOLDER = ("asca inspect --draw", MADE_BY, json_object("data", "split", "config", "files"))
"""Command, marker and its recognizer, as `atomic_directory` takes them."""

_IGNORED_COLOR = (150, 150, 150)


def draw_training_frames(folder: Path, frames: TrainingFrames, count: int) -> list[str]:
    """Write NAME.png of up to `count` frames, evenly spaced, as in the first epoch; return a sentence about each.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    total = len(frames.frame_ids)
    lines = []
    for position in range(min(count, total)):
        number = position * total // min(count, total)
        frame, _ = frames.draw(0, number)
        frame = within_ranges(frame, frames.spec.ranges)
        name = portable_name(f"{position:02d}_{frame.frame_id}".replace("/", "_"))
        path = folder / f"{name}.png"
        write_png(path, draw_training_frame(frame, frames))
        lines.append(f"{path}: {len(frame.boxes)} boxes{_motion_text(frame.motion)}")
    return lines


def draw_training_frame(frame: LabeledFrame, frames: TrainingFrames) -> Image:
    """Draw one frame from above, (H, W, 3) BGR: boxes in their class's color, ignored ones gray."""
    layers = [
        BoxLayer(name, frame.boxes[frame.labels == label], class_color(name))
        for label, name in enumerate(frames.spec.class_names)
    ]
    ignored = frame.boxes[frame.labels == IGNORED]
    if len(ignored):
        layers.append(BoxLayer("ignored", ignored, _IGNORED_COLOR, thickness_px=2))
    return draw_layers(frame.points, layers, frames.spec.ranges)


def _motion_text(motion: Motion) -> str:
    """Return in words how augmentation moved the frame as a whole."""
    changes = ["mirrored"] if motion.flipped else []
    if motion.rotation_rad:
        changes.append(f"turned by {np.degrees(motion.rotation_rad):.0f} degrees")
    if motion.scale != 1:
        changes.append(f"scaled by {motion.scale:.2f}")
    if motion.shift_z_m:
        changes.append(f"raised by {motion.shift_z_m:.2f} m")
    return f"; {', '.join(changes)}" if changes else ""


def require_replaceable_pictures(out: Path) -> None:
    """Raise OutputError if `out` holds something other than pictures of an earlier run."""
    require_replaceable(out, *PICTURES_FOLDER)


def draw_frames(data: Path, split: str, config: Config, count: int, out: Path) -> list[str]:
    """Write pictures of `count` frames of the list `split` to `out`, replacing earlier ones; return a line for each.

    Raises:
        OutputError: `out` holds something else.
        DatasetError, ScanError: a frame cannot be read.
    """
    config = replace(config, data=replace(config.data, train_set=split))
    frames = open_frames(data, config, training=True)
    with atomic_directory(out, *PICTURES_FOLDER) as folder:
        lines = draw_training_frames(folder, frames, count)
        about = {"data": str(data), "split": split, "config": config.name}
        write_json(folder / MADE_BY, about | {"files": sorted(path.name for path in folder.iterdir())})
    return [line.replace(str(folder), str(out)) for line in lines]
