"""numba is imported with the first detector: neither before it, nor in the first scan."""

import subprocess
import sys
from pathlib import Path

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


def test_numba_is_imported_with_the_first_detector(tiny_bundle: Path) -> None:
    python(IMPORT, tiny_bundle)
