"""Identity of the run in a folder, so that only the same run resumes there."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.base.files import write_json, write_text
from asca_pillars.base.own_files import require_own_file
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.base.settings import read_settings
from asca_pillars.base.system import describe_environment
from asca_pillars.config.tree import Config, Precision, load_config
from asca_pillars.data.augment import TrainingFrames
from asca_pillars.data.frames import LabeledSplit, read_frame
from asca_pillars.models.checkpoint_file import weights_sha256
from asca_pillars.scans.find_scans import evenly_spaced
from asca_pillars.scans.input_check import ExpectedInput, measure_expected_input
from asca_pillars.training.module import cooldown_start, steps_per_epoch
from asca_pillars.training.run_files import (
    COMMAND,
    CONFIG_FILE,
    ENVIRONMENT_FILE,
    EXPECTED_INPUT_FILE,
    FRAMES_FILE,
    YAML_HEAD,
    is_own_config,
    is_own_expected_input,
)

EXPECTED_INPUT_FRAMES = 200
# Settings that change where and how fast samples are made, not what is in them, and how often a run is saved.
NOT_OF_THE_RUN = ("data.workers", "data.prepared", "train.checkpoint_steps")


class TrainingInputs(NamedTuple):
    """Inputs of a run besides configuration and seed: frames, processes and initial weights."""

    frames: int
    frames_sha256: str
    """SHA-256 of the frames' ids and of the sizes of their scans, as two datasets may number frames alike."""
    processes: int
    initial_sha256: str | None = None
    """SHA-256 of the initial weights; empty for random ones, None where it is not known."""

    @classmethod
    def of(cls, split: LabeledSplit, processes: int, initial: Mapping[str, Tensor] | None = None) -> "TrainingInputs":
        """Return the inputs of a run on these frames.

        Args:
            split: the frames.
            processes: how many.
            initial: weights, empty where all are random; None where a resumed run's start is not given again.

        Raises:
            OSError: a scan is not there.
        """
        sizes = [f"{frame_id} {split.scan_path(frame_id).stat().st_size}" for frame_id in split.frame_ids]
        start = None if initial is None else weights_sha256(initial) if initial else ""
        return cls(len(sizes), hashlib.sha256("\n".join(sizes).encode()).hexdigest(), processes, start)


def prepare_run_folder(out: Path, config: Config, inputs: TrainingInputs, steps: int = 0) -> None:
    """Write what this run is into `out`, or make sure that the run found there is the same one.

    A run may be made longer where its steps so far are those of the longer run: always with the `step` schedule, and
    with `warmup_stable_decay` until its rate falls. A run without any checkpoint may be replaced.

    Args:
        out: folder of the run.
        config: of the run.
        inputs: its frames, processes and first weights.
        steps: optimizer steps of the run that is there.

    Raises:
        TrainingError: the run there is another one, or drew from other frames, or in more or fewer processes, or
            started from other weights.
        OutputError: a configuration there is not that of a run.
    """
    path, frames_path = out / CONFIG_FILE, out / FRAMES_FILE
    require_own_file(path, COMMAND, is_own_config)
    earlier = read_settings(TrainingInputs, frames_path, (), {}) if frames_path.exists() else None
    refusal = _other_run_reason(path, config, inputs, steps) if path.exists() else None
    refusal = refusal or (earlier and _other_inputs_reason(frames_path, earlier, inputs))
    if refusal and any((out / "checkpoints").glob("*.ckpt")):
        raise TrainingError(refusal)
    if inputs.initial_sha256 is None and earlier is not None:
        inputs = inputs._replace(initial_sha256=earlier.initial_sha256)
    if refusal or not path.exists():
        write_json(out / ENVIRONMENT_FILE, describe_environment())
    write_text(path, YAML_HEAD + yaml.safe_dump(to_dict(config), sort_keys=False))
    write_json(frames_path, inputs._asdict())


def recorded_precision(out: Path) -> Precision:
    """Return the `train.precision` that the run in `out` was started with; `auto` where it is not recorded."""
    path = out / CONFIG_FILE
    return load_config(path).train.precision if path.exists() else "auto"


