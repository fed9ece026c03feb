"""Made-up scenes and predictions for `asca eval`, and a recording and a small model for `asca detect`."""

from pathlib import Path
from typing import Any

import pytest

from asca_pillars.data.kitti import KittiObject, KittiSplit, write_labels
from tests.cli.short_drive import write_drive
from tests.deploy.conftest import write_bundle
from tests.helpers.blank_plots import blank_plots
from tests.helpers.scenes import write_dataset


@pytest.fixture
def drawn_plots() -> None:
    """Tests that use this fixture look at a plot, which is really drawn."""


@pytest.fixture(autouse=True)
def _blank_plots(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots are files with nothing on them: to draw one takes a second, and is tested where they are made."""
    if "drawn_plots" not in request.fixturenames:
        blank_plots(monkeypatch)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "kitti", 3, val_frames=2)


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the tests that have rosbags."""
    return write_drive(tmp_path_factory.mktemp("drive") / "drive.mcap")


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny one with random weights, which finds something in any scan, for tests of files and messages."""
    return write_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture
def texts(root: Path) -> dict[str, Any]:
    """The labels of all three frames, and as predictions the labels themselves."""
    labels = root / "training" / "label_2"
    for frame_id in KittiSplit(root).frame_ids:
        scored = [KittiObject(**(vars(item) | {"score": 0.9})) for item in KittiSplit(root).objects(frame_id)]
        write_labels(root.parent / "det" / f"{frame_id}.txt", scored)
    return {"predictions": root.parent / "det", "labels": labels}
