"""The statistics of a folder in KITTI's layout, simulated or real."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.sim.report.fit_statistics import fits_of
from asca_pillars.sim.report.label_statistics import label_statistics
from asca_pillars.sim.report.reference import CLASSES, Statistics, kitti_reference
from asca_pillars.sim.report.scan_statistics import ScanRecord, measure_scan, scan_statistics

MAX_SCANS = 300
"""Scans that are read; their means are known to a percent by then. Labels are cheap and read of every frame."""


@dataclass(frozen=True)
class Measured:
    """The statistics of a data set, and what each of its scans added: the spread among them tells chance apart."""

    statistics: Statistics
    records: Sequence[ScanRecord]


def measure(root: str | Path, *, max_scans: int = MAX_SCANS, progress: bool = True) -> Measured:
    """Measure the frames of `root`/training, at most `max_scans` of their scans, evenly spaced.

    Raises:
        DatasetError: there is no scan, or a frame without labels or calibration.
        ScanError: a damaged scan.
    """
    split = KittiSplit(root)
    frame_ids = split.frame_ids
    if not any(split.label_path(frame_id).is_file() for frame_id in frame_ids):
        raise DatasetError(f"{split.folder / 'label_2'}: no labels there; the comparison needs them for objects")
    labels, dont_care = label_statistics(split, frame_ids)
    chosen = np.linspace(0, len(frame_ids) - 1, min(max_scans, len(frame_ids))).round().astype(int)
    sensor = kitti_reference().sensor
    records = [
        measure_scan(split, frame_ids[index], sensor) for index in track(chosen, "Measuring", disable=not progress)
    ]
    fits = fits_of({name: np.concatenate([record.fits[name] for record in records]) for name in CLASSES}, str(root))
    return Measured(Statistics(str(root), scan_statistics(records), len(frame_ids), labels, dont_care, fits), records)
