"""Models to run over a split: a bundle in ONNX Runtime, or a checkpoint in PyTorch."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from asca_deploy.around import turns_around, widen_ranges
from asca_deploy.detector import Detector
from asca_deploy.manifest import load_bundle
from asca_deploy.providers import Precision, Provider, arithmetic
from asca_deploy.shipped import find_bundle, sample_scan_path
from asca_deploy.tracker import WEAK_SHARE
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.installation import require
from asca_pillars.base.system import check_threads
from asca_pillars.data.kitti import calibration_of_scan
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.evaluation.arguments import Model
from asca_pillars.scans.ground_height import NamedPoints
from asca_pillars.scans.input_check import share_behind
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_settings import ScanInput


@dataclass(frozen=True, kw_only=True)
class RuntimeOptions:
    """The model to run, and how. The arguments of `Detector` by the same names."""

    bundle: str | Path | None = None
    provider: str = "cpu"
    precision: str | None = None
    threads: int | None = None


def open_detector(
    options: RuntimeOptions,
    score: ScoreThresholds | None = None,
    mounting: Mounting | None = None,
    *,
    around: bool = False,
) -> Detector:
    """Open the detector of a bundle as `options` say, from `score` on; None for the bundle's own thresholds.

    Raises:
        AscaError: as `asca_deploy.Detector`.
    """
    return Detector(
        options.bundle,
        provider=cast("Provider", options.provider),  # checked by Detector, as the precision is
        precision=cast("Precision | None", options.precision),
        threads=options.threads,
        score_threshold=score,
        mounting=mounting,
        view="around" if around else "ahead",
    )


def scans_need_around(
    options: RuntimeOptions, mounting: Mounting, samples: Iterable[NamedPoints], notes: list[str]
) -> bool:
    """Return whether scans lie all around a model that looks ahead; if so, append a sentence for the user to `notes`.

    Args:
        options: which model.
        mounting: mounting of the sensor.
        samples: scans, of which the first decides.
        notes: sentences about what was decided for the scans.

    Raises:
        AscaError: the bundle cannot be read.
    """
    first = next(iter(samples), None)
    if first is None:
        return False
    bundle = load_bundle(find_bundle(options.bundle))
    share = share_behind(mounting.level.points(first.points[:, :3]), bundle.spec.ranges)
    if not share:
        return False
    passes = len(turns_around(widen_ranges(bundle).spec.ranges, camera_view=bundle.expected_input.camera_view))
    cost = "in one pass" if passes == 1 else f"in {passes} passes"
    notes.append(f"{share:.0%} of the points lie behind the sensor: looking all around, {cost} (--ahead: only ahead)")
    return True


def files_need_around(options: RuntimeOptions, scan_input: ScanInput) -> bool:
    """Return `scans_need_around` of scan files, with its note.

    False for KITTI's frames and for the sample: they are labelled ahead alone.

    Raises:
        AscaError: the bundle cannot be read.
    """
    first = scan_input.paths[0]
    if first == sample_scan_path() or calibration_of_scan(first) is not None:
        return False
    return scans_need_around(options, scan_input.mounting, scan_input.samples(), scan_input.notes)


def track_thresholds(bundle: str | Path | None, score: ScoreThresholds | None = None) -> tuple[dict[str, float], float]:
    """Return the scores from which on detections of each class begin tracks, and are reported by the detector.

    Args:
        bundle: of the detector; None: the one that ships.
        score: lowest score of boxes, or by class; None: the thresholds of the model.

    Returns:
        `Tracker`'s birth_score, and the detector's score threshold: WEAK_SHARE of the lowest of these.

    Raises:
        AscaError: the bundle cannot be read, or it is no such score.
    """
    spec = load_bundle(find_bundle(bundle)).spec
    spec = spec if score is None else spec.with_score_threshold(score)
    births = {class_spec.name: class_spec.score_threshold for class_spec in spec.classes}
    return births, WEAK_SHARE * min(births.values())


def open_model(
    options: RuntimeOptions, min_score: float, *, sensor_height_m: float | None = None, around: bool = False
) -> Model:
    """Open a bundle's folder or a checkpoint file; None for the bundle that ships.

    Args:
        options: which one, and how it runs.
        min_score: lowest score of what it reports.
        sensor_height_m: of the scans; None: as high as in the training.
        around: detect in every direction, see `asca_deploy.around`.

    Raises:
        AscaError: missing, damaged, or not runnable with these options; one line.
    """
    path = None if options.bundle is None else Path(options.bundle)
    if path is not None and (path.is_file() or path.suffix == ".ckpt"):
        if around:
            raise ConfigError("--around runs bundles: export the checkpoint first (asca export)")
        return _open_checkpoint(path, options, min_score, Mounting(sensor_height_m))
    return _open_bundle(options, min_score, Mounting(sensor_height_m), around=around)


def _open_bundle(options: RuntimeOptions, min_score: float, mounting: Mounting, *, around: bool) -> Model:
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # its warnings are collected below
    detector = open_detector(options, min_score, mounting, around=around)
    bundle = detector.bundle
    input_warnings: list[str] = []

    def detect(points: NDArray[np.float32]) -> Detections:
        detections = detector(points)
        input_warnings.extend(detections.report.warnings[:1])
        return detections

    about = {
        "name": bundle.name,
        "bundle": str(detector.folder),
        "sha256": {name: graph.sha256 for name, graph in bundle.graphs.items()},
        "trained_on": bundle.provenance.trained_on,
        "passes": detector.passes,
        "provider": detector.provider,
        "precision": arithmetic(bundle.precision, detector.precision),
        "threads": detector.threads,
        "min_score": min_score,
    }
    camera_view = bundle.expected_input.camera_view and not around
    return Model(bundle.name, detect, bundle.spec, camera_view, about, input_warnings)


def _open_checkpoint(path: Path, options: RuntimeOptions, min_score: float, mounting: Mounting) -> Model:
    require("train")
    from asca_pillars.models.build import open_checkpoint

    provider, precision, threads = options.provider, options.precision, options.threads
    if threads is not None:
        check_threads(threads)
    if provider not in ("cpu", "cuda", "auto"):
        raise ConfigError(f"provider {provider} does not run checkpoints: choose cpu, cuda or auto, or give a bundle")
    if precision not in (None, "float32"):
        raise ConfigError(f"precision {precision} does not go with checkpoints: they run in float32; give a bundle")
    opened = open_checkpoint(path, min_score, mounting, device=provider, threads=threads)
    config = opened.config
    return Model(config.name, opened.detector, config.model.spec, config.data.camera_view, opened.about)
