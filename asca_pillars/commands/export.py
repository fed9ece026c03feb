"""`asca export`: a checkpoint in, a proven bundle out."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy.bundle import MANIFEST, Quantization
from asca_pillars.commands.extras import require
from asca_pillars.data.scans.find_scans import find_scans
from asca_pillars.data.scans.scan_reader import read_scan
from asca_pillars.errors import ConfigError
from asca_pillars.files import require_replaceable

PARITY_SCANS, PARITY_SEED = 8, 2**31  # seeds far from those that people train with
CALIBRATION_SCANS, CALIBRATION_SEED = 96, 2**31 + 1

View = Literal["camera", "full"]


def run(
    checkpoint: Path,
    out: Path,
    scans: Path | None,
    trained_on: str,
    scores: list[str],
    int8: bool,
    calibrate: Path | None,
) -> None:
    """See `asca export --help`."""
    require("train")
    from asca_export.exporter import export_bundle
    from asca_pillars.models.checkpoint import load_checkpoint

    console = Console(markup=False)
    require_replaceable(out, "asca export", MANIFEST)  # before minutes of work
    loaded = load_checkpoint(checkpoint)
    spec = loaded.config.model.spec.with_score_threshold(dict(_score(text) for text in scores))
    loaded = loaded._replace(config=replace(loaded.config, model=replace(loaded.config.model, spec=spec)))
    if calibrate is not None and not int8:
        raise ConfigError(f"--calibrate {calibrate} without --int8: only an 8-bit bundle is calibrated; add --int8")
    if loaded.expected_input is None and scans is None:
        raise ConfigError(
            f"{checkpoint} does not say what its training scans looked like, which the bundle has to know; "
            "give some of them with --scans"
        )
    points = _scans(scans, console, PARITY_SCANS, PARITY_SEED)
    # Ranges are those of what the model was trained on; parity has to hold for whole revolutions too.
    view: View = "camera" if loaded.config.data.camera_view else "full"
    calibration = _scans(calibrate, console, CALIBRATION_SCANS, CALIBRATION_SEED, view) if int8 else None
    environment = _environment(checkpoint)
    with console.status("Exporting") as status:
        bundle = export_bundle(
            loaded,
            out,
            points,
            trained_on=trained_on,
            command=environment.get("command", "not recorded"),
            calibration=calibration,
            say=status.update,
        )
    parity = bundle.parity
    assert parity is not None, "export_bundle proves it"
    console.print(
        f"{out}: parity on {parity.scans} scans: head maps within {parity.head_maps_max_abs_error:.2g}, "
        f"boxes within {parity.box_max_error_m:.2g} m and {np.rad2deg(parity.yaw_max_error_rad):.2g} degrees"
    )
    if bundle.expected_input_from == "export":
        console.print("The checkpoint does not describe its training scans: expected_input is measured on --scans")
    if bundle.quantization is not None:
        _show(bundle.quantization, console)


def _show(report: Quantization, console: Console) -> None:
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


def _score(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise ConfigError(f"--score {text}: write a class and its score, such as Car=0.35") from None


def _scans(
    folder: Path | None, console: Console, most: int, seed: int, view: View = "full"
) -> list[NDArray[np.float32]]:
    """Scans of a folder, evenly spaced if there are more than `most`; without a folder simulated ones."""
    if folder is not None:
        paths = find_scans(folder)
        chosen = paths if len(paths) <= most else [paths[i * len(paths) // most] for i in range(most)]
        return [read_scan(path).points for path in chosen]
    require("sim")
    from asca_pillars.sim.simulation import SimulationConfig, simulate_frame

    config = SimulationConfig(field_of_view=view)
    frames = track(range(most), f"Simulating {most} scans", console=console, transient=True)
    return [simulate_frame(seed, index, config).points for index in frames]


def _environment(checkpoint: Path) -> dict[str, Any]:
    """What the run wrote of itself, if the checkpoint still lies in its run's folder."""
    path = checkpoint.parent.parent / "environment.json"
    if not path.exists():
        return {}
    environment: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return environment
