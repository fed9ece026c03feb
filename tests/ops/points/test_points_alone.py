"""Operations on the host need no torch."""

import subprocess
import sys

CODE = """
import importlib, pkgutil, sys
import asca_pillars.ops
for module in pkgutil.walk_packages(asca_pillars.ops.__path__, "asca_pillars.ops."):
    importlib.import_module(module.name)
import asca_pillars.ops.two_stage.prepare
import numpy as np
from asca_pillars.ops.points.neighbors import ball_query
from asca_pillars.ops.points.sampling import farthest_points
points = np.arange(30, dtype=np.float32).reshape(10, 3)
assert farthest_points(points, 3).tolist() == [0, 9, 4]
assert sorted(ball_query(points, points[:1], 6.0, 2)[0].tolist()) == [0, 1]
assert "torch" not in sys.modules
"""


def test_without_torch() -> None:
    result = subprocess.run([sys.executable, "-W", "error", "-c", CODE], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
