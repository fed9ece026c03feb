"""Scan files one after the other: results, tables of boxes and times, and what a user is to know of them."""

import errno
import sys
from collections.abc import Sequence

from rich.console import Console
from rich.progress import track

from asca_deploy import Detector
from asca_pillars.base.errors import ScanError, printable
from asca_pillars.cli import detect_tables as show
from asca_pillars.cli.detect_files import ResultWriter
from asca_pillars.cli.scan_input import ScanInput
from asca_pillars.scans.find_scans import NamedScan

TIMED_FRAMES = 6  # at least so many are run, the first is left out: one frame alone times the warm-up


def detect_scans(
    named: Sequence[NamedScan],
    scan_input: ScanInput,
    detector: Detector,
    writer: ResultWriter,
    console: Console,
) -> None:
    """Detect in each scan, write and print the results.

    Args:
        named: files, each with the name of its results.
        scan_input: reads them.
        detector: finds the boxes.
        writer: of the results.
        console: for the tables.

    Raises:
        ScanError: a scan cannot be read; the others are done first.
    """
    results: list[show.Result] = []
    unreadable = unwritten = 0
    with writer as write:
        for path, name in track(named, "Detecting", console=console, disable=len(named) == 1):
            try:
                scan = scan_input.read(path)
                detections = detector(scan.points)
            except (ScanError, OSError) as error:
                if len(named) == 1:
                    raise
                unreadable += 1
                print(f"asca: {printable(str(error))}", file=sys.stderr)
                continue
            results.append(show.Result(path, scan.notes, detections.labels, detections.report))
            try:
                write(path, name, scan, detections)
            except OSError as error:
                if error.errno != errno.ENAMETOOLONG:
                    raise
                unwritten += 1
                print(f"asca: {printable(str(error))}", file=sys.stderr)
    if not results:
        raise ScanError(f"none of the {len(named)} scans can be read")
    console.print(show.boxes(path, detections) if len(named) == 1 else show.scans(results, detector.spec.class_names))
    for line in (*scan_input.said, *show.notes(results), *write.remarks[:1]):
        show.remark(console, line)
    reports = [result.report for result in results]
    while len(reports) < TIMED_FRAMES:
        reports.append(detector(scan.points).report)
    console.print(show.timing(reports[1:], detector))
    console.print(f"Results: {writer.out}/")
    if unwritten:
        raise ScanError(f"results of {unwritten} of {len(named)} scans could not be written; they are named above")
    if unreadable:
        raise ScanError(f"{unreadable} of {len(named)} scans could not be read; they are named above")
