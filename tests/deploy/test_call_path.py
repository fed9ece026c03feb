"""A scan's way from its file to the boxes stays short enough to be read."""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import asca_deploy
import asca_pillars
from asca_deploy import Detector, sample_scan_path
from asca_pillars.scans.scan_reader import read_scan
from tests.helpers.bundles import DENSE_INT8

ROOTS = [str(Path(str(package.__file__)).parent) for package in (asca_pillars, asca_deploy)]


@pytest.mark.parametrize(("bundle", "most"), [(DENSE_INT8, 15), ("fast", 18)])
def test_a_scan_passes_through_fifteen_files_and_three_of_rulebooks_at_most(bundle: str | Path, most: int) -> None:
    detector, scan = Detector(bundle), sample_scan_path()
    detector(read_scan(scan).points)  # creates cached rulebooks
    files: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(tuple(ROOTS)):
            files.add(Path(frame.f_code.co_filename).name)

    sys.setprofile(note)
    try:
        detector(read_scan(scan).points)
    finally:
        sys.setprofile(None)
    assert {"scan_reader.py", "detector.py", "detections.py"} <= files
    assert len(files) <= most, " ".join(sorted(files))
