"""Bundles of the tiny checkpoint, exported once: an export takes seconds."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from asca_export.bundle_writer import ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from tests.export.tiny import CHECKPOINTS, SCANS
from tests.helpers.made_once import made_once


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The bundle of a checkpoint, by its name in CHECKPOINTS, in floating point, which no test changes."""

    @cache
    def export(name: str) -> Path:
        def make(folder: Path) -> None:
            stated = ExportOptions(trained_on="nothing", command="none")
            export_pillar_bundle(CHECKPOINTS[name](), folder / name, SCANS, stated)

        return made_once(tmp_path_factory, f"exported_{name}", make) / name

    return export
