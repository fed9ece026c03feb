"""What `asca detect` prints: one scan's boxes or a line per scan, notes, and the time of every stage."""

import re
import statistics
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from asca_deploy import Detector, FrameReport, ScanDetections
from asca_pillars.base.errors import printable
from asca_pillars.scans.scan_reader import ScanNotes

_NUMBER = re.compile(r"\d[\d.,]*")


class Result(NamedTuple):
    """What is kept of a scan that has been detected: `labels` (N,) are class indices."""

    path: Path
    notes: ScanNotes
    labels: NDArray[np.int64]
    report: FrameReport


def remark(console: Console, text: str) -> None:
    """Print a line that the user is to notice; it may quote names of files and topics."""
    console.print(printable(text), style="yellow", soft_wrap=True)


def boxes(path: Path, detections: ScanDetections) -> Table:
    """The boxes of one scan, the nearest first."""
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
    """Such as "12° left" or "170° right", from straight ahead."""
    angle = round(abs(bearing_deg))
    return "ahead" if angle == 0 else f"{angle}° {'left' if bearing_deg > 0 else 'right'}"


def scans(results: Sequence[Result], class_names: Sequence[str]) -> Table:
    """A line per scan: how many objects of each class."""
    table = Table(title=f"{len(results)} scans")
    for column in ("scan", "points", *class_names, "time"):
        table.add_column(column, justify="left" if column == "scan" else "right")
    for path, _, labels, report in results:
        counts = np.bincount(labels, minlength=len(class_names))
        table.add_row(
            path.name, str(report.counts.points // report.passes), *map(str, counts), f"{report.total_ms:.0f} ms"
        )
    return table


def notes(results: Iterable[Result]) -> Iterator[str]:
    """What was repaired, dropped or odd, each kind once, with the first scan that it concerns and how many others."""
    names: dict[str, list[str]] = defaultdict(list)
    for path, notes, _, report in results:
        found = [*notes.remarks, *report.warnings]
        if notes.dropped_points:  # when the file was read; what the detector dropped is among its warnings
            found.append(f"{notes.dropped_points} points are not finite and were dropped")
        if notes.clipped_reflectances:
            found.append(
                f"{notes.clipped_reflectances} reflectances lie outside 0..{notes.reflectance_scale:g} and were set "
                "to the nearer end; if they are stored on another scale, state it (--reflectance-scale)"
            )
        for text in found:
            names[_NUMBER.sub("#", text)].append(f"{path.name}: {text}")  # of one kind: alike but for the numbers
    for lines in names.values():
        yield lines[0] + (f" (and {len(lines) - 1} more scans alike)" if lines[1:] else "")


def timing(reports: Sequence[FrameReport], detector: Detector) -> str:
    """Median times of warm frames, stage by stage."""
    medians = {stage: statistics.median(one.times_ms[stage] for one in reports) for stage in reports[0].times_ms}
    total_ms = statistics.median(report.total_ms for report in reports)
    stages = " + ".join(f"{stage} {value:.1f}" for stage, value in medians.items())
    passes = f" in {detector.passes} passes" if detector.passes > 1 else ""
    return (
        f"{1e3 / total_ms:.1f} FPS: {total_ms:.1f} ms per scan{passes} (median of {len(reports)} warm frames, "
        f"{detector.runs_on}, {detector.threads} threads): {stages} ms"
    )
