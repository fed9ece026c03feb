"""Statistics of batch normalization, computed anew where those of a checkpoint do not fit its weights."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn
from torch.optim.swa_utils import update_bn

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint_file import read_checkpoint, read_plain, write_plain
from asca_pillars.models.trainable import Trainable
from asca_pillars.training.dataset import LabeledDataset, open_dataset

BATCH_FRAMES = 8
"""Frames of a batch; each batch counts alike."""


def update_batch_norm(
    path: str | Path,
    data: str | Path,
    split: str | None = None,
    *,
    frames: int = 500,
    reporter: Reporter = SILENT,
) -> None:
    """Compute means and variances of a checkpoint's batch normalization from a dataset, and write them into it.

    An average of weights needs it. Activations of the averaged network vary less than the mean of the networks'
    variances says (Jordan et al., REPAIR, arXiv 2211.08403), and what is predicted from them is off: heights of cars by
    5 cm in our case. The frames are augmented as in the training, but nothing is inserted; their labels do not count.

    Args:
        path: the checkpoint, which is replaced.
        data: a dataset's folder.
        split: the list of its frames; None: the training list of the checkpoint's configuration.
        frames: so many, drawn at random, are read.
        reporter: for the progress.

    Raises:
        AscaError: the checkpoint or a frame cannot be read.
    """
    file = read_checkpoint(path)
    config, insert = file.config, replace(file.config.augment.insert, method="none")
    config = replace(
        config,
        augment=replace(config.augment, insert=insert),
        data=replace(config.data, train_set=split or config.data.train_set),
    )
    dataset = open_dataset(data, config, training=True, reporter=reporter)
    detector = build_model(config.model)
    file.fill(detector)
    update_bn(_batches(dataset, frames, reporter), _Prediction(detector))
    content = read_plain(Path(path))
    trained = detector.state_dict()
    content["state_dict"] = {
        name: trained[name.removeprefix("detector.")] if "running_" in name else value
        for name, value in content["state_dict"].items()
    }
    write_plain(content, path)


class _Prediction(nn.Module):
    """The call that `update_bn` makes."""

    def __init__(self, detector: Trainable) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, batch: Any) -> Any:
        return self.detector.predict(batch)


def _batches(dataset: LabeledDataset, frames: int, reporter: Reporter) -> Iterator[list[Any]]:
    """Yield the inputs of batches, in lists, because `update_bn` takes the first entry of a tuple."""
    order = np.random.default_rng(dataset.frames.seed).permutation(len(dataset))[:frames]
    batches = [order[first : first + BATCH_FRAMES] for first in range(0, len(order), BATCH_FRAMES)]
    for numbers in reporter.track(batches, "Batch normalization"):
        samples = [dataset.sample(0, int(number)) for number in numbers]
        yield [dataset.preparation.collate([sample.prepared for sample in samples])]
