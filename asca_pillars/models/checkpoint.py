"""Trained weights together with the configuration that they belong to."""

import hashlib
import pickle
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.files import atomic_path
from asca_pillars.base.input_files import require_content
from asca_pillars.base.schema import parse
from asca_pillars.config.tree import Config, ModelConfig
from asca_pillars.models.build import build_model
from asca_pillars.models.trainable import Trainable
from asca_pillars.scans.expected_input import ExpectedInput


class Checkpoint(NamedTuple):
    """A trained detector in evaluation mode and where it comes from.

    Attributes:
        config: of its training run.
        detector: its network.
        steps: optimizer steps behind it.
        expected_input: of the scans that it was trained on; None in checkpoints made before this was measured.
    """

    config: Config
    detector: Trainable
    steps: int
    expected_input: ExpectedInput | None = None

    def with_model(self, model: ModelConfig) -> "Checkpoint":
        """The same weights in a network of another `spec`: other ranges, thresholds or post-processing."""
        detector = build_model(model)
        detector.load_state_dict(self.detector.state_dict())
        return self._replace(config=replace(self.config, model=model), detector=detector.eval())


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint of `asca train`, weights only: nothing in the file is executed.

    last.ckpt, best.ckpt and weights.ckpt are read alike; with `train.ema` the weights are the averaged ones.

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
            raise TrainingError(f"{path}: a checkpoint of {library}; `asca import-weights` makes one of ours of it")
        config = parse(Config, content["hyper_parameters"]["config"], str(path))
        detector = build_model(config.model)
        weights = {
            name.removeprefix("detector."): value
            for name, value in content["state_dict"].items()
            if name.startswith("detector.")
        }
        detector.load_state_dict(weights)
        measured = content["hyper_parameters"].get("expected_input")
        expected = None if measured is None else parse(ExpectedInput, measured, str(path))
        steps = int(content["global_step"])
    except TrainingError:
        raise
    except ConfigError as error:
        raise TrainingError(f"{error}; the checkpoint was made by another version of asca-pillars") from None
    except Exception as error:  # torch.load raises whatever the damaged bytes happen to trigger
        raise TrainingError(f"{path}: not a checkpoint of `asca train`, or damaged ({unread(error)})") from error
    return Checkpoint(config, detector.eval(), steps, expected)


def read_plain(path: Path) -> dict[str, Any]:
    """The dictionary that a file of `torch.save` holds, weights only: nothing in the file is executed.

    Raises:
        ValueError: it holds something else than a dictionary.
        Exception: whatever the damaged bytes happen to trigger in `torch.load`.
    """
    with warnings.catch_warnings(action="ignore"):  # of pickles that are no checkpoints; the error says so
        content = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(content, dict):
        raise ValueError(f"it holds a {type(content).__name__}, where a checkpoint holds a dictionary")
    return content


def _library_of(content: Mapping[str, Any]) -> str | None:
    """Whose training wrote a checkpoint that is not ours, where `asca import-weights` may know it."""
    if "model_state" in content:
        return "OpenPCDet"
    return "mmdetection3d" if "meta" in content and "state_dict" in content else None


def unread(error: Exception) -> str:
    """Why a file of weights was not read, in one line.

    The words of torch.load for a pickle that it does not take are left out: they advise to execute what is in it.
    """
    if isinstance(error, pickle.UnpicklingError):
        return "it is not plain arrays and settings; nothing in it was executed"
    if isinstance(error, KeyError):
        return f"no {error}" if isinstance(error.args[0], str) else "it is no file of torch.save"
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
    # Opened here: torch writes the name of a file that it opens into it, and these are temporary.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def weights_sha256(weights: Mapping[str, Tensor]) -> str:
    """SHA-256 of a network's trained arrays (its `state_dict`, on the CPU): names, shapes, values, sorted by name.

    It is that of the weights as they are computed with: last.ckpt and weights.ckpt of one run may differ, because the
    latter's were rounded to 16 bits.
    """
    digest = hashlib.sha256()
    for name, array in sorted(weights.items()):
        digest.update(f"{name} {tuple(array.shape)}\n".encode())
        digest.update(array.numpy().tobytes())
    return digest.hexdigest()
