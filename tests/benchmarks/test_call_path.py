"""A scan's way from its file to the boxes stays short enough to be read."""

from pathlib import Path

import pytest

from asca_deploy import Detector, sample_scan_path
from benchmarks.call_path import called_functions
from tests.helpers.bundles import DENSE_INT8


@pytest.mark.parametrize(("bundle", "most"), [(DENSE_INT8, 15), ("fast", 18)])
def test_a_scan_passes_through_fifteen_files_and_three_of_tables_at_most(bundle: str | Path, most: int) -> None:
    calls = called_functions(Detector(bundle), sample_scan_path())
    assert {("scan_reader.py", "read_scan"), ("detections.py", "__post_init__")} <= set(calls)
    assert calls["detector.py", "__call__"] == 1
    files = {name for name, _ in calls}
    assert len(files) <= most, sorted(files)
