from pathlib import Path

import pytest

from tests.data.boxes.box_scenes import write_box_dataset


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_box_dataset(tmp_path / "own", 4)
