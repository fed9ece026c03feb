"""A recording of a few scans, in which everything comes nearer, and `asca detect` of such ones."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from asca_deploy import sample_scan_path
from asca_pillars.cli.detect import detect
from asca_pillars.scans.scan_reader import read_scan
from tests.scans.recordings.cloud_recordings import laid_out, stamps, write_mcap

SAMPLE = read_scan(sample_scan_path()).points
_NEAR = (SAMPLE[:, 0] > 2) & (SAMPLE[:, 0] < 30) & (np.abs(SAMPLE[:, 1]) < 12)
POINTS = SAMPLE[::4][_NEAR[::4]].copy()
"""A quarter of the sample's near points ahead. One pass of a small model finds several cars and a pedestrian there."""
SCANS = 5
BUNDLE = Path("fast")


def scan(number: int) -> np.ndarray:
    """The points of a scan of the drive: half a metre nearer from scan to scan."""
    return POINTS - np.array([0.5 * number, 0, 0, 0], np.float32)


def write_drive(path: Path, **others: Any) -> Path:
    messages = [(time_ns, laid_out(scan(number), time_ns=time_ns)) for number, time_ns in enumerate(stamps(SCANS))]
    return write_mcap(path, {"/lidar": messages}, **others)


def read_lines(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "detections.jsonl").read_text().splitlines()]


def run(path: Path, out: Path, **options: Any) -> list[dict[str, Any]]:
    options.setdefault("bundle", BUNDLE)
    options.setdefault("threads", 1)
    detect([path], out=out, **options)
    return read_lines(out)
