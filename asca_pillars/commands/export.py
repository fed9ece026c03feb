"""`asca export`: a checkpoint in, a proven bundle out."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from asca_pillars.commands.extras import require
from asca_pillars.data.scans import find_scans, read_scan
from asca_pillars.errors import ConfigError

SIMULATED_SCANS = 8
SIMULATED_SEED = 2**31  # far from the seeds that people train with


def run(checkpoint: Path, out: Path, scans: Path | None, trained_on: str, scores: list[str]) -> None:
    """See `asca export --help`."""
    require("train")
    from asca_export.export import export_bundle
    from asca_pillars.models.checkpoint import load_checkpoint

    console = Console(markup=False)
    loaded = load_checkpoint(checkpoint)
    spec = loaded.config.detector.with_score_threshold(dict(_score(text) for text in scores))
    loaded = loaded._replace(config=replace(loaded.config, detector=spec))
    points = _simulated(console) if scans is None else [read_scan(path).points for path in find_scans(scans)]
    environment = _environment(checkpoint)
    with console.status("Exporting and proving parity"):
        bundle = export_bundle(
            loaded, out, points, trained_on=trained_on, command=environment.get("command", "not recorded")
        )
    parity = bundle.parity
    assert parity is not None, "export_bundle proves it"
    console.print(
        f"{out}: parity on {parity.scans} scans: head maps within {parity.head_maps_max_abs_error:.2g}, "
        f"boxes within {parity.box_max_error_m:.2g} m and {np.rad2deg(parity.yaw_max_error_rad):.2g} degrees"
    )


def _score(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise ConfigError(f"--score {text}: write a class and its score, such as Car=0.35") from None


def _simulated(console: Console) -> list[NDArray[np.float32]]:
    require("sim")
    from asca_pillars.sim.simulate import simulate_frame

    with console.status(f"Simulating {SIMULATED_SCANS} scans to prove parity on"):
        return [simulate_frame(SIMULATED_SEED, index).points for index in range(SIMULATED_SCANS)]


def _environment(checkpoint: Path) -> dict[str, Any]:
    """What the run wrote of itself, if the checkpoint still lies in its run's folder."""
    path = checkpoint.parent.parent / "environment.json"
    if not path.exists():
        return {}
    environment: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return environment
