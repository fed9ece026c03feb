"""What `asca export` reads beside the checkpoint, and how it reports 8 bits."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy.bundle import MANIFEST, Quantization
from asca_deploy.manifest import load_bundle
from asca_deploy.shipped import find_checkpoint
from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.extras import require
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan

PARITY_SCANS, PARITY_SEED = 8, 2**31  # seeds far from those that people train with
CALIBRATION_SCANS, CALIBRATION_SEED = 96, 2**31 + 1

View = Literal["camera", "full"]


class Source(NamedTuple):
    """What is exported, and what it says of itself."""

    path: Path
    """Of the checkpoint."""
    checkpoint: Checkpoint
    score_thresholds: dict[str, float]
    """Of the bundle that holds the checkpoint, class by class; empty of others: those of its config are meant."""
    trained_on: str
    command: str
    """That trained it."""


def open_source(source: Path) -> Source:
    """A checkpoint, or a bundle (folder, or name of one that ships) that holds its own.

    Raises:
        AscaError: it is missing, damaged or a bundle without weights.
    """
    path = find_checkpoint(source)
    checkpoint = load_checkpoint(path)
    if not (path.parent / MANIFEST).exists():  # the folder of a run's checkpoints holds weights, too
        source = path
    if path == source:
        command = run_environment(source).get("command", "not recorded")
        return Source(path, checkpoint, {}, "not stated", command)
    bundle = load_bundle(path.parent)
    scores = {each.name: each.score_threshold for each in bundle.spec.classes}
    return Source(path, checkpoint, scores, bundle.provenance.trained_on, bundle.provenance.command)


def print_quantization(report: Quantization, console: Console) -> None:
    """A line per layer, and what the boxes say."""
    table = Table(title=f"In 8 bits, calibrated on {report.calibration_scans} scans")
    if report.dropped_scans:
        console.print(f"{report.dropped_scans} calibration scans left out: parity is proven on the same ones")
    table.add_column("layer")
    table.add_column("logit error if it alone stays float", justify="right")
    table.add_column("kept float")
    for layer in report.layers:
        table.add_row(layer.layer, f"{layer.logit_rms_error:.4f}", "yes" if layer.kept_float else "")
    console.print(table)
    console.print(
        f"Logit error {report.logit_rms_error:.4f}; of {report.boxes} boxes on {report.compared_scans} scans "
        f"{report.boxes_matched} are there again, {report.boxes_added} are new. "
        "What that costs in AP says `asca eval` on both bundles"
    )


def with_ranges(spec: DetectorSpec, range_m: tuple[float, float, float, float]) -> PillarSpec:
    """The same detector that looks for objects elsewhere: from x0 to x1 and from y0 to y1, metres, LiDAR frame.

    Raises:
        ConfigError: it is no detector on pillars, or pillars do not fill these ranges; the nearest that fit are named.
    """
    if not isinstance(spec, PillarSpec):
        raise ConfigError("--range: only detectors on pillars look elsewhere with the same weights; leave it out")
    x0, x1, y0, y1 = range_m
    return replace(spec, grid=replace(spec.grid, x_range_m=(x0, x1), y_range_m=(y0, y1)))


def read_or_simulate(
    folder: Path | None, console: Console, most: int, seed: int, view: View = "full"
) -> list[NDArray[np.float32]]:
    """Scans of a folder, evenly spaced if there are more than `most`; without a folder simulated ones.

    Each is (N, 4): x, y, z in metres, LiDAR frame, and reflectance.
    """
    if folder is not None:
        paths = find_scans(folder)
        chosen = paths if len(paths) <= most else [paths[i * len(paths) // most] for i in range(most)]
        return [read_scan(path).points for path in chosen]
    require("sim")
    from asca_pillars.sim.simulation import SimulationConfig, simulate_frame

    config = SimulationConfig(field_of_view=view)
    frames = track(range(most), f"Simulating {most} scans", console=console, transient=True)
    return [simulate_frame(seed, index, config).points for index in frames]


def run_environment(checkpoint: Path) -> dict[str, Any]:
    """What the run wrote of itself, if the checkpoint still lies in its run's folder.

    Raises:
        TrainingError: the file there is damaged.
    """
    path = checkpoint.parent.parent / "environment.json"
    if not path.exists():
        return {}
    try:
        environment = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # not JSON, or not UTF-8
        reason = " ".join(str(error).split())
    else:
        if isinstance(environment, dict) and isinstance(environment.get("command", ""), str):
            return environment
        reason = "no object with the text `command`"
    raise TrainingError(
        f"{path}: not what `asca train` wrote, or damaged ({reason}); delete it, and the bundle will not say which "
        "command trained it"
    )
