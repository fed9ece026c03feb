"""Describes scans without labels, files or a recording, and compares them with those that a model was trained on."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asca_deploy.around import ranges_around, turns_around, widen_ranges
from asca_deploy.detect_scans import repairs_of
from asca_deploy.detector import usable_points
from asca_deploy.manifest import load_bundle
from asca_deploy.recordings.results import timestamp_note
from asca_deploy.shipped import find_bundle
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.installation import require
from asca_pillars.base.progress import Progress, Reporter
from asca_pillars.data.inspection.inspect_dataset import Spread, spread
from asca_pillars.geometry.boxes import Ranges, within
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.scans.find_scans import name_scans
from asca_pillars.scans.ground_height import HeightEstimate, NamedPoints
from asca_pillars.scans.input_check import ExpectedInput, check_input, ground_z_m
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.recordings.recorded_scans import RecordedScan, RecordedScans, is_recording, open_recording
from asca_pillars.scans.recordings.recording import Topic
from asca_pillars.scans.scan_reader import Scan, ScanNotes
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings, sample_points, scale_notes

FRAMES = 500
GAP = 1.5
"""Two scans further apart than so many times the median step have a gap between them."""
_AS_TRAINED = ScanSettings()


@dataclass(frozen=True)
class ScanTimes:
    """Time stamps of a recording's scans; `missing` scans would fill the gaps at the usual rate."""

    seconds: float
    """Time from the earliest to the latest."""
    rate_hz: float | None
    """Rate by the median step; None where no two scans follow each other."""
    gaps: int
    missing: int
    longest_gap_s: float
    longest_gap_after: int
    """Number of the scan before the longest gap."""


@dataclass(frozen=True)
class ScansInspection:
    """Scans without labels.

    Attributes:
        path: file, folder or recording.
        model: name of the bundle that they are compared with.
        expected: statistics of the scans that it was trained on.
        ranges: where it looks, in its frame.
        topics: of a recording; of files none.
        topic: of the scans; None for files.
        fields: names of a point's fields, where the messages list them.
        frame_ids: of the scans' headers.
        times: None for files.
        scans: how many there are.
        inspected: how many of them were measured, evenly spaced; those that cannot be read are left out.
        points: finite points of a scan. The other measurements are None where no scan has points.
        not_finite: points that were dropped, in all scans that were measured.
        reflectance_scales: stored values that were taken as a reflectance of 1; none where there are no reflectances.
        reflectance: mean of a scan, 0..1.
        ground_z_m: height of the ground near the sensor, in the model's frame; None too where it is not seen.
        inside_share: share of a scan's points within `ranges`, 0..1.
        height: of the sensor above the ground; None if it cannot be estimated, which is then among the findings.
        notes: sentences about how a recording is read: that it was unpacked.
        findings: sentences about what is odd; those about the model's training name the option that corrects it.
        problems: sentences about scans and parts of the recording that cannot be read.
    """

    path: str
    model: str
    expected: ExpectedInput
    ranges: Ranges
    topics: tuple[Topic, ...]
    topic: str | None
    fields: tuple[str, ...]
    frame_ids: tuple[str, ...]
    times: ScanTimes | None
    scans: int
    inspected: int
    points: Spread | None
    not_finite: int
    reflectance_scales: tuple[float, ...]
    reflectance: Spread | None
    ground_z_m: Spread | None
    inside_share: Spread | None
    height: HeightEstimate | None
    notes: tuple[str, ...]
    findings: tuple[str, ...]
    problems: tuple[str, ...]


