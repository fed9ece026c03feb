"""Scans with simulated mistakes: are they detected, and does the remedy in the warning restore the boxes?

    python -m benchmarks.wrong_mountings data/kitti/training/velodyne

Files are written as by another sensor and read back as in `asca detect`.
"""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy import Detections, Detector
from asca_pillars.base.errors import AscaError
from asca_pillars.base.schema import parse
from asca_pillars.cli.run_command import run_command
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_input import ScanInput
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.scans.scan_settings import ScanSettings

MIN_IOU = 0.5
Points = NDArray[np.float32]


class Mistake(NamedTuple):
    """Mistake in a scan."""

    make: Callable[[Points], Points]
    """(N, 4) correct -> (N, 4 or 5) as in the wrong file."""
    mounting: Mounting
    """Mounting that corrects it."""


def _scaled(scale: float) -> Callable[[Points], Points]:
    return lambda points: np.column_stack([points[:, :3], np.round(points[:, 3] * scale)])


def _seen(axes: str) -> Mistake:
    mounting = Mounting(axes=axes)
    return Mistake(mounting.level.inverse.points, mounting)


MISTAKES = {
    "none": Mistake(lambda points: points, Mounting()),
    "z = 0 on the ground": Mistake(
        lambda points: points + np.array([0, 0, 1.73, 0], np.float32), Mounting(sensor_height_m=0.0)
    ),
    "y forward": _seen("y-forward"),
    "z down": _seen("x,-y,-z"),
    "reflectance 0..100": Mistake(_scaled(100), Mounting()),
    "reflectance 0..255": Mistake(_scaled(255), Mounting()),
    "five columns": Mistake(lambda points: np.column_stack([points, np.arange(len(points)) % 64]), Mounting()),
}


def main(scans: Annotated[Path, typer.Argument(help="Right scans of the sensor of the training.")]) -> None:
    """Print how often each mistake is noticed, and how many boxes of the right scans come back."""
    files, columns = find_scans(scans), ("mistake", "noticed", "boxes before", "with the remedy")
    table = Table(title=f"{len(files)} scans")
    for column in columns:
        table.add_column(column, justify="left" if column == "mistake" else "right")
    right = [Detector()(read_scan(path).points) for path in files]
    for name, mistake in MISTAKES.items():
        rows = [_try(path, mistake, boxes) for path, boxes in zip(track(files, name), right, strict=True)]
        noticed, before, after = np.sum(rows, axis=0)
        total = sum(map(len, right))
        table.add_row(name, f"{noticed} of {len(files)}", f"{before} of {total}", f"{after} of {total}")
    Console().print(table)


def _try(path: Path, mistake: Mistake, right: Detections) -> tuple[int, int, int]:
    """Return whether it is detected, and the correct scan's boxes found before and with the remedy."""
    with tempfile.TemporaryDirectory() as folder:
        wrong = Path(folder) / "scan.bin"
        mistake.make(read_scan(path).points).astype("<f4").tofile(wrong)
        texts, found = _detect(wrong, ScanSettings())
        options = dict(re.findall(r"\(--([a-z-]+) (\S+?)(?: or auto)?\)", " ".join(texts)))
        named = {name.replace("-", "_"): yaml.safe_load(value) for name, value in options.items()}
        remedy = parse(ScanSettings, named, "remedy")
        _, mended = _detect(wrong, remedy)
    own = mistake.mounting.to_model(Detector().bundle.expected_input.sensor_height_m)
    return (
        int(bool(texts)),
        _found(right, own.boxes(found.boxes), found),
        _found(right, own.boxes(mended.boxes), mended),
    )


def _detect(path: Path, settings: ScanSettings) -> tuple[list[str], Detections]:
    try:
        scan_input = ScanInput(settings, [path])
        scan = scan_input.read(path)
    except AscaError as error:
        return [str(error)], Detections.empty(())
    found = Detector(mounting=scan_input.mounting)(scan.points)
    warnings = [text for text in found.report.warnings if "--around" not in text]  # also true for the correct one
    return [*scan_input.notes, *scan.notes.remarks, *warnings], found


def _found(right: Detections, boxes: NDArray[np.float32], found: Detections) -> int:
    same = right.labels[:, None] == found.labels[None]
    return int((same & (bev_iou(right.boxes, boxes) >= MIN_IOU)).any(axis=1).sum())


if __name__ == "__main__":
    run_command(main)
