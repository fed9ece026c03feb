"""Files of this project that a scan passes through from its file to the boxes.

    python -m benchmarks.call_path [SCAN] [--bundle BUNDLE]

A file counts if at least one of its functions is called, in a detector after its first scan. Compiled
numba loops are in files of their own (`*_kernels.py`), as a second form of a function of the calling file.
"""

import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

import asca_deploy
import asca_pillars
from asca_deploy import Detector, sample_scan_path
from asca_pillars.cli.run_command import run_command
from asca_pillars.scans.scan_reader import read_scan

ROOTS = [Path(package.__file__).parent for package in (asca_pillars, asca_deploy) if package.__file__]


def main(
    scan: Annotated[Path | None, typer.Argument(help="A scan. Default: the sample.")] = None,
    bundle: Annotated[str | None, typer.Option(help="Folder, or one that ships. Default: the one that ships.")] = None,
) -> None:
    """Print each file with its functions and how often they were called."""
    calls = called_functions(Detector(bundle), sample_scan_path() if scan is None else scan)
    files = sorted({name for name, _ in calls})
    for name in files:
        functions = [f"{function} {count}" for (file, function), count in calls.items() if file == name]
        print(f"{name}: {', '.join(functions)}")
    compiled = sum(name.endswith("_kernels.py") for name in files)
    print(f"{len(files)} files, {compiled} of them with compiled forms, {sum(calls.values())} calls")


def called_functions(detector: Detector, scan: Path) -> Counter[tuple[str, str]]:
    """Count the calls of (file, function) of this project from reading the scan to its boxes."""
    calls: Counter[tuple[str, str]] = Counter()

    def count(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and any(path.is_relative_to(root) for root in ROOTS):
            calls[path.name, frame.f_code.co_name] += 1

    detector(read_scan(scan).points)  # creates cached tables
    sys.setprofile(count)
    try:
        detector(read_scan(scan).points)
    finally:
        sys.setprofile(None)
    return calls


if __name__ == "__main__":
    run_command(main)
