"""What `asca_pillars` itself gives: the stable names, imported when they are used, without PyTorch."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import asca_pillars

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", asca_pillars.__all__)
def test_every_name_is_there_and_where_mypy_thinks(name: str) -> None:
    assert getattr(asca_pillars, name) is not None
    assert name in dir(asca_pillars)
    source = Path(asca_pillars.__file__).read_text()
    if name != "__version__":
        home = asca_pillars._HOMES[name]
        assert re.search(rf"^    from {re.escape(home)} import .*\b{name}\b", source, re.MULTILINE)


def test_an_unknown_name() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Detectr'"):
        _ = asca_pillars.Detectr  # type: ignore[attr-defined]


def test_the_import_is_light_and_never_brings_torch() -> None:
    code = (
        "import sys, asca_pillars; heavy = {'numpy', 'onnxruntime', 'torch', 'cv2', 'pydantic'};"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules);"
        "from asca_pillars import Detector, Detections, FrameReport, read_scan, load_bundle;"
        "assert 'torch' not in sys.modules; print('fine')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "fine", result.stderr


def test_the_page_names_them_all() -> None:
    page = (ROOT / "docs" / "API.md").read_text()
    assert not [name for name in asca_pillars.__all__ if f"`{name}" not in page]
