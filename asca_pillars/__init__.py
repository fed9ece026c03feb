"""LiDAR 3D detection with adaptive-scale pillars: ASCA-PointPillars, from the scan to the boxes.

    from asca_pillars import Detector, read_scan

    detections = Detector()(read_scan("scan.bin").points)

The names below are the stable ones (docs/API.md). They are imported when they are first used, so that
`import asca_pillars` costs nothing. PyTorch is imported when `train`, `adapt` or `export` is called, or `evaluate`
with a checkpoint.
"""

import importlib
from typing import TYPE_CHECKING, Any

from asca_pillars.base.telemetry import disable_telemetry

if TYPE_CHECKING:
    from asca_deploy import Bundle, Detector, ScanDetections, ScanQueue, Tracker, Tracks, load_bundle
    from asca_deploy.detect_scans import detect_scans
    from asca_deploy.evaluate import evaluate
    from asca_deploy.open_model import RuntimeOptions
    from asca_deploy.recordings.detect_recording import detect_recording
    from asca_export.adapt import adapt
    from asca_export.export_checkpoint import export
    from asca_pillars.base.errors import AscaError
    from asca_pillars.detection.detections import Detection, Detections, FrameReport
    from asca_pillars.scans.mounting import Mounting
    from asca_pillars.scans.scan_reader import Scan, read_scan
    from asca_pillars.scans.scan_settings import ScanSettings
    from asca_pillars.sim.simulate import simulate
    from asca_pillars.training.train import train

__version__ = "0.1.0"

disable_telemetry()  # before anything imports onnxruntime, which reads the environment then

__all__ = [
    "AscaError",
    "Bundle",
    "Detection",
    "Detections",
    "Detector",
    "FrameReport",
    "Mounting",
    "RuntimeOptions",
    "Scan",
    "ScanDetections",
    "ScanQueue",
    "ScanSettings",
    "Tracker",
    "Tracks",
    "__version__",
    "adapt",
    "detect_recording",
    "detect_scans",
    "evaluate",
    "export",
    "load_bundle",
    "read_scan",
    "simulate",
    "train",
]

_HOMES = {
    "AscaError": "asca_pillars.base.errors",
    "Bundle": "asca_deploy",
    "Detection": "asca_pillars.detection.detections",
    "Detections": "asca_pillars.detection.detections",
    "Detector": "asca_deploy",
    "FrameReport": "asca_pillars.detection.detections",
    "Mounting": "asca_pillars.scans.mounting",
    "RuntimeOptions": "asca_deploy.open_model",
    "Scan": "asca_pillars.scans.scan_reader",
    "ScanDetections": "asca_deploy",
    "ScanQueue": "asca_deploy",
    "ScanSettings": "asca_pillars.scans.scan_settings",
    "Tracker": "asca_deploy",
    "Tracks": "asca_deploy",
    "adapt": "asca_export.adapt",
    "detect_recording": "asca_deploy.recordings.detect_recording",
    "detect_scans": "asca_deploy.detect_scans",
    "evaluate": "asca_deploy.evaluate",
    "export": "asca_export.export_checkpoint",
    "load_bundle": "asca_deploy",
    "read_scan": "asca_pillars.scans.scan_reader",
    "simulate": "asca_pillars.sim.simulate",
    "train": "asca_pillars.training.train",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
