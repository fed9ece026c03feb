"""A model that is to be run over a split: a bundle in ONNX Runtime, or a checkpoint in PyTorch."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from asca_deploy import Detections, Detector
from asca_deploy.providers import Precision, Provider, arithmetic
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.system import check_threads
from asca_pillars.cli.extras import require
from asca_pillars.cli.options import RuntimeOptions, Scores
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.scans.mounting import Mounting


@dataclass(frozen=True)
class Model:
    """A detector and what is to be known about it.

    Attributes:
        name: of the model.
        detect: (N, 4) points -> detections, from `min_score` on.
        spec: as the model was made, with its own thresholds.
        camera_view: whether it expects only the points in the image.
        about: where it comes from and where it runs, for the report.
        unlike: for each scan that does not look like those of the training, the first reason.
    """

    name: str
    detect: Callable[[NDArray[np.float32]], Detections]
    spec: DetectorSpec
    camera_view: bool
    about: dict[str, Any]
    unlike: list[str] = field(default_factory=list)


def open_detector(
    options: RuntimeOptions, score: Scores | None = None, mounting: Mounting | None = None, *, around: bool = False
) -> Detector:
    """The detector of a bundle that is run as `options` say, from `score` on; None for the bundle's own thresholds.

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


def open_model(
    options: RuntimeOptions, min_score: float, *, sensor_height_m: float | None = None, around: bool = False
) -> Model:
    """Open a bundle's folder or a checkpoint file; None for the bundle that ships.

    Args:
        options: which one, and how it runs.
        min_score: lowest score of what it reports.
        sensor_height_m: of the scans; None: as high as in the training.
        around: look in every direction, by turned passes.

    Raises:
        AscaError: missing, damaged, or not to be run as asked; one line.
    """
    if options.bundle is not None and (options.bundle.is_file() or options.bundle.suffix == ".ckpt"):
        if around:
            raise ConfigError("--around runs bundles: export the checkpoint first (asca export)")
        return _open_checkpoint(options.bundle, options, min_score, Mounting(sensor_height_m))
    return _open_bundle(options, min_score, Mounting(sensor_height_m), around=around)


def _open_bundle(options: RuntimeOptions, min_score: float, mounting: Mounting, *, around: bool) -> Model:
    logging.getLogger("asca_deploy").setLevel(logging.ERROR)  # its warnings are collected below
    detector = open_detector(options, min_score, mounting, around=around)
    bundle = detector.bundle
    unlike: list[str] = []

    def detect(points: NDArray[np.float32]) -> Detections:
        detections = detector(points)
        unlike.extend(detections.report.warnings[:1])
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
    return Model(bundle.name, detect, bundle.spec, camera_view, about, unlike)


def _open_checkpoint(path: Path, options: RuntimeOptions, min_score: float, mounting: Mounting) -> Model:
    provider, precision, threads = options.provider, options.precision, options.threads
    require("train")
    import torch

    from asca_pillars.models.checkpoint import load_checkpoint
    from asca_pillars.models.trainable import ScanDetector

    if threads is not None:
        check_threads(threads)
    if provider not in ("cpu", "cuda", "auto"):
        raise ConfigError(f"provider {provider} does not run checkpoints: choose cpu, cuda or auto, or give a bundle")
    if precision not in (None, "float32"):
        raise ConfigError(f"precision {precision} does not go with checkpoints: they run in float32; give a bundle")
    if provider == "cuda" and not torch.cuda.is_available():
        raise ConfigError("provider cuda: PyTorch finds no CUDA device here; choose cpu")
    device = "cpu" if provider == "cpu" or not torch.cuda.is_available() else "cuda"
    if threads is not None:
        torch.set_num_threads(threads)
    loaded = load_checkpoint(path)
    config, network = loaded.config, loaded.detector
    about = {
        "name": config.name,
        "checkpoint": str(path),
        "steps": loaded.steps,
        "provider": f"torch {device}",
        "threads": torch.get_num_threads(),
        "min_score": min_score,
    }
    expected = loaded.expected_input
    to_model = mounting.to_model(None if expected is None else expected.sensor_height_m)
    detect = ScanDetector(network.to(device), config.model.spec.with_score_threshold(min_score), to_model)
    return Model(config.name, detect, config.model.spec, config.data.camera_view, about)
