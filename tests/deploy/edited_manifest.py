"""Manifests with one value changed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from asca_deploy.bundle import MANIFEST
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import BundleError


def edit(bundle: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change bundle.json by hand."""
    data = json.loads((bundle / MANIFEST).read_text())
    change(data)
    (bundle / MANIFEST).write_text(json.dumps(data))
    return bundle


def assert_refused(bundle: Path, message: str) -> None:
    with pytest.raises(BundleError, match=message) as caught:
        load_pillar_bundle(bundle)
    text = str(caught.value)
    assert text.isprintable() and len(text) < 1500
    assert str(bundle) in text  # whose fault it is


NOT_THE_GRAPHS = r"`{}` is not the one that \w+\.onnx was exported with; .*export"
