"""Bundles of the tiny checkpoint, exported once: an export takes seconds."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from asca_export.bundle_writer import ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.config.pillar import CpaReading
from tests.export.tiny import SCANS, tiny_checkpoint
from tests.helpers.made_once import made_once


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[CpaReading], Path]:
    """The bundle of `tiny_checkpoint(reading)` in floating point, which no test changes."""

    @cache
    def export(cpa: CpaReading) -> Path:
        def make(folder: Path) -> None:
            export_pillar_bundle(
                tiny_checkpoint(cpa), folder / cpa, SCANS, ExportOptions(trained_on="nothing", command="none")
            )

        return made_once(tmp_path_factory, f"exported_{cpa}", make) / cpa

    return export
