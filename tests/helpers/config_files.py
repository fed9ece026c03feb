"""Configuration files for tests, and how one is refused."""

from pathlib import Path

import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.tree import load_config


def write(folder: Path, text: str) -> Path:
    path = folder / "model.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(path: Path, *overrides: str) -> str:
    """The one line that the file or an override is refused with; it names the file."""
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)
