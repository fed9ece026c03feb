"""Average of the weights of several checkpoints of one network."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import to_dict
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.checkpoint_file import read_checkpoint, require_same_arrays, write_plain


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
