"""Check of the labels before a training, which would fail without usable boxes."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import Config
from asca_pillars.data.frames import LabeledSplit, other_spelling, read_frame, within_ranges
from asca_pillars.data.yaw_units import check_yaws

FRAMES_WITH_POINTS = 50
"""Number of frames with boxes whose points are counted before all are assumed to have none."""


FEWEST_FRAMES = 20
"""Largest number of frames whose yaws are checked."""


@dataclass
class _Labels:
    """Boxes of a list so far: by type, by class within the detector's ranges, and whether one has enough points."""

    yaws: list[NDArray[np.float64]] = field(default_factory=list)
    types: Counter[str] = field(default_factory=Counter)
    in_ranges: Counter[str] = field(default_factory=Counter)
    frames_read: int = 0
    one_with_points: bool = False


def require_boxes(split: LabeledSplit, config: Config, *, training: bool, reporter: Reporter = SILENT) -> list[str]:
    """Make sure that a list has boxes of the classes to be learnt; returns a line for each other problem.

    These are a class without a box, and yaws that look like degrees. Frames are read until every class is found.

    Args:
        split: the training or the validation list.
        config: classes, ranges, and the points that a box needs.
        training: whether a list without any box is refused. A validation list is refused only if its labels spell
            the classes in another way.
        reporter: for the progress.

    Raises:
        DatasetError: there is no box of any class that could be learnt; a file is missing or cannot be read.
    """
    split.require_files()
    names = config.model.spec.class_names
    labels = _Labels()
    order = np.random.default_rng(0).permutation(len(split.frame_ids)).tolist()
    step = "Looking for boxes of each class"
    for number in reporter.track(order, step):
        _add(labels, split, split.frame_ids[number], config)
        complete = labels.one_with_points and all(labels.in_ranges[name] for name in names)
        if complete and len(labels.yaws) >= FEWEST_FRAMES:
            reporter.progress(step, len(order), len(order))
            break
    missing = [name for name in names if not labels.in_ranges[name]]
    place = f"{split.root}: list `{split.name}`"
    if len(missing) == len(names):
        respelled = any(other_spelling(name, labels.types) for name in names)
        text = f"{place} has no box of {', '.join(names)}: {_no_boxes_reason(missing, labels)}"
        if training or respelled:
            raise DatasetError(text)
        return [f"{text}; recall cannot be measured"]
    if training and not labels.one_with_points:
        raise DatasetError(
            f"{place}: none of the boxes in {labels.frames_read} frames has data.min_points = {config.data.min_points} "
            "points inside; labels (and calib) must belong to the scans: see `asca inspect`"
        )
    warning = check_yaws(labels.yaws)
    cannot = "it cannot be learnt" if training else "its recall cannot be measured"
    lines = [f"{place} has no box of {name}, {cannot}: {_no_boxes_reason([name], labels)}" for name in missing]
    return lines if warning is None else [*lines, f"{place}: {warning}"]


def _add(labels: _Labels, split: LabeledSplit, frame_id: str, config: Config) -> None:
    spec, data = config.model.spec, config.data
    boxes, types = split.labeled_boxes(frame_id)
    labels.yaws.append(split.label_yaws(frame_id))
    labels.types.update(types)
    held = spec.ranges.hold_centers(boxes)
    names = [name for name, inside in zip(types, held, strict=True) if inside and name in spec.class_names]
    labels.in_ranges.update(names)
    if names and not labels.one_with_points and labels.frames_read < FRAMES_WITH_POINTS:
        labels.frames_read += 1
        view = data.camera_view and split.has_camera
        frame = read_frame(split, frame_id, spec.class_names, camera_view=view, min_points=data.min_points)
        labels.one_with_points = bool((within_ranges(frame, spec.ranges).labels >= 0).any())


def _no_boxes_reason(names: list[str], labels: _Labels) -> str:
    spellings = {name: other for name in names if (other := other_spelling(name, labels.types)) is not None}
    if spellings:
        listed = ", ".join(f"'{other}'" for other in spellings.values())
        what = "it" if len(spellings) == 1 else "them"
        return f"the labels spell {what} {listed}; rename there or in model.spec.classes"
    if outside := [name for name in names if labels.types[name]]:
        count = sum(labels.types[name] for name in outside)
        return f"{count} lie outside the ranges of model.spec.grid; widen them, see `asca inspect`"
    there = ", ".join(f"{kind} {count}" for kind, count in labels.types.most_common(10)) or "none at all"
    return f"labels there: {there}; list other frames in ImageSets/, or take other classes (`asca inspect --propose`)"
