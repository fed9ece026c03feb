"""Training frames before they become tensors: read, with objects inserted, augmented."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import AugmentConfig, Config
from asca_pillars.data.augment import augment
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, read_frame
from asca_pillars.data.insertion.insert_objects import Inserter, insert_objects, prepare_inserter
from asca_pillars.data.open_split import open_split
from asca_pillars.detection.spec import DetectorSpec


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
