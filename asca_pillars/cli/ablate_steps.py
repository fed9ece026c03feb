"""Steps of `asca ablate`: a common base of all runs, the conditions of the numbers, and the timing."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from asca_pillars.ablation.ablation_runs import Run, Speed
from asca_pillars.ablation.variants import PILLARS, TWO_STAGE, Family, Row
from asca_pillars.base.errors import ConfigError, DatasetError, TrainingError
from asca_pillars.base.files import write_json
from asca_pillars.base.locks import recover
from asca_pillars.base.own_files import (
    ending_with,
    json_object,
    page_end,
    require_no_link,
    require_own,
    require_own_file,
    starting_with,
    written_by,
)
from asca_pillars.base.system import command_line, cpu_model, package_versions
from asca_pillars.config.tree import Config, DataConfig, load_config
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.open_split import open_split

COMMAND = "asca ablate"
RESULTS_FILE = "results.md"
TIMED_ROUNDS = 10


def require_same_base(out: Path, base: dict[str, Any]) -> None:
    """Record what all runs in `out` have in common, or refuse to mix them with runs on another base.

    Raises:
        OutputError: `out` holds files of something else.
        TrainingError: the runs there have another base, or the note of it is damaged.
    """
    recover(out)
    is_log = starting_with(written_by(COMMAND))
    if not any(map(is_log, out.glob("*/seed*/train.log"))):  # only these logs are left where a damaged note was deleted
        require_own(out, COMMAND, {"ablation.json": json_object("config", "data")})
    require_own_file(out / RESULTS_FILE, COMMAND, ending_with(page_end(COMMAND)))
    for folder in out.glob("*/seed*"):
        require_no_link(out, folder.relative_to(out))
    path = out / "ablation.json"
    if not path.exists():
        write_json(path, base)
        return
    try:
        noted = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # not JSON, or not UTF-8
        reason = " ".join(str(error).split())
        raise TrainingError(
            f"{path}: not what `asca ablate` wrote, or damaged ({reason}); delete it if the runs there have this base "
            "configuration and data, or choose another --out"
        ) from None
    if noted != base:
        raise TrainingError(
            f"{path}: the runs there have another base configuration or data, or other initial weights; choose another "
            "--out"
        )


def setup(todo: Sequence[Run], config: str, data: Path, lists: DataConfig, jobs: int) -> str:
    """Return the conditions of the numbers: command, data, machine, time, versions."""
    trained = [json.loads(run.trained.read_text(encoding="utf-8")) for run in todo]
    hours = sum(record["seconds"] for record in trained) / 3600
    trained_on, checked_on = (len(KittiSplit(data, name).frame_ids) for name in (lists.train_set, lists.val_set))
    note = data / "simulation.json"
    origin = f"simulated, seed {json.loads(note.read_text(encoding='utf-8'))['seed']}" if note.exists() else str(data)
    versions = package_versions()
    lines = (
        f"Command: `{command_line()}`",
        f"Data: {origin}; {trained_on} frames for training, {checked_on} for validation",
        f"Base: {config}; {len(todo)} runs, {hours:.1f} hours of training in sum, {jobs} at a time, "
        f"{trained[0]['threads']} thread(s) each",
        f"Machine: {cpu_model()}; torch {versions['torch']}, onnxruntime {versions['onnxruntime']}",
    )
    return "".join(f"- {line}\n" for line in lines)


def parse_seeds(text: str) -> list[int]:
    """Parse comma-separated integers.

    Raises:
        ConfigError: the text is something else.
    """
    parts = [part.strip() for part in text.split(",")]
    seeds = [int(part) for part in parts if part.isdecimal()]
    if len(set(seeds)) < len(parts):
        raise ConfigError(f"--seeds {text}: give different whole numbers separated by commas, such as 0,1")
    return seeds


def family_of(config: Config) -> Family:
    """Return the variants of a base.

    Raises:
        ConfigError: there are none for its kind.
    """
    families = {"pillar": PILLARS, "pv_rcnn": TWO_STAGE}
    if config.model.kind not in families:
        raise ConfigError(f"model.kind = {config.model.kind}: no variants; give a base of kind {' or '.join(families)}")
    return families[config.model.kind]


def parse_variants(text: str, family: Family) -> list[Row]:
    """Parse comma-separated names, or `all`.

    Raises:
        ConfigError: there is no such variant, or one is named twice.
    """
    variants = family.variants
    names = list(variants) if text == "all" else text.split(",")
    for name in names:
        if name not in variants:
            raise ConfigError(f"--variants {name}: no such variant; available: {', '.join(variants)}")
        if names.count(name) > 1:
            raise ConfigError(f"--variants {text}: {name} is there twice")
    return [variants[name] for name in names]


def check(variants: Sequence[Row], config: str, overrides: Sequence[str], data: Path, init: Path | None = None) -> None:
    """Check before hours of training for errors that would end them.

    Raises:
        ConfigError: a row does not go with the base.
        TrainingError, BundleError: the weights `init` do not go with a row.
        DatasetError: a list or a file is missing, the data have no camera, or fewer validation frames than parity is
            proven on.
    """
    from asca_deploy.shipped import find_checkpoint
    from asca_export.bundle_writer import MIN_SCANS
    from asca_pillars.training.callbacks import initial_weights

    base = load_config(config, overrides)
    init = None if init is None else find_checkpoint(init)
    for variant in variants:
        if reason := variant.base_mismatch(base.model):
            raise ConfigError(f"--variants {variant.name}: {reason}; leave it out, or give a base that fits")
        try:
            initial_weights(load_config(config, (*overrides, *variant.overrides)), init)
        except TrainingError as error:
            raise TrainingError(f"--variants {variant.name}: {error}") from None
    for name in (base.data.train_set, base.data.val_set):
        split = open_split(data, name)
        if not isinstance(split, KittiSplit):
            raise DatasetError(
                f"{data}: the ablation's table is KITTI's AP, which needs a camera; give data in its layout"
            )
        split.require_files()
    if len(split.frame_ids) < MIN_SCANS:
        raise DatasetError(
            f"{data}: {len(split.frame_ids)} frames in the list `{split.name}`; at least {MIN_SCANS} are needed to "
            "export on"
        )


def time_variants(todo: Sequence[Run], family: Family, split: KittiSplit, console: Console) -> dict[str, Speed]:
    """Export one checkpoint of every variant and time them in alternation on the same scans."""
    from asca_deploy import Detector
    from asca_deploy.benchmark import alternate
    from asca_export.bundle_writer import MIN_SCANS
    from asca_export.export import export_bundle
    from asca_pillars.data.frames import read_frame
    from asca_pillars.models.build import load_checkpoint

    scans = [read_frame(split, frame_id, ()).points for frame_id in split.frame_ids[:MIN_SCANS]]
    first = {run.variant.name: run for run in reversed(todo)}  # with several seeds the first one is timed
    detectors: dict[str, Detector] = {}
    parameters: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, run in track(first.items(), "Exporting", console=console):
            checkpoint = load_checkpoint(run.checkpoint)
            export_bundle(checkpoint, Path(folder) / name, scans)
            detectors[name] = Detector(Path(folder) / name)
            parameters[name] = sum(part.numel() for part in checkpoint.detector.parameters())
        with console.status(f"Timing {len(detectors)} detectors in alternation"):
            frames = alternate(detectors, scans, TIMED_ROUNDS)
    times = {name: np.median(samples, axis=1) for name, samples in frames.items()}
    reference = times[next(name for name in family.variants if name in times)]
    return {
        name: Speed(
            fps=1e3 / float(np.median(samples)),
            ratio=float(np.median(samples / reference)),
            ratio_quartiles=(
                float(np.quantile(samples / reference, 0.25)),
                float(np.quantile(samples / reference, 0.75)),
            ),
            parameters=parameters[name],
        )
        for name, samples in times.items()
    }
