"""Tables of `asca detect`: one scan's boxes or a row per scan, and the time of every stage."""

import statistics
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from asca_deploy import Detector, FrameReport, ScanDetections
from asca_deploy.detect_scans import DetectedScans
from asca_pillars.detection.spec import DetectorSpec


def boxes(path: Path, detections: ScanDetections) -> Table:
    """Return a table of the boxes of one scan, nearest first."""
    table = Table(title=f"{path.name}: {len(detections)} objects")
    for column in ("class", "score", "distance", "direction", "size l x w x h", "heading"):
        table.add_column(column, justify="left" if column == "class" else "right")
    bearings_deg = np.rad2deg(detections.bearings_rad)
    for index in np.argsort(detections.distances_m):
        length, width, height, yaw = detections.boxes[index, 3:]
        table.add_row(
            detections.names[index],
            f"{detections.scores[index]:.2f}",
            f"{detections.distances_m[index]:.1f} m",
            _direction(bearings_deg[index]),
            f"{length:.1f} x {width:.1f} x {height:.1f} m",
            f"{np.rad2deg(yaw):+.0f}°",
        )
    return table


def _direction(bearing_deg: float) -> str:
    """Return a direction relative to straight ahead, such as "12° left" or "170° right"."""
    angle = round(abs(bearing_deg))
    return "ahead" if angle == 0 else f"{angle}° {'left' if bearing_deg > 0 else 'right'}"


def scans(results: DetectedScans, spec: DetectorSpec) -> Table:
    """Return a table with the number of objects of each class, a row per scan."""
    table = Table(title=f"{len(results)} scans")
    for column in ("scan", "points", *spec.class_names, "time"):
        table.add_column(column, justify="left" if column == "scan" else "right")
    for result in results:
        report = result.detections.report
        counts = map(str, np.bincount(result.detections.labels, minlength=len(spec.classes)))
        table.add_row(
            result.path.name, str(report.counts.points // report.passes), *counts, f"{report.total_ms:.0f} ms"
        )
    return table


def timing(reports: Sequence[FrameReport], detector: Detector) -> str:
    """Return the median times of frames after the warm-up, by stage."""
    medians = {
        stage: statistics.median(scan_report.times_ms[stage] for scan_report in reports)
        for stage in reports[0].times_ms
    }
    total_ms = statistics.median(report.total_ms for report in reports)
    stages = " + ".join(f"{stage} {value:.1f}" for stage, value in medians.items())
    passes = f" in {detector.passes} passes" if detector.passes > 1 else ""
    return (
        f"{1e3 / total_ms:.1f} FPS: {total_ms:.1f} ms per scan{passes} (median of {len(reports)} warm frames, "
        f"{detector.runs_on}, {detector.threads} threads): {stages} ms"
    )
