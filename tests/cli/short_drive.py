"""A recording of a few scans, in which everything comes nearer."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from asca_deploy import sample_scan_path
from asca_pillars.cli.detect import detect
from asca_pillars.scans.scan_reader import read_scan
from tests.scans.recordings.cloud_recordings import laid_out, stamps, write_mcap

POINTS = read_scan(sample_scan_path()).points[::4].copy()
SCANS = 5


def write_drive(path: Path) -> Path:
    """The sample scan, shifted by half a metre from scan to scan."""
    messages = []
    for index, time_ns in enumerate(stamps(SCANS)):
        points = POINTS - np.array([0.5 * index, 0, 0, 0], np.float32)
        messages.append((time_ns, laid_out(points, time_ns=time_ns)))
    return write_mcap(path, {"/lidar": messages})


def run(path: Path, out: Path, **options: Any) -> list[dict[str, Any]]:
    detect([path], out=out, threads=1, **options)
    return [json.loads(line) for line in (out / "detections.jsonl").read_text().splitlines()]
