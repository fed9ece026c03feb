"""The runtime works where PyTorch does not exist, and compiles when it is loaded, not in the first scan."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import asca_deploy

DETECT = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "lightning", "pytorch_lightning", "onnx", "onnxscript"):
            raise ImportError(f"{name} must not be imported here")

sys.meta_path.insert(0, NoTorch())
from pathlib import Path
import numpy as np
import asca_deploy
import asca_pillars.cli

bundle, scan = sys.argv[1:]
points = np.load(scan)
assert "numba" not in sys.modules
detector = asca_deploy.Detector(bundle)
assert "numba" in sys.modules
print(len(detector(points)))
from asca_deploy.benchmark import benchmark
from asca_pillars.cli.export import export
benchmark(asca_deploy.Detector(bundle), [points], rounds=1, warmup=0)
export(Path(bundle), out=Path(scan).parent / "golden", scans=Path(scan), golden=True)
assert not any(name.split(".")[0] == "torch" for name in sys.modules)
"""


def test_detects_in_a_process_that_cannot_import_torch(
    tiny_bundle: Path, scan: NDArray[np.float32], tmp_path: Path
) -> None:
    np.save(tmp_path / "scan.npy", scan)
    command = [sys.executable, "-W", "error", "-c", DETECT, str(tiny_bundle), str(tmp_path / "scan.npy")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout.splitlines()[0]) == len(asca_deploy.Detector(tiny_bundle)(scan)) > 3