def inspect_scans(
    path: str | Path,
    *,
    topic: str | None = None,
    bundle: str | Path | None = None,
    around: bool = False,
    reading: ScanSettings = _AS_TRAINED,
    frames: int = FRAMES,
    progress: Progress | None = None,
) -> ScansInspection:
    """Measure scans and compare them with those that a model was trained on, as a detector would; it is not run.

    Args:
        path: a recording, a scan file, or a folder of these.
        topic: of a recording's scans; None: the only one.
        bundle: of the model; None: the one that ships.
        around: the model is to look in every direction.
        reading: how the files are read and the sensor was mounted.
        frames: measure so many scans, evenly spaced; of a recording the times of all are read.
        progress: called after each scan.

    Raises:
        ScanError: there are no scans, or none can be read.
        AscaError: the bundle or an option cannot be used.
    """
    path, manifest = Path(path), load_bundle(find_bundle(bundle))
    model = widen_ranges(manifest) if around else manifest
    ranges, expected = model.spec.ranges, model.expected_input
    if around:
        ranges = ranges_around(ranges, len(turns_around(ranges, camera_view=expected.camera_view)))
    reporter = Reporter(progress)
    if is_recording(path):
        source = _open_recording(path, topic, reading, frames, reporter)
    else:
        source = _open_files(path, reading, frames)
    if topic is not None and source.recorded is None:
        raise ConfigError(f"--topic {topic}: is for recordings (.mcap, .db3, .bag, .pcap); leave it out")
    mounting, height, doubt = _mounting(reading, source.samples)
    measured = _Measured(mounting, expected, ranges)
    times: list[tuple[int, int]] = []
    frame_ids: dict[str, None] = {}
    fields: tuple[str, ...] = ()
    error_texts: list[str] = []
    for scan in reporter.track(source.scans, "Inspecting", source.to_read):
        if scan.scan is None:
            error_texts.append(str(scan.error_text))
            continue
        times.append((scan.number, scan.time_ns))
        frame_ids[scan.frame_id] = None
        fields = fields or scan.fields
        if scan.number % source.step == 0:
            measured.add(source.name(scan.number), scan.scan)
    recorded = source.recorded
    damage = recorded.recording.damage if recorded else None
    if not times:
        of_topic = f" of {recorded.topic.name}" if recorded else ""
        why = f": {reason}" if (reason := next(iter(error_texts), damage)) else ""
        raise ScanError(f"{path}: none of the {source.to_read} scans{of_topic} can be read{why}")
    findings = [*source.notes, *([doubt] if doubt else []), *repairs_of(measured.notes)]
    scan_times = _scan_times(times) if recorded else None
    if scan_times is not None:
        findings += _odd_times(scan_times, [stamp for _, stamp in times])
    if len(frame_ids) > 1:
        findings.append(f"the scans are in {len(frame_ids)} frames: {', '.join(frame_ids)[:200]}")
    problems = [f"{_count(len(error_texts), 'scan')} cannot be read: {error_texts[0]}"] if error_texts else []
    return ScansInspection(
        path=str(path),
        model=model.name,
        expected=expected,
        ranges=ranges,
        topics=tuple(recorded.recording.topics) if recorded else (),
        topic=recorded.topic.name if recorded else None,
        fields=fields,
        frame_ids=tuple(filter(None, frame_ids)),
        times=scan_times,
        scans=len(times) + len(error_texts) if recorded else source.total,
        inspected=len(measured.points),
        points=spread(np.array(measured.points)),
        not_finite=sum(notes.dropped_points for _, notes, _ in measured.notes),
        reflectance_scales=tuple(
            sorted({notes.reflectance_scale for _, notes, _ in measured.notes if notes.reflectance_scale is not None})
        ),
        reflectance=spread(np.array(measured.reflectance)),
        ground_z_m=spread(np.array(measured.ground_z_m)),
        inside_share=spread(np.array(measured.inside)),
        height=height,
        notes=recorded.recording.notes if recorded else (),
        findings=tuple(findings),
        problems=(*([damage] if damage else []), *problems),
    )


class _Source(NamedTuple):
    """Scans to inspect.

    Of a recording all scans are read, and those measured whose number `step` divides; of `total` files every `step`-th
    is read. `notes` are sentences about how.
    """

    scans: Iterator[RecordedScan]
    total: int
    to_read: int
    step: int
    samples: Iterable[NamedPoints]
    notes: Sequence[str]
    name: Callable[[int], str]
    recorded: RecordedScans | None = None


def _open_recording(path: Path, topic: str | None, reading: ScanSettings, frames: int, reporter: Reporter) -> _Source:
    if reading.columns is not None:
        raise ConfigError(f"--columns {reading.columns}: is for .bin files, and a recording names its fields")
    require("recordings")
    recording = open_recording(path, reporter)
    scans = RecordedScans(recording, recording.point_cloud_topic(topic), reading.reflectance_scale)
    total, notes = scans.topic.messages, scale_notes(scans.scale)
    step = max(math.ceil(total / frames), 1)
    return _Source(scans.read(), total, total, step, scans.samples(), notes, "scan {}".format, scans)


