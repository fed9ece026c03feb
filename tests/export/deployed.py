"""A bundle finds what its checkpoint finds: one scan after the other, streamed, in threads, and without PyTorch."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from asca_deploy import Detector
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.models.scan_detector import ScanDetector
from tests.export.tiny import SCANS

_DETECT = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "lightning", "onnx", "onnxscript", "asca_export"):
            raise ImportError(f"{name} must not be imported here")

sys.meta_path.insert(0, NoTorch())
import numpy as np
import asca_deploy
print(len(asca_deploy.Detector(sys.argv[1], score_threshold=0.0, threads=1)(np.load(sys.argv[2]))))
"""


def assert_same_detector(checkpoint: Checkpoint, folder: Path, tmp_path: Path) -> None:
    """All boxes of the checkpoint and of the bundle in `folder`, whatever their score."""
    in_torch = ScanDetector(checkpoint.detector, checkpoint.config.model.spec.with_score_threshold(0.0))
    in_onnx = Detector(folder, score_threshold=0.0, threads=1)
    found = [in_onnx(scan) for scan in SCANS]
    assert sum(map(len, found)) > 0
    for scan, detections in zip(SCANS, found, strict=True):
        expected = in_torch(scan)
        np.testing.assert_allclose(detections.boxes, expected.boxes, atol=1e-2)
        np.testing.assert_allclose(detections.scores, expected.scores, atol=1e-3)
    assert set(found[0].report.times_ms) == {"input", *in_onnx.pipeline.stages}
    for streamed, alone in zip(in_onnx.stream(SCANS), found, strict=True):
        np.testing.assert_array_equal(streamed.boxes, alone.boxes)
    with ThreadPoolExecutor(3) as pool:
        for together, alone in zip(pool.map(in_onnx, SCANS), found, strict=True):
            np.testing.assert_array_equal(together.boxes, alone.boxes)
    np.save(tmp_path / "scan.npy", SCANS[0])
    command = [sys.executable, "-W", "error", "-c", _DETECT, str(folder), str(tmp_path / "scan.npy")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) == len(found[0])
