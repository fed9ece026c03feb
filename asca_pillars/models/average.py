"""Average of the weights of several checkpoints of one network."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.files import atomic_path
from asca_pillars.models.checkpoint_file import CheckpointFile, read_checkpoint, read_plain


def average_checkpoints(paths: Sequence[str | Path], out: str | Path, shares: Sequence[float] | None = None) -> None:
    """Write a checkpoint whose weights are the weighted mean of those of several: a model soup (arXiv 2203.05482).

    Averages are good where the checkpoints lie near each other: of one run, or where one was trained from the other
    (WiSE-FT, arXiv 2109.01903). Means and variances of batch normalization are averaged as well. Configuration, number
    of steps and expected input are the first one's.

    Args:
        paths: two or more checkpoints of networks with the same arrays.
        out: the checkpoint to write.
        shares: of each, not negative; divided by their sum. None for equal ones.

    Raises:
        ConfigError: there are fewer than two, or the shares are no weights of a mean.
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
        _require_same_arrays(files[0], file)
    averaged = {
        name: _mean([file.weights[name] for file in files], [share / sum(given) for share in given])
        for name in files[0].weights
    }
    first = read_plain(files[0].path)
    content = {
        "hyper_parameters": first["hyper_parameters"],
        "global_step": files[0].steps,
        "state_dict": {f"detector.{name}": value for name, value in averaged.items()},
    }
    with atomic_path(out) as temporary, temporary.open("wb") as written:  # see `AtomicCheckpointIO`
        torch.save(content, written)


def _mean(values: Sequence[Tensor], shares: Sequence[float]) -> Tensor:
    """Return the weighted mean in float32; counts of batches are the first one's."""
    if not values[0].is_floating_point():
        return values[0]
    total = sum(share * value.double() for share, value in zip(shares, values, strict=True))
    assert isinstance(total, Tensor)
    return total.float()


def _require_same_arrays(first: CheckpointFile, other: CheckpointFile) -> None:
    for name in first.weights | other.weights:
        shapes = [tuple(file.weights[name].shape) if name in file.weights else "missing" for file in (first, other)]
        if shapes[0] != shapes[1]:
            raise TrainingError(
                f"{other.path}: weights of another network: {name} is {shapes[1]} there and {shapes[0]} in "
                f"{first.path}; average checkpoints of one network"
            )