def _open_files(path: Path, reading: ScanSettings, frames: int) -> _Source:
    paths = [scan.path for scan in name_scans([path])]
    files = ScanInput(replace(reading, sensor_height=None), paths)  # the height is estimated below in any case
    step = math.ceil(len(paths) / frames)
    chosen = range(0, len(paths), step)
    return _Source(
        scans=_read_files(paths, chosen, files),
        total=len(paths),
        to_read=len(chosen),
        step=step,
        samples=sample_points(paths, lambda one: files.read(one).points),
        notes=files.notes,
        name=lambda number: paths[number].name,
    )


def _read_files(paths: Sequence[Path], numbers: Iterable[int], scan_input: ScanInput) -> Iterator[RecordedScan]:
    for number in numbers:
        try:
            yield RecordedScan(number, 0, "", scan_input.read(paths[number]))
        except ScanError as error:
            yield RecordedScan(number, 0, "", None, str(error))


def _mounting(
    reading: ScanSettings, samples: Iterable[NamedPoints]
) -> tuple[Mounting, HeightEstimate | None, str | None]:
    """Return the mounting of `reading`, and the height estimated from the scans, or why there is none."""
    try:
        mounting, height = replace(reading, sensor_height="auto").mounting(samples)
    except ScanError as error:
        if reading.sensor_height == "auto":
            raise
        return reading.stated_mounting(), None, str(error)
    return mounting if reading.sensor_height == "auto" else reading.stated_mounting(), height, None


class _Measured:
    """Measurements of scan after scan; each list but `notes` leaves out the scans that do not have it."""

    def __init__(self, mounting: Mounting, expected: ExpectedInput, ranges: Ranges) -> None:
        self._mounting, self._expected, self._ranges = mounting, expected, ranges
        self._to_model: FrameChange = mounting.to_model(expected.sensor_height_m)
        self.points: list[int] = []
        self.reflectance: list[float] = []
        self.ground_z_m: list[float] = []
        self.inside: list[float] = []
        self.notes: list[tuple[str, ScanNotes, tuple[str, ...]]] = []

    def add(self, name: str, scan: Scan) -> None:
        """Measure one more scan."""
        points = usable_points(scan.points, self._to_model).unclipped
        warnings = check_input(points, self._ranges, self._expected, self._mounting)
        self.notes.append((name, scan.notes, tuple(warning.text for warning in warnings)))
        self.points.append(len(points))
        if not len(points):
            return
        self.reflectance.append(float(points[:, 3].mean(dtype=np.float64)))
        self.inside.append(float(within(points, self._ranges).mean()))
        if (ground := ground_z_m(points)) is not None:
            self.ground_z_m.append(ground)


def _scan_times(times: Sequence[tuple[int, int]]) -> ScanTimes:
    """Return the times from numbers and time stamps, nanoseconds, of scans in the order of the recording."""
    numbers, stamps = (np.array(column, np.int64) for column in zip(*times, strict=True))
    steps = np.diff(stamps) / 1e9
    seconds = float(stamps.max() - stamps.min()) / 1e9
    if not (steps > 0).any():
        return ScanTimes(seconds, None, 0, 0, 0.0, int(numbers[0]))
    usual_s = float(np.median(steps[steps > 0]))
    gaps = steps[steps > GAP * usual_s]
    longest = int(steps.argmax())
    missing = int((np.round(gaps / usual_s) - 1).clip(min=1).sum())
    return ScanTimes(seconds, 1 / usual_s, len(gaps), missing, float(steps[longest]), int(numbers[longest]))


def _odd_times(times: ScanTimes, stamps: Sequence[int]) -> list[str]:
    """Return sentences about stamps that go back or jump, and about gaps."""
    note = timestamp_note(stamps)
    notes = [note] if note else []
    if times.gaps:
        notes.append(
            f"{_count(times.gaps, 'gap')} in the time stamps, the longest of {times.longest_gap_s:.3g} s after scan "
            f"{times.longest_gap_after}: at the usual rate {_count(times.missing, 'scan')} more would be there"
        )
    return notes


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
