"""Scan files one after the other: boxes in memory and, if wanted, as files."""

import errno
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detector import Detector
from asca_deploy.open_model import RuntimeOptions, open_detector
from asca_deploy.result_files import ResultWriter
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.shipped import sample_scan_path
from asca_pillars.base.errors import ScanError, printable
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.data.boxes.detector_scope import detector_scope
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.pictures.video import VideoView
from asca_pillars.scans.find_scans import name_scans
from asca_pillars.scans.scan_input import ScanInput
from asca_pillars.scans.scan_reader import ScanNotes
from asca_pillars.scans.scan_settings import ScanSettings

_NUMBER = re.compile(r"\d[\d.,]*")
_PLAIN = RuntimeOptions()
_AS_TRAINED = ScanSettings()


@dataclass(frozen=True)
class DetectedScan:
    """One scan: its file, what was repaired while reading it, and its boxes with their report."""

    path: Path
    notes: ScanNotes
    detections: ScanDetections


@dataclass(frozen=True)
class DetectedScans:
    """The results of `detect_scans`.

    Attributes:
        scans: in natural order of their files; without those that cannot be read.
        detector: that found the boxes.
        failed: a line for each scan that cannot be read, or whose results cannot be written.
        unreadable: how many of these cannot be read.
        last_points: (N, 4) of the last scan.
        remarks: what was decided for a folder, repaired or odd.
    """

    scans: tuple[DetectedScan, ...]
    detector: Detector
    failed: tuple[str, ...]
    unreadable: int
    last_points: NDArray[np.float32]
    remarks: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[DetectedScan]:
        return iter(self.scans)

    def __getitem__(self, index: int) -> DetectedScan:
        return self.scans[index]


def detect_scans(
    scans: str | Path | Sequence[str | Path] | None = None,
    out: str | Path | None = None,
    *,
    options: RuntimeOptions = _PLAIN,
    reading: ScanSettings = _AS_TRAINED,
    score: ScoreThresholds | None = None,
    around: bool = False,
    pictures: bool = True,
    video: str | Path | None = None,
    video_view: VideoView = "above",
    progress: Progress | None = None,
    failed: Remark | None = None,
) -> DetectedScans:
    """Detect in scan files and folders of them; what `asca detect` does.

    Args:
        scans: files and folders; None: the sample that comes with the package.
        out: folder for the boxes and pictures of each scan and for detections.jsonl; None writes nothing.
        options: which model runs, and how.
        reading: how the files are read and the sensor was mounted.
        score: report detections from this score on, or by class; None: the thresholds of the model.
        around: look in every direction, by turned passes.
        pictures: whether pictures are drawn into `out`.
        video: an .mp4 of all scans, written with `out`; None makes none.
        video_view: from above, or "chase" in 3D.
        progress: called after each scan.
        failed: called with a line for each scan that cannot be read or written, as soon as that is known.

    Raises:
        ScanError: there are no scans, or none can be read.
        AscaError: the model cannot be opened, or `out` holds something else; one line with the remedy.
    """
    chosen = [sample_scan_path()] if scans is None else [scans] if isinstance(scans, str | Path) else scans
    named = name_scans([Path(path) for path in chosen])
    scan_input = ScanInput(reading, [path for path, _ in named])
    detector = open_detector(options, score, scan_input.mounting, around=around)
    writer = None
    if out is not None:
        scope = detector_scope(detector.spec, around=around)
        writer = ResultWriter(
            Path(out),
            [name for _, name in named],
            pictures=pictures,
            scope=scope,
            video=None if video is None else Path(video),
            video_view=video_view,
        )
    reporter = Reporter(progress if len(named) > 1 else None, failed)
    results: list[DetectedScan] = []
    unreadable = 0
    with writer or nullcontext():
        for path, name in reporter.track(named, "Detecting"):
            try:
                scan = scan_input.read(path)
                detections = detector(scan.points)
            except (ScanError, OSError) as error:
                if len(named) == 1:
                    raise
                unreadable += 1
                reporter.remark(printable(str(error)))
                continue
            results.append(DetectedScan(path, scan.notes, detections))
            try:
                if writer is not None:
                    writer(path, name, scan, detections)
            except OSError as error:
                if error.errno != errno.ENAMETOOLONG:
                    raise
                reporter.remark(printable(str(error)))
    if not results:
        raise ScanError(f"none of the {len(named)} scans can be read")
    remarks = (*scan_input.said, *repairs(results), *([] if writer is None else writer.remarks[:1]))
    return DetectedScans(tuple(results), detector, tuple(reporter.remarks), unreadable, scan.points, remarks)


def repairs(results: Iterable[DetectedScan]) -> Iterator[str]:
    """What was repaired, dropped or odd, each kind once, with the first scan that it concerns and how many others."""
    names: dict[str, list[str]] = defaultdict(list)
    for result in results:
        notes = result.notes
        texts = [*notes.remarks, *result.detections.report.warnings]
        if notes.dropped_points:  # when the file was read; what the detector dropped is among its warnings
            texts.append(f"{notes.dropped_points} points are not finite and were dropped")
        if notes.clipped_reflectances:
            texts.append(
                f"{notes.clipped_reflectances} reflectances lie outside 0..{notes.reflectance_scale:g} and were set "
                "to the nearer end; if they are stored on another scale, state it (--reflectance-scale)"
            )
        for text in texts:
            names[_NUMBER.sub("#", text)].append(f"{result.path.name}: {text}")  # of one kind: alike but for numbers
    for lines in names.values():
        yield lines[0] + (f" (and {len(lines) - 1} more scans alike)" if lines[1:] else "")
