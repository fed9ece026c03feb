"""A bundle finds what its checkpoint finds: one scan after the other, streamed, and in threads."""

import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from asca_deploy import Detections, Detector
from asca_deploy.bundle import MANIFEST
from asca_pillars.models.build import Checkpoint, ScanDetector
from tests.export.tiny import SCANS


def changed_manifest(folder: Path, out: Path, change: Callable[[Any], object]) -> Path:
    """A copy of the bundle whose manifest somebody has edited."""
    shutil.copytree(folder, out)
    data = json.loads((out / MANIFEST).read_text())
    change(data)
    (out / MANIFEST).write_text(json.dumps(data))
    return out


def assert_same_boxes(found: Detections, expected: Detections, box: float = 1e-3, score: float = 1e-4) -> None:
    """Within these tolerances; the labels are the same."""
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_allclose(found.boxes, expected.boxes, atol=box)
    np.testing.assert_allclose(found.scores, expected.scores, atol=score)


def assert_same_detector(checkpoint: Checkpoint, folder: Path) -> None:
    """All boxes of the checkpoint and of the bundle in `folder`, whatever their score."""
    in_torch = ScanDetector(checkpoint.detector, checkpoint.config.model.spec.with_score_threshold(0.0))
    in_onnx = Detector(folder, score_threshold=0.0, threads=1)
    found = [in_onnx(scan) for scan in SCANS]
    assert sum(map(len, found)) > 0
    for scan, detections in zip(SCANS, found, strict=True):
        assert_same_boxes(detections, in_torch(scan), box=1e-2, score=1e-3)
    assert set(found[0].report.times_ms) == {"input", *in_onnx.pipeline.stages}
    for streamed, alone in zip(in_onnx.stream(SCANS), found, strict=True):
        np.testing.assert_array_equal(streamed.boxes, alone.boxes)
    with ThreadPoolExecutor(3) as pool:
        for together, alone in zip(pool.map(in_onnx, SCANS), found, strict=True):
            np.testing.assert_array_equal(together.boxes, alone.boxes)
