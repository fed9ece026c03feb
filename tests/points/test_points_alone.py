"""The host's side of the second stage needs neither torch nor numba."""

import subprocess
import sys

CODE = """
import importlib, pkgutil, sys
sys.modules["numba"] = None
import asca_pillars.points
for module in pkgutil.iter_modules(asca_pillars.points.__path__):
    if module.name not in ("ball_kernels", "sampling_kernels"):
        importlib.import_module(f"asca_pillars.points.{module.name}")
import asca_pillars.points.refine_geometry
import numpy as np
from asca_pillars.points.ball_query import ball_query
from asca_pillars.points.farthest_points import farthest_points
points = np.arange(30, dtype=np.float32).reshape(10, 3)
assert farthest_points(points, 3).tolist() == [0, 9, 4]
assert sorted(ball_query(points, points[:1], 6.0, 2)[0].tolist()) == [0, 1]
assert "torch" not in sys.modules
"""


def test_without_torch_and_numba() -> None:
    result = subprocess.run([sys.executable, "-W", "error", "-c", CODE], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
