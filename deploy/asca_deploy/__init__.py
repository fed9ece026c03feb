"""Runtime of the detector: ONNX Runtime and NumPy, without PyTorch."""

from asca_deploy.bundle import Bundle
from asca_deploy.detector import Detector
from asca_deploy.manifest import load_bundle
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.shipped import default_bundle_path, find_bundle, sample_scan_path, shipped_bundles
from asca_deploy.stream import ScanQueue
from asca_deploy.tracker import Tracker, Tracks
from asca_pillars.detection.detections import Detections, FrameReport

__all__ = [
    "Bundle",
    "Detections",
    "Detector",
    "FrameReport",
    "ScanDetections",
    "ScanQueue",
    "Tracker",
    "Tracks",
    "default_bundle_path",
    "find_bundle",
    "load_bundle",
    "sample_scan_path",
    "shipped_bundles",
]
