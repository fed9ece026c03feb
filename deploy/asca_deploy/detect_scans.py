"""Detection in scan files: boxes in memory and, if wanted, as files, with the scans' time stamps."""

import errno
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detector import Detector
from asca_deploy.open_model import RuntimeOptions, files_need_around, open_detector, track_thresholds
from asca_deploy.recordings.results import FrameResult
from asca_deploy.recordings.sequence_files import SequenceFiles
from asca_deploy.result_files import ResultWriter
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.shipped import sample_scan_path
from asca_deploy.tracker import Tracker, Tracks
from asca_pillars.base.errors import ConfigError, ScanError, printable
from asca_pillars.base.files import read_text
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.data.boxes.detector_scope import detector_scope
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.pictures.video import VideoView
from asca_pillars.scans.find_scans import name_scans
from asca_pillars.scans.scan_reader import ScanNotes
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings

RATE_HZ = 10.0
"""Default rate of scans."""
_MAX_RATE_HZ = 1000.0
_MAX_TIME_S = 9_000_000_000  # in 2255; larger numbers are not seconds


def require_one_folder(paths: Sequence[Path]) -> None:
    """Refuse scans of several folders, whose order in time is unknown, with a ConfigError."""
    if len(folders := sorted({path.parent for path in paths})) > 1:
        raise ConfigError(
            f"{folders[0]} and {folders[1]}: with --track, --rate, --times, --foxglove or --rerun scans lie in one "
            "folder, in the order of their times; give one of these"
        )


def scan_times_ns(count: int, rate_hz: float | None = None, times: Path | None = None) -> list[int]:
    """Return the time of each of `count` scans, nanoseconds, ascending; with a rate, they begin at 0.

    Args:
        count: number of scans.
        rate_hz: scans per second; None: RATE_HZ.
        times: text file with the seconds of each scan, one per line.

    Raises:
        ConfigError: the rate is invalid, or both are given.
        ScanError: the file cannot be read, has another number of times, or they do not ascend.
    """
    if times is None:
        rate = RATE_HZ if rate_hz is None else rate_hz
        if not 0 < rate <= _MAX_RATE_HZ:
            raise ConfigError(f"--rate {rate:g}: give scans per second, above 0 and at most {_MAX_RATE_HZ:g}")
        return [round(number * 1e9 / rate) for number in range(count)]
    if rate_hz is not None:
        raise ConfigError(f"--rate {rate_hz:g} and --times {times}: give one of them")
    stamps = _read_times(times)
    if len(stamps) != count:
        raise ScanError(f"{times}: {len(stamps)} times for {count} scans; list one for each, in their order")
    return stamps


def _read_times(path: Path) -> list[int]:
    try:
        lines = read_text(path, ScanError).split("\n")
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    except UnicodeDecodeError:
        raise ScanError(f"{path}: is not text; list the seconds of each scan, one in a line") from None
    stamps: list[int] = []
    for number, line in enumerate(lines, start=1):
        if not (text := line.strip()):
            continue
        try:
            seconds = Decimal(text)  # a float has too few digits for the nanoseconds of a clock
        except InvalidOperation:
            seconds = Decimal("NaN")
        if seconds.is_nan() or not 0 <= seconds <= _MAX_TIME_S:
            raise ScanError(f"{path}:{number}: {text[:40]!r} is not a time; give seconds, 0 or more")
        time_ns = round(seconds * 1_000_000_000)
        if stamps and time_ns <= stamps[-1]:
            raise ScanError(f"{path}:{number}: {text[:40]} is not after the time before it; list times that ascend")
        stamps.append(time_ns)
    return stamps


_NUMBER = re.compile(r"\d[\d.,]*")
FRAME_ID = "lidar"
"""Frame of scan files, which name none, for viewers."""
_PLAIN = RuntimeOptions()
_AS_TRAINED = ScanSettings()


