"""A scan's way from its file to the boxes stays short enough to be read."""

from asca_deploy import Detector, sample_scan_path
from benchmarks.call_path import called_functions


def test_a_scan_passes_through_ten_files_at_most() -> None:
    calls = called_functions(Detector(), sample_scan_path())
    assert {("scan_reader.py", "read_scan"), ("detections.py", "__post_init__")} <= set(calls)
    assert calls["detector.py", "__call__"] == 1
    files = {name for name, _ in calls}
    assert len(files) <= 10, sorted(files)
