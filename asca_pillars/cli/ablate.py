"""`asca ablate`: the paper's Table 5 on any KITTI-layout data: training, evaluation, timing and report.

Steps of `asca ablate`: a common base of all runs, the conditions of the numbers, and the timing.
"""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from asca_pillars.ablation.ablation_runs import Run
from asca_pillars.ablation.ablation_table import Speed
from asca_pillars.ablation.variants import PILLARS, TWO_STAGE, Family, Row
from asca_pillars.base.errors import ConfigError, DatasetError, TrainingError
from asca_pillars.base.files import write_json
from asca_pillars.base.installation import require
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
from asca_pillars.cli.options import InitOption, OverridesOption
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
    trained = [json.loads(one.trained.read_text(encoding="utf-8")) for one in todo]
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
        raise ConfigError(f"--seeds {text}: different whole numbers with commas between them, such as 0,1")
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
            raise ConfigError(f"--variants {name}: no such variant; there are {', '.join(variants)}")
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
    from asca_pillars.training.checkpoints import initial_weights

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
    from asca_export.export_checkpoint import export_bundle
    from asca_pillars.data.frames import read_frame
    from asca_pillars.models.build import load_checkpoint

    scans = [read_frame(split, frame_id, ()).points for frame_id in split.frame_ids[:MIN_SCANS]]
    first = {one.variant.name: one for one in reversed(todo)}  # with several seeds the first one is timed
    detectors: dict[str, Detector] = {}
    parameters: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, one in track(first.items(), "Exporting", console=console):
            checkpoint = load_checkpoint(one.checkpoint)
            export_bundle(checkpoint, Path(folder) / name, scans)
            detectors[name] = Detector(Path(folder) / name)
            parameters[name] = sum(part.numel() for part in checkpoint.detector.parameters())
        with console.status(f"Timing {len(detectors)} detectors in alternation"):
            frames = alternate(detectors, scans, TIMED_ROUNDS)
    times = {name: np.median(own, axis=1) for name, own in frames.items()}
    reference = times[next(name for name in family.variants if name in times)]
    return {
        name: Speed(
            fps=1e3 / float(np.median(own)),
            ratio=float(np.median(own / reference)),
            ratio_quartiles=(float(np.quantile(own / reference, 0.25)), float(np.quantile(own / reference, 0.75))),
            parameters=parameters[name],
        )
        for name, own in times.items()
    }


def ablate(
    config: Annotated[
        str,
        typer.Argument(
            help="Base: a YAML, or the name of one that ships: ablation_small for the rows of pillar detectors, "
            "ablation_two_stage for those of PV-RCNN."
        ),
    ],
    *,
    data: Annotated[
        Path,
        typer.Option(
            "--data", "-d", help="KITTI-layout folder with ImageSets/{train,val}.txt.", rich_help_panel="Input"
        ),
    ],
    override: OverridesOption = None,
    seeds: Annotated[
        str, typer.Option("--seeds", help="Seeds of every variant, with commas between them.", rich_help_panel="Input")
    ] = "0,1",
    variants: Annotated[
        str, typer.Option("--variants", help="Names with commas between them, or all.", rich_help_panel="Input")
    ] = "all",
    init: InitOption = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder of the runs; finished ones there are kept.", rich_help_panel="Output"),
    ],
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", min=1, help="Trainings at a time; they share the CPU cores.", metavar="N", rich_help_panel="Speed"
        ),
    ] = 1,
) -> None:
    """Train and compare: with and without ASP, CPA, GT-Aug and RS-Aug, other K, the readings of CPA; write one table.

    Table 5 of the paper, on equal terms and with the spread over the seeds, on whatever data you have. On a base of
    kind pv_rcnn the rows are what later papers add to it: deformation, gate, VectorPool, dual attention, MSAA, VA loss,
    and other numbers of keypoints. Goes on where it stopped when the same command is given again.

    Examples:

    asca ablate ablation_small --data data/ablation --out runs/ablation --seeds 0,1,2

    asca ablate ablation_two_stage --data data/ablation --out runs/two_stage --variants pv_rcnn,deform_paper

    asca ablate ablation_two_stage --data data/ablation --out runs/second -s model.train_first_stage=false --init
    pvrcnn_small_sim --variants pv_rcnn,deform_paper
    """
    require("train")
    from rich.console import Console
    from rich.markdown import Markdown

    from asca_pillars.ablation.ablation_runs import finish_runs, runs
    from asca_pillars.ablation.ablation_table import read_results, tables
    from asca_pillars.base.files import write_text
    from asca_pillars.base.own_files import page_end
    from asca_pillars.base.progress import Reporter
    from asca_pillars.base.schema import to_dict
    from asca_pillars.base.system import default_threads
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config
    from asca_pillars.data.kitti import KittiSplit
    from asca_pillars.training.prepare import prepare

    console = Console(markup=False)
    overrides = override or []
    base = load_config(config, overrides)
    family = family_of(base)
    rows = parse_variants(variants, family)
    todo = runs(out, parse_seeds(seeds), rows)
    check(rows, config, overrides, data, init)
    require_same_base(out, {"config": to_dict(base), "data": str(data)} | ({} if init is None else {"init": str(init)}))
    waiting = [load_config(config, [*overrides, *one.variant.overrides]) for one in todo if not one.trained.exists()]
    if any(one.augment.insert.method != "none" for one in waiting):
        # Checked once, not by every run.
        with Bars(console) as bars:
            prepare(base, data, workers=default_threads(), reporter=Reporter(bars))
    with Bars(console) as bars:
        finish_runs(todo, config, data, base.data.val_set, jobs, overrides, init, reporter=Reporter(bars))
    speeds = time_variants(todo, family, KittiSplit(data, base.data.val_set), console)
    text = f"{setup(todo, config, data, base.data, jobs)}\n{tables(family, read_results(todo), speeds)}"
    path = out / RESULTS_FILE
    write_text(path, text + page_end(COMMAND))
    console.print(Markdown(text))
    console.print(f"Written: {path}")
