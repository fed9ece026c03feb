"""Export of a checkpoint, or of a bundle that holds its weights: `asca export`."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import BUNDLE_FOLDER, Bundle
from asca_deploy.shipped import bundle_of_checkpoint, find_checkpoint
from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.installation import require
from asca_pillars.base.own_files import require_not_input, require_replaceable
from asca_pillars.base.progress import Progress, Reporter
from asca_pillars.base.settings import with_overrides
from asca_pillars.config.pillar import PillarModel
from asca_pillars.detection.spec import DetectorSpec, ScoreThresholds
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.find_scans import evenly_spaced, find_scans
from asca_pillars.scans.scan_reader import read_scan

if TYPE_CHECKING:
    from asca_pillars.config.tree import ModelConfig
    from asca_pillars.models.build import Checkpoint

PARITY_SCANS, PARITY_SEED = 8, 2**31  # seeds far from those that people train with
CALIBRATION_SCANS, CALIBRATION_SEED = 96, 2**31 + 1

View = Literal["camera", "full"]


class Source(NamedTuple):
    """A checkpoint to export, and its origin."""

    path: Path
    """Path of the checkpoint."""
    checkpoint: "Checkpoint"
    shipped_as: DetectorSpec | None
    """Of the bundle that holds the checkpoint: its thresholds and suppression count. None for other checkpoints."""
    trained_on: str
    command: str
    """The command that trained it."""


def export(
    checkpoint: str | Path,
    out: str | Path,
    *,
    scans: str | Path | None = None,
    trained_on: str | None = None,
    score: ScoreThresholds | None = None,
    post: Sequence[str] = (),
    range_m: tuple[float, float, float, float] | None = None,
    int8: bool = False,
    calibrate: str | Path | None = None,
    dense_neck: bool = False,
    with_weights: bool = False,
    progress: Progress | None = None,
    step: Callable[[str], None] | None = None,
) -> Bundle:
    """Export to ONNX, and compare with PyTorch on scans, head maps and boxes; what `asca export` does.

    Args:
        checkpoint: of a run, or a bundle (folder, or name of one that ships) that holds its weights.
        out: folder of the bundle, which gets its name; an earlier bundle there is replaced.
        scans: like those trained on, to compare on; None: simulated ones.
        trained_on: training data in words, for the manifest; None: from the bundle that holds the weights.
        score: thresholds of the bundle; None: those of the checkpoint.
        post: `key=value` texts of `PostProcess` that differ in the bundle from those of the checkpoint.
        range_m: detection range of the bundle, x0 x1 y0 y1 in metres; None: as trained.
        int8: make the graphs 8-bit ones.
        calibrate: scans to calibrate these with; None: simulated ones.
        dense_neck: write a sparse neck as dense convolutions with masks.
        with_weights: add the weights, in 16 bits.
        progress: called while scans are simulated.
        step: called with a description of each step.

    Returns:
        The manifest; `parity` and `quantization` are the differences from the checkpoint.

    Raises:
        AscaError: an argument cannot be used, `out` holds something else, or the graphs differ from PyTorch.
    """
    require("train")
    from asca_export.bundle_writer import ExportOptions
    from asca_export.export import export_bundle
    from asca_export.pillar.export import require_maskable

    checkpoint, out, reporter = Path(checkpoint), Path(out), Reporter(progress)
    require_replaceable(out, *BUNDLE_FOLDER)  # before minutes of work
    require_not_input(out, (scans, calibrate))
    source = open_source(checkpoint)
    loaded = source.checkpoint
    spec = loaded.config.model.spec
    if source.shipped_as is not None:
        spec = spec.with_post_processing_of(source.shipped_as)
    if score is not None:
        spec = spec.with_score_threshold(score)
    if post:
        spec = replace(spec, post=with_overrides(spec.post, post, f"--post {' --post '.join(post)}"))
    if range_m is not None:
        spec = with_ranges(loaded.config.model, spec, range_m)
    model = replace(loaded.config.model, spec=spec)  # type: ignore[arg-type]  # of the same kind
    loaded = loaded.with_model(model)
    loaded = loaded._replace(config=replace(loaded.config, name=out.resolve().name))
    if calibrate is not None and not int8:
        raise ConfigError(f"--calibrate {calibrate} without --int8: only an 8-bit bundle is calibrated; add --int8")
    require_not_input(out, (getattr(model, "first_stage", None),))
    if dense_neck:
        require_maskable(loaded.config.model, int8=int8)
    if loaded.expected_input is None and scans is None:
        raise ConfigError(
            f"{checkpoint} does not say what its training scans looked like, which the bundle has to know; "
            "give some of them with --scans"
        )
    points = read_or_simulate(scans, reporter, PARITY_SCANS, PARITY_SEED)
    # Ranges are those of what the model was trained on; parity has to hold for whole revolutions too.
    view: View = "camera" if loaded.config.data.camera_view else "full"
    calibration = read_or_simulate(calibrate, reporter, CALIBRATION_SCANS, CALIBRATION_SEED, view) if int8 else None
    # A bundle that is written anew from its own weights keeps them: they may be the only ones.
    keeps = with_weights or source.path.parent.resolve() == out.resolve()
    options = ExportOptions(
        trained_on=trained_on or source.trained_on,
        command=source.command,
        calibration=calibration,
        dense_neck=dense_neck,
        weights=source.path if keeps else None,
    )
    return export_bundle(loaded, out, points, options if step is None else replace(options, progress=step))


def open_source(source: Path) -> Source:
    """Open a checkpoint, or a bundle (folder, or name of one that ships) that holds its own.

    Raises:
        AscaError: it is missing, damaged or a bundle without weights.
    """
    from asca_pillars.models.build import load_checkpoint

    path = find_checkpoint(source)
    checkpoint = load_checkpoint(path)
    bundle = bundle_of_checkpoint(source)
    if bundle is None:
        return Source(path, checkpoint, None, "not stated", run_environment(path).get("command", "not recorded"))
    return Source(path, checkpoint, bundle.spec, bundle.provenance.trained_on, bundle.provenance.command)


def with_ranges(model: "ModelConfig", spec: DetectorSpec, range_m: tuple[float, float, float, float]) -> PillarSpec:
    """Return the spec of the same detector with other ranges: from x0 to x1 and from y0 to y1, metres, LiDAR frame.

    Raises:
        ConfigError: it is not a pillar detector, or pillars do not fill these ranges; the nearest that fit are named.
    """
    if not isinstance(spec, PillarSpec):
        raise ConfigError("--range: only detectors on pillars look elsewhere with the same weights; leave it out")
    x0, x1, y0, y1 = range_m
    widened = spec.with_ranges((x0, x1), (y0, y1))
    if isinstance(model, PillarModel) and model.network.cpa == "paper":  # its weights are laid out for so many pillars
        return replace(widened, limits=spec.limits)
    return widened


def read_or_simulate(
    folder: str | Path | None, reporter: Reporter, most: int, seed: int, view: View = "full"
) -> list[NDArray[np.float32]]:
    """Return scans of a folder, evenly spaced if there are more than `most`; without a folder, simulated ones.

    Each is (N, 4): x, y, z in metres, LiDAR frame, and reflectance.
    """
    if folder is not None:
        return [read_scan(path).points for path in evenly_spaced(find_scans(folder), most)]
    from asca_pillars.sim.simulation import SimulationConfig, simulate_frame

    config = SimulationConfig(field_of_view=view)
    frames = reporter.track(range(most), f"Simulating {most} scans")
    return [simulate_frame(seed, index, config).points for index in frames]


def run_environment(checkpoint: Path) -> dict[str, Any]:
    """Return the environment that the run recorded, if the checkpoint is still in its run's folder; otherwise {}.

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
