"""A dataset to be inspected, changed in one thing at a time."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig, pillar_spec
from asca_pillars.data.inspection.findings import Finding, findings
from asca_pillars.data.inspection.inspect_dataset import Inspection, inspect_dataset
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.scans.scan_settings import stored_points
from tests.helpers.scenes import GRID, SPEC

Points = NDArray[np.float32]


CONFIG = Config(name="tiny", model=PillarModel(spec=SPEC), data=DataConfig(train_set="training", val_set="training"))


def with_data(**changes: Any) -> Config:
    return dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, **changes))


def with_detector(**changes: Any) -> Config:
    return dataclasses.replace(CONFIG, model=PillarModel(spec=dataclasses.replace(SPEC, **changes)))


def with_grid(**changes: Any) -> Config:
    return with_detector(grid=dataclasses.replace(GRID, **changes))


def inspected(root: Path, config: Config, *, split: str | None = None, frames: int = 500) -> Inspection:
    expected = KittiSplit(root, config.data.train_set if split is None else split)
    return inspect_dataset(expected, pillar_spec(config), config.data, frames=frames)


def found(root: Path, config: Config = CONFIG) -> list[Finding]:
    return findings(inspected(root, config), pillar_spec(config), config.data.min_points)


def change_scans(root: Path, change: Callable[[Points], object], every: int = 1) -> None:
    for path in sorted((root / "training" / "velodyne").iterdir())[::every]:
        points = stored_points(path)
        change(points)
        points.tofile(path)


def change_files(root: Path, folder: str, change: Callable[[str], str]) -> None:
    for path in (root / "training" / folder).iterdir():
        path.write_text(change(path.read_text()))
