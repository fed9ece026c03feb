"""Training samples: labelled frames, augmented and prepared for a family of detectors.

Labels are checked before a training, which would fail without usable boxes.
`prepare` computes the caches of a dataset before a training instead of during its first epoch.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._pytree import tree_map_only
from torch.utils.data import Dataset

from asca_pillars.base.errors import AscaError, DatasetError, WorkerError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import Config
from asca_pillars.data.augment import TrainingFrames, open_frames
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, other_spelling, read_frame, within_ranges
from asca_pillars.data.insertion.free_space import prepare_free_spaces
from asca_pillars.data.insertion.insert_objects import Inserter, prepare_inserter
from asca_pillars.data.open_split import open_split
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.models.build import build_preparation
from asca_pillars.models.trainable import Preparation, to_device

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
    types = ", ".join(f"{kind} {count}" for kind, count in labels.types.most_common(10)) or "none at all"
    return f"labels there: {types}; list other frames in ImageSets/, or take other classes (`asca inspect --propose`)"


@dataclass(frozen=True)
class Sample:
    """One frame, and what the detector's `Preparation` made of it."""

    frame: LabeledFrame
    prepared: Any


@dataclass
class Batch:
    """Samples of B frames.

    Attributes:
        frame_ids: names of the frames.
        boxes: (M, 7) labelled boxes of each frame, NumPy, LiDAR frame, metres and radians; for evaluation.
        labels: (M,) class indices of each frame's boxes, or IGNORED.
        inputs: input and targets of the network, tensors.
    """

    frame_ids: list[str]
    boxes: list[np.ndarray]
    labels: list[np.ndarray]
    inputs: Any

    def to(self, device: Any) -> "Batch":
        """Move the tensors, in place, as Lightning expects of a batch."""
        self.inputs = to_device(self.inputs, device)
        return self

    def pin_memory(self) -> "Batch":
        """Pin the tensors, in place, as `DataLoader` expects of a batch."""
        self.inputs = tree_map_only(Tensor, Tensor.pin_memory, self.inputs)
        return self


@dataclass(frozen=True)
class Collate:
    """Collate function that makes a `Batch` of samples; an object, because loader processes pickle it.

    An error in the place of a sample stands for the whole batch: torch wraps what a loader process raises into the
    text of its traceback, and the loop is to raise the one line itself.
    """

    preparation: Preparation

    def __call__(self, samples: Sequence[Sample | AscaError]) -> Batch | AscaError:
        """Make a batch, or return the first error."""
        good = []
        for sample in samples:
            if isinstance(sample, AscaError):
                return sample
            good.append(sample)
        return Batch(
            frame_ids=[sample.frame.frame_id for sample in good],
            boxes=[sample.frame.boxes for sample in good],
            labels=[sample.frame.labels for sample in good],
            inputs=self.preparation.collate([sample.prepared for sample in good]),
        )


class LabeledDataset(Dataset[Sample | AscaError]):
    """Frames as samples for one family of detectors.

    A sample does not depend on the number of workers or on samples before it, so that a resumed run gets the same as an
    uninterrupted one. An index is therefore a pair (epoch, frame number), see `EpochSampler`.

    Args:
        frames: read and augmented.
        preparation: of the detector that is trained.
    """

    def __init__(self, frames: TrainingFrames, preparation: Preparation) -> None:
        self.frames, self.preparation = frames, preparation
        self.frame_ids = frames.frame_ids

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: tuple[int, int]) -> Sample | AscaError:
        """Return the sample (epoch, frame number), or the error in the frame's files."""
        try:
            return self.sample(*index)
        except AscaError as error:
            return error
        except (OSError, MemoryError) as error:
            return WorkerError(f"frame {self.frame_ids[index[1]]} cannot be loaded ({error or type(error).__name__})")

    def sample(self, epoch: int, number: int) -> Sample:
        """Read and prepare one sample.

        Raises:
            DatasetError, ScanError: a file of the frame is missing or damaged.
        """
        frame, rng = self.frames.draw(epoch, number)
        return Sample(within_ranges(frame, self.frames.spec.ranges), self.preparation.prepare(frame, rng))


def open_dataset(root: str | Path, config: Config, *, training: bool, reporter: Reporter = SILENT) -> LabeledDataset:
    """Open the training or the validation samples of `config`.

    Raises:
        DatasetError: as `open_frames`.
    """
    frames = open_frames(root, config, training=training, reporter=reporter)
    return LabeledDataset(frames, build_preparation(config.model, frames.split, config.data, reporter))


def prepare(config: Config, data: str | Path, *, workers: int, reporter: Reporter = SILENT) -> Inserter | None:
    """Compute the object database and the maps of free ground, or for a second stage the proposals of its first.

    What is there and unchanged is used again.

    Args:
        config: of the training. Without an insertion method in it, what RS-Aug needs is prepared.
        data: a dataset's folder.
        workers: processes.
        reporter: for the progress.

    Returns:
        What inserts objects; None for a second stage, which has no insertion.

    Raises:
        AscaError: a frame cannot be read, or a file not be written.
    """
    settings = replace(config.data, workers=workers)
    if config.model.kind == "pillar_refine":
        for name in (settings.train_set, settings.val_set):
            build_preparation(config.model, open_split(data, name), settings, reporter)
        return None
    insert = config.augment.insert
    insert = insert if insert.method != "none" else replace(insert, method="rs_aug")
    split = open_split(data, settings.train_set)
    inserter = prepare_inserter(split, config.model.spec, settings, insert, reporter)
    if insert.method == "rs_aug":
        view = inserter.camera_view
        prepare_free_spaces(split, inserter.prepared, camera_view=view, workers=workers, reporter=reporter)
    return inserter
