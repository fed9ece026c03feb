"""The runtime works where numba does not exist, and finds the same there."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import asca_deploy

DETECT = """
import sys
sys.modules["numba"] = None
import numpy as np
from asca_deploy import Detector

bundle, scan, boxes = sys.argv[1:]
found = Detector(bundle)(np.load(scan))
np.savez(boxes, boxes=found.boxes, scores=found.scores, labels=found.labels)
assert not any(name.startswith("llvmlite") for name in sys.modules)
"""

IMPORT = """
import sys, asca_deploy, asca_pillars.cli
assert "numba" not in sys.modules
asca_deploy.Detector(sys.argv[1])
assert "numba" in sys.modules, "compiling is for the loading, not for the first scan"
"""


def python(code: str, *arguments: object) -> None:
    command = [sys.executable, "-W", "error", "-c", code, *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr


def test_finds_the_same_without_numba(tiny_bundle: Path, scan: NDArray[np.float32], tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", scan)
    python(DETECT, tiny_bundle, tmp_path / "scan.npy", tmp_path / "boxes.npz")
    found, alone = asca_deploy.Detector(tiny_bundle)(scan), np.load(tmp_path / "boxes.npz")
    assert len(found) > 3
    for name in ("boxes", "scores", "labels"):
        np.testing.assert_array_equal(getattr(found, name), alone[name])


def test_numba_is_imported_with_the_first_detector(tiny_bundle: Path) -> None:
    python(IMPORT, tiny_bundle)
