"""A recording of a few scans, in which everything comes nearer."""

from pathlib import Path

import numpy as np

from asca_deploy import sample_scan_path
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