def measure_input(out: Path, frames: TrainingFrames, *, keep: bool, reporter: Reporter = SILENT) -> ExpectedInput:
    """Measure up to EXPECTED_INPUT_FRAMES evenly spaced training scans; with `keep`, a measurement in `out` is read.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
        TrainingError: no frame has a point.
        ConfigError: what was kept is damaged.
    """
    path = out / EXPECTED_INPUT_FILE
    if keep and path.exists():
        return read_settings(ExpectedInput, path, (), {})
    chosen = reporter.track(evenly_spaced(frames.frame_ids, EXPECTED_INPUT_FRAMES), "Measuring training scans")
    scans = (read_frame(frames.split, frame_id, (), camera_view=frames.camera_view).points for frame_id in chosen)
    try:
        measured = measure_expected_input(scans, frames.camera_view)
    except ValueError:
        raise TrainingError(f"{frames.split.root}: no scan of list `{frames.split.name}` has a point to see") from None
    require_own_file(path, COMMAND, is_own_expected_input)
    write_text(path, YAML_HEAD + yaml.safe_dump(to_dict(measured)))
    return measured


def _other_run_reason(path: Path, config: Config, inputs: TrainingInputs, steps: int) -> str | None:
    """Return in words how `config` differs from the run that `path` is of; None if it is the same run, or longer."""
    found_config = load_config(path)  # a run of an older version lacks keys that are younger, not their values
    earlier = to_dict(found_config)
    if found_config.train.precision == "auto":  # an older version, which did not record the resolved value
        earlier["train"]["precision"] = config.train.precision
    longer = config.train.epochs > found_config.train.epochs
    recipe = found_config.train
    planned = recipe.epochs * steps_per_epoch(recipe, inputs.frames, inputs.processes)
    extendable = recipe.schedule == "step" or (
        recipe.schedule == "warmup_stable_decay" and steps <= cooldown_start(recipe, planned)
    )
    if longer and extendable:
        earlier["train"]["epochs"] = config.train.epochs
    difference = _first_difference(earlier, to_dict(config))
    if difference is None:
        return None
    if longer and difference.startswith("train.epochs"):
        return (
            f"{path}: the run there was started with {difference}; "
            + (
                f"the learning rate has fallen since step {cooldown_start(recipe, planned)} of {planned}"
                if recipe.schedule == "warmup_stable_decay"
                else "a one_cycle schedule is planned for its whole length"
            )
            + f": start a new run in another --out with --init {path.parent / 'checkpoints' / 'last.ckpt'}"
        )
    return f"{path}: the run there was started with {difference}; choose another --out, or delete it"


def _other_inputs_reason(path: Path, earlier: TrainingInputs, inputs: TrainingInputs) -> str | None:
    """Return in words how `inputs` differs from that of the run in `path`; None if it does not."""
    if earlier.processes != inputs.processes:
        return (
            f"{path}: the run there was started with {earlier.processes} process(es), now {inputs.processes}: its "
            "steps would be others; give as many --devices, or start a new run in another --out with --init"
        )
    if earlier[:2] != inputs[:2]:
        return (
            f"{path}: the run there was started on {earlier.frames} frames, now there are {inputs.frames}, or others; "
            "give it the same --data and data.train_set, or start a new run in another --out with --init"
        )
    if None not in (earlier.initial_sha256, inputs.initial_sha256) and earlier.initial_sha256 != inputs.initial_sha256:
        return (
            f"{path}: the run there was started from {'other' if earlier.initial_sha256 else 'random'} weights; leave "
            "--init out to resume it, or start a new run in another --out"
        )
    return None


def _first_difference(earlier: Any, expected: Any, key: str = "") -> str | None:
    if key in NOT_OF_THE_RUN:
        return None
    if isinstance(earlier, dict) and isinstance(expected, dict):
        for name in expected | earlier:
            if difference := _first_difference(earlier.get(name), expected.get(name), f"{key}.{name}".lstrip(".")):
                return difference
        return None
    return None if earlier == expected else f"{key} = {earlier}, now {key} = {expected}"
