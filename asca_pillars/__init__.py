"""LiDAR 3D detection with adaptive-scale pillars: ASCA-PointPillars, from the scan to the boxes.

    from asca_pillars import Detector, read_scan

    detections = Detector()(read_scan("scan.bin").points)

The names below are the stable ones (docs/API.md). They are imported when they are first used, so that
`import asca_pillars` costs nothing, and they never import PyTorch.
"""

import importlib
from typing import TYPE_CHECKING, Any

from asca_pillars.base.telemetry import disable_telemetry

if TYPE_CHECKING:
    from asca_deploy import Bundle, Detector, ScanDetections, ScanQueue, Tracker, Tracks, load_bundle
    from asca_pillars.base.errors import AscaError
    from asca_pillars.detection.detections import Detection, Detections, FrameReport
    from asca_pillars.scans.mounting import Mounting
    from asca_pillars.scans.scan_reader import Scan, read_scan

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
    "Scan",
    "ScanDetections",
    "ScanQueue",
    "Tracker",
    "Tracks",
    "__version__",
    "load_bundle",
    "read_scan",
]

_HOMES = {
    "AscaError": "asca_pillars.base.errors",
    "Bundle": "asca_deploy",
    "Detection": "asca_pillars.detection.detections",
    "Detections": "asca_pillars.detection.detections",
    "Detector": "asca_deploy",
    "FrameReport": "asca_pillars.detection.detections",
    "Mounting": "asca_pillars.scans.mounting",
    "Scan": "asca_pillars.scans.scan_reader",
    "ScanDetections": "asca_deploy",
    "ScanQueue": "asca_deploy",
    "Tracker": "asca_deploy",
    "Tracks": "asca_deploy",
    "load_bundle": "asca_deploy",
    "read_scan": "asca_pillars.scans.scan_reader",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