@dataclass(frozen=True)
class DetectedScan:
    """One scan: its file, what was repaired while reading it, and its boxes with their report.

    `tracks` are the same boxes with identities and velocities, with tracking.
    """

    path: Path
    notes: ScanNotes
    detections: ScanDetections
    tracks: Tracks | None = None


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
    around: bool | None = None,
    pictures: bool = True,
    track: bool = False,
    rate_hz: float | None = None,
    times: str | Path | None = None,
    foxglove: str | Path | None = None,
    rerun: str | Path | None = None,
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
        around: detect in every direction, see `asca_deploy.around`; None: if the first scan lies all around the sensor.
        pictures: whether pictures are drawn into `out`.
        track: give boxes identities and velocities over time; the scans then lie in one folder, in order.
        rate_hz: scans per second of that folder; None: 10.
        times: instead of a rate, a text file with the seconds of each scan, one in a line.
        foxglove: an .mcap to write for Foxglove.
        rerun: an .rrd to write for the rerun viewer.
        video: an .mp4 to write, boxes with their tracks.
        video_view: from above, or "chase" in 3D.
        progress: called after each scan.
        failed: called with a line for each scan that cannot be read or written, as soon as that is known.

    Raises:
        ScanError: there are no scans, or none can be read.
        AscaError: the model cannot be opened, or `out` holds something else; one line with the remedy.
    """
    chosen = [sample_scan_path()] if scans is None else [scans] if isinstance(scans, str | Path) else scans
    named = name_scans([Path(path) for path in chosen])
    paths = [path for path, _ in named]
    files = SequenceFiles(
        foxglove=None if foxglove is None else Path(foxglove),
        rerun=None if rerun is None else Path(rerun),
        video=None if video is None else Path(video),
        video_view=video_view,
    )
    times = None if times is None else Path(times)
    if track or rate_hz is not None or times or foxglove or rerun:
        require_one_folder(paths)
    times_ns = scan_times_ns(len(paths), rate_hz, times)
    files.check([*map(Path, chosen), *paths, times])
    births, weak = track_thresholds(options.bundle, score) if track else ({}, None)
    scan_input = ScanInput(reading, paths)
    around = files_need_around(options, scan_input) if around is None else around
    detector = open_detector(options, weak if track else score, scan_input.mounting, around=around)
    tracker = Tracker(birth_score=births) if track else None
    writer = None
    if out is not None:
        scope = detector_scope(detector.spec, around=around)
        writer = ResultWriter(Path(out), [name for _, name in named], pictures=pictures, scope=scope)
    reporter = Reporter(progress if len(named) > 1 else None, failed)
    results: list[DetectedScan] = []
    unreadable = 0
    with writer or nullcontext(), ExitStack() as places, ExitStack() as handles:
        opened = files.open(places, handles, detector, times_ns)
        for number, (path, name) in enumerate(reporter.track(named, "Detecting")):
            try:
                scan = scan_input.read(path)
                detections = detector(scan.points)
            except (ScanError, OSError) as error:
                if len(named) == 1:
                    raise
                unreadable += 1
                reporter.remark(printable(str(error)))
                continue
            tracks = None
            if tracker is not None:
                tracks = tracker(detections, times_ns[number] * 1e-9)
                detections = cast("ScanDetections", tracks.detections)  # a part of these
            results.append(DetectedScan(path, scan.notes, detections, tracks))
            result = FrameResult(number, times_ns[number], FRAME_ID, detections, tracks)
            for file in opened:
                file.write(result, scan.points)
            try:
                if writer is not None:
                    writer(path, name, scan, detections, tracks, None if times is None else times_ns[number])
            except OSError as error:
                if error.errno != errno.ENAMETOOLONG:
                    raise
                reporter.remark(printable(str(error)))
        if not results:
            raise ScanError(f"none of the {len(named)} scans can be read")
        handles.close()  # before the names are changed
    remarks = (*scan_input.notes, *repairs(results), *([] if writer is None else writer.remarks[:1]))
    return DetectedScans(tuple(results), detector, tuple(reporter.remarks), unreadable, scan.points, remarks)


def repairs(results: Iterable[DetectedScan]) -> Iterator[str]:
    """Return what was repaired, dropped or odd, each kind once, with the first such scan and a count."""
    return repairs_of((result.path.name, result.notes, result.detections.report.warnings) for result in results)


def repairs_of(scans: Iterable[tuple[str, ScanNotes, Sequence[str]]]) -> Iterator[str]:
    """Yield `repairs` from the name of each scan, the notes of its reading, and its warnings."""
    names: dict[str, list[str]] = defaultdict(list)
    for name, notes, warnings in scans:
        texts = [*notes.remarks, *warnings]
        if notes.dropped_points:  # when the file was read; what the detector dropped is among its warnings
            texts.append(f"{notes.dropped_points} points are not finite and were dropped")
        if notes.clipped_reflectances:
            texts.append(
                f"{notes.clipped_reflectances} reflectances lie outside 0..{notes.reflectance_scale:g} and were set "
                "to the nearer end; if they are stored on another scale, state it (--reflectance-scale)"
            )
        for text in texts:
            names[_NUMBER.sub("#", text)].append(f"{name}: {text}")  # one kind: equal but for numbers
    for lines in names.values():
        yield lines[0] + (f" (and {len(lines) - 1} more scans alike)" if lines[1:] else "")
