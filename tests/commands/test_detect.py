"""`asca detect` says what it dropped and what it ran on."""

import json
from pathlib import Path

import numpy as np
import pytest

from asca_deploy import sample_scan_path
from asca_pillars.commands.detect import run
from asca_pillars.data.scans.scan_reader import read_scan


def test_dropped_points_and_arithmetic_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = read_scan(sample_scan_path()).points[::10].copy()
    points[:7, 0] = np.nan
    np.save(tmp_path / "scan.npy", points)
    run(tmp_path / "scan.npy", tmp_path / "out", None, None, "cpu", None, 1)
    said = " ".join(capsys.readouterr().out.split())
    assert "7 points of 1 scan(s) are not finite and were dropped" in said and said.count("not finite") == 1
    assert "cpu int8, 1 threads" in said
    written = json.loads((tmp_path / "out" / "scan.json").read_text())
    assert (written["points_not_finite"], written["points"]) == (7, len(points) - 7)
