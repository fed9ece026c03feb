"""Checkpoint files: configuration and weights, before a network is built."""

import hashlib
import pickle
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from asca_pillars.base.errors import ConfigError, OutputError, TrainingError
from asca_pillars.base.files import WEIGHTS_FILE, atomic_path, require_content
from asca_pillars.base.schema import parse
from asca_pillars.config.tree import Config
from asca_pillars.scans.input_check import ExpectedInput


class CheckpointFile(NamedTuple):
    """Content of a checkpoint of `asca train`."""

    path: Path
    config: Config
    """Configuration of its training run."""
    weights: dict[str, Tensor]
    """The network's `state_dict`; with `train.ema` the averaged weights."""
    steps: int
    """Optimizer steps behind them."""
    expected_input: ExpectedInput | None
    """Statistics of the scans that it was trained on; None in checkpoints made before they were measured."""

    def fill(self, network: nn.Module) -> None:
        """Load the weights into the network that they are of.

        Raises:
            TrainingError: they are of another one.
        """
        try:
            network.load_state_dict(self.weights)
        except RuntimeError as error:
            raise _damaged(self.path, error) from error


def read_checkpoint(path: str | Path) -> CheckpointFile:
    """Read a checkpoint of `asca train`, weights only: nothing in the file is executed.

    last.ckpt, best.ckpt and weights.ckpt are read alike.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
    """
    path = Path(path)
    require_content(path, TrainingError)
    if not path.is_file():
        raise TrainingError(f"{path}: no such checkpoint; a run keeps its own in RUN/checkpoints/last.ckpt")
    try:
        content = read_plain(path)
        if "hyper_parameters" not in content and (library := _library_of(content)):
            raise TrainingError(f"{path}: a checkpoint of {library}; convert it with `asca import-weights`")
        config = parse(Config, content["hyper_parameters"]["config"], str(path))
        weights = {
            name.removeprefix("detector."): value
            for name, value in content["state_dict"].items()
            if name.startswith("detector.")
        }
        measured = content["hyper_parameters"].get("expected_input")
        expected = None if measured is None else parse(ExpectedInput, measured, str(path))
        return CheckpointFile(path, config, weights, int(content["global_step"]), expected)
    except TrainingError:
        raise
    except ConfigError as error:
        raise TrainingError(f"{error}; the checkpoint was made by another version of asca-pillars") from None
    except Exception as error:  # torch.load raises whatever the damaged bytes happen to trigger
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> TrainingError:
    return TrainingError(f"{path}: not a checkpoint of `asca train`, or damaged ({read_failure(error)})")


def read_plain(path: Path) -> dict[str, Any]:
    """Read the dictionary in a file of `torch.save`, weights only: nothing in the file is executed.

    Raises:
        ValueError: it holds something else than a dictionary.
        Exception: whatever the damaged bytes happen to trigger in `torch.load`.
    """
    with warnings.catch_warnings(action="ignore"):  # from pickles that are not checkpoints, which raise an error
        content = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(content, dict):
        raise ValueError(f"it holds a {type(content).__name__}, where a checkpoint holds a dictionary")
    return content


def _library_of(content: Mapping[str, Any]) -> str | None:
    """Name the library whose training wrote a checkpoint, where `asca import-weights` may know it."""
    if "model_state" in content:
        return "OpenPCDet"
    return "mmdetection3d" if "meta" in content and "state_dict" in content else None


def read_failure(error: Exception) -> str:
    """Return in one line why a file of weights could not be read.

    torch.load's message for a pickle that it refuses is left out: it advises to execute the content.
    """
    if isinstance(error, pickle.UnpicklingError):
        return "it is not plain arrays and settings; nothing in it was executed"
    if isinstance(error, KeyError):
        return f"no {error}" if isinstance(error.args[0], str) else "it was not written by torch.save"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def save_weights(checkpoint: Path, path: Path) -> None:
    """Write what detecting, exporting and --init need of a checkpoint to `path`, in half the digits.

    Matrices and kernels are float16; what is added or divided by (biases, statistics of the normalization) stays
    float32. Optimizer and averaging are left out: a run cannot be resumed from it.
    """
    content = read_plain(checkpoint)
    content = {
        "hyper_parameters": content["hyper_parameters"],
        "global_step": content["global_step"],
        "state_dict": {
            name: value.half() if value.is_floating_point() and value.ndim > 1 else value
            for name, value in content["state_dict"].items()
        },
    }
    write_plain(content, path)


def write_plain(content: Mapping[str, Any], path: str | Path) -> None:
    """Write a dictionary of plain values and tensors, which `read_plain` reads."""
    # Opened here: torch writes the name of a file that it opens into it, and these are temporary.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(dict(content), file)


def require_new_checkpoint(path: Path) -> None:
    """Raise OutputError if a checkpoint cannot be written to `path`: its name is not a checkpoint's, or it exists."""
    if path.suffix != Path(WEIGHTS_FILE).suffix:
        raise OutputError(f"{path}: give a name that ends in .ckpt, by which the other commands know a checkpoint")
    if path.exists():
        raise OutputError(f"{path}: already exists, and a training run may need it; choose another name, or remove it")


def require_same_arrays(
    loaded: Mapping[str, Tensor], expected: Mapping[str, Tensor], path: str | Path, expected_in: str, remedy: str
) -> None:
    """Compare names and shapes of the arrays of two networks.

    Args:
        loaded: of the checkpoint at `path`.
        expected: of the other network.
        path: for the error's text.
        expected_in: where the other network stands, such as "this configuration".
        remedy: end of the error's text.

    Raises:
        TrainingError: they differ; names the first array that does.
    """
    for name in {**expected, **loaded}:
        has, needs = (tuple(arrays[name].shape) if name in arrays else "missing" for arrays in (loaded, expected))
        if has != needs:
            raise TrainingError(
                f"{path}: weights of another network: {name} is {has} there and {needs} in {expected_in}; {remedy}"
            )


def weights_sha256(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of a network's trained arrays (`state_dict`): names, shapes, values, sorted by name.

    It is that of the weights as they are computed with: last.ckpt and weights.ckpt of one run may differ, because the
    latter's were rounded to 16 bits.
    """
    digest = hashlib.sha256()
    for name, array in sorted(weights.items()):
        digest.update(f"{name} {tuple(array.shape)}\n".encode())
        digest.update(array.numpy().tobytes())
    return digest.hexdigest()
