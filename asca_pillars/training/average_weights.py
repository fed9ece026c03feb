"""Average of the weights of several checkpoints of one network, and statistics of batch normalization for it.

Those of the checkpoints do not fit the averaged weights, so they can be computed anew.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn
from torch.optim.swa_utils import update_bn

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint_file import read_checkpoint, read_plain, require_same_arrays, write_plain
from asca_pillars.models.trainable import Trainable
from asca_pillars.training.dataset import LabeledDataset, open_dataset


def average_checkpoints(
    paths: Sequence[str | Path],
    out: str | Path,
    shares: Sequence[float] | None = None,
    *,
    shipped_as: DetectorSpec | None = None,
) -> None:
    """Write a checkpoint whose weights are the weighted mean of those of several: a model soup (arXiv 2203.05482).

    Averages are good where the checkpoints lie near each other: of one run, or where one was trained from the other
    (WiSE-FT, arXiv 2109.01903). Means and variances of batch normalization are averaged as well. Configuration, number
    of steps and expected input are the first one's.

    Args:
        paths: two or more checkpoints of networks with the same arrays.
        out: the checkpoint to write.
        shares: of each, not negative; divided by their sum. None for equal ones.
        shipped_as: of the bundle that the first one lies in: its score thresholds and suppression go into the average,
            because a bundle has others than its weights were trained with. None: those of the first checkpoint.

    Raises:
        ConfigError: there are fewer than two, or the shares are not the weights of a mean.
        TrainingError: one is missing or damaged, or they are of different networks.
    """
    if len(paths) < 2:
        raise ConfigError(f"{len(paths)} checkpoint: give two or more to average")
    given = [1.0] * len(paths) if shares is None else [*shares]
    if len(given) != len(paths) or min(given) < 0 or not sum(given) > 0:
        raise ConfigError(
            f"shares {', '.join(f'{share:g}' for share in given)}: give one for each of the {len(paths)} checkpoints, "
            "none of them negative, not all zero"
        )
    files = [read_checkpoint(path) for path in paths]
    for file in files[1:]:
        remedy = "average checkpoints of one network"
        require_same_arrays(file.weights, files[0].weights, file.path, str(files[0].path), remedy)
    averaged = {
        name: _mean([file.weights[name] for file in files], [share / sum(given) for share in given])
        for name in files[0].weights
    }
    config, expected_input = files[0].config, files[0].expected_input
    if shipped_as is not None:
        spec = config.model.spec.with_post_processing_of(shipped_as)
        config = replace(config, model=replace(config.model, spec=spec))  # type: ignore[arg-type]  # of the same kind
    about = {
        "config": to_dict(config),
        "expected_input": None if expected_input is None else to_dict(expected_input),
    }
    content = {
        "hyper_parameters": about,
        "global_step": files[0].steps,
        "state_dict": {f"detector.{name}": value for name, value in averaged.items()},
    }
    write_plain(content, out)


def _mean(values: Sequence[Tensor], shares: Sequence[float]) -> Tensor:
    """Return the weighted mean in float32; counts of batches are the first one's."""
    if not values[0].is_floating_point():
        return values[0]
    total = sum(share * value.double() for share, value in zip(shares, values, strict=True))
    assert isinstance(total, Tensor)
    return total.float()


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
