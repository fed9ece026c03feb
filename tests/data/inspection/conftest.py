"""A clean data set of made-up scenes, and a copy for the test to spoil."""

import shutil
from pathlib import Path

import pytest

from tests.helpers.scenes import write_dataset

FRAMES = 12


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("clean"), FRAMES)


@pytest.fixture
def data(clean: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return shutil.copytree(clean, tmp_path / "data")
