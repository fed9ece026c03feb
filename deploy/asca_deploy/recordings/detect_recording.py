"""Detection in the scans of one topic of a recording: boxes with time stamps and identities."""

import json
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detect_scans import DetectedScan, repairs
from asca_deploy.detector import Detector
from asca_deploy.open_model import RuntimeOptions, open_detector, scans_need_around, track_thresholds
from asca_deploy.recordings.results import (
    JOURNAL_FILE,
    FrameResult,
    Journal,
    JsonLines,
    KittiTracks,
    ResultFile,
    ScanResult,
    is_journal,
    open_text,
    timestamp_note,
    track_results,
)
from asca_deploy.recordings.sequence_files import SequenceFiles
from asca_deploy.result_files import ABOUT_FILE, KITTI_FILE, RUN_FILE, remove_companions, require_own_results
from asca_deploy.tracker import Tracker
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.files import atomic_path
from asca_pillars.base.installation import require
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.data.boxes.detector_scope import DetectorScope, detector_scope
from asca_pillars.data.kitti import read_calibration
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.pictures.video import VideoView
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.recordings.images import NearestImages
from asca_pillars.scans.recordings.recorded_scans import RecordedScan, RecordedScans, open_recording, recording_files
from asca_pillars.scans.recordings.recording import topics_text
from asca_pillars.scans.scan_settings import ScanSettings
from asca_pillars.scans.transforms import Poses, read_poses

_PLAIN = RuntimeOptions()
_AS_TRAINED = ScanSettings()


@dataclass(frozen=True)
class RecordingResult:
    """Result of `detect_recording`.

    Attributes:
        scans: with results.
        boxes: number of boxes of each class in all scans.
        files: that were written; the first one is detections.jsonl.
        cpu_ms_per_scan: processor time of a scan; None if an earlier run had detected all of them.
        problems: sentences about scans that could not be read and damaged parts of the recording; empty if there were
            none.
        remarks: what was decided, repaired or odd.
    """

    scans: int
    boxes: dict[str, int]
    files: tuple[Path, ...]
    cpu_ms_per_scan: float | None
    problems: tuple[str, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Task:
    """Arguments of `detect_recording`, by the same names."""

    path: Path
    out: Path
    score: ScoreThresholds | None
    around: bool | None
    topic: str | None
    frame: str | None
    track: bool
    odometry: str | None
    calib: Path | None
    image_topic: str | None
    files: SequenceFiles


def detect_recording(
    path: str | Path,
    out: str | Path,
    *,
    topic: str | None = None,
    frame: str | None = None,
    track: bool = False,
    odometry: str | None = None,
    calib: str | Path | None = None,
    foxglove: str | Path | None = None,
    rerun: str | Path | None = None,
    image_topic: str | None = None,
    video: str | Path | None = None,
    video_view: VideoView = "above",
    options: RuntimeOptions = _PLAIN,
    reading: ScanSettings = _AS_TRAINED,
    score: ScoreThresholds | None = None,
    around: bool | None = None,
    progress: Progress | None = None,
    remark: Remark | None = None,
) -> RecordingResult:
    """Detect in every scan of a topic and write the results; what a killed run had done is not done again.

    Args:
        path: of the recording: .mcap, .db3, .bag or the folder of a rosbag2.
        out: folder for detections.jsonl and recording.json.
        topic: of the scans; None: the only one of the recording.
        frame: of the vehicle, x forward, y left, z up, such as base_link: the points are taken into it, by the
            recording's /tf_static, and so are the boxes; None: they stay in the frame of the scans.
        track: give boxes identities and velocities over time.
        odometry: with `track`, the topic of the car's poses; None: velocities are as the car sees them.
        calib: KITTI calibration, for KITTI's tracking text in `out`.
        foxglove: an .mcap to write for Foxglove.
        rerun: an .rrd to write for the rerun viewer, with the camera image nearest to each scan if there are images.
        image_topic: with `rerun`, the topic of these; None: the first one that has images.
        video: an .mp4 to write, boxes with their tracks.
        video_view: from above, or "chase" in 3D.
        options: which model runs, and how.
        reading: how the sensor was mounted.
        score: report detections from this score on, or by class; None: the thresholds of the model.
        around: detect in every direction, see `asca_deploy.around`; None: if the first scan lies all around the sensor.
        progress: called after each scan.
        remark: called with each of the result's `remarks` as soon as it is known.

    Raises:
        AscaError: something cannot be read or written; scans that cannot be read are skipped, see
            `RecordingResult.problems`.
    """
    task = _Task(
        path=Path(path),
        out=Path(out),
        score=score,
        around=around,
        topic=topic,
        frame=frame,
        track=track,
        odometry=odometry,
        calib=None if calib is None else Path(calib),
        image_topic=image_topic,
        files=SequenceFiles(
            foxglove=None if foxglove is None else Path(foxglove),
            rerun=None if rerun is None else Path(rerun),
            video=None if video is None else Path(video),
            video_view=video_view,
        ),
    )
    return _detect(task, reading, options, Reporter(progress, remark))


def _detect(task: _Task, reading: ScanSettings, options: RuntimeOptions, reporter: Reporter) -> RecordingResult:
    require("recordings")
    task.files.check((task.path, task.calib))
    calibration = None if task.calib is None else read_calibration(task.calib)
    require_own_results(task.out, {JOURNAL_FILE: is_journal})
    recording = open_recording(task.path, reporter)
    topic = recording.point_cloud_topic(task.topic)
    if task.odometry is not None and not task.track:
        raise ConfigError(f"--odometry {task.odometry}: is for tracks; give --track, too")
    if task.image_topic is not None and task.files.rerun is None:
        raise ConfigError(f"--image-topic {task.image_topic}: is shown in the file of --rerun; give that, too")
    if task.frame is not None and (reading.pose is not None or reading.axes != "x-forward"):
        raise ConfigError(f"--frame {task.frame}: says how the scans lie already; leave --axes and --pose out")
    poses = None if task.odometry is None else read_poses(recording, task.odometry)
    damages = set() if poses is None else {recording.damage}
    scans = RecordedScans(recording, topic, reading.reflectance_scale, task.frame)
    topic = scans.topic
    mounting, remarks = scans.mounting(reading)
    around = scans_need_around(options, mounting, scans.samples(), remarks) if task.around is None else task.around
    images = None if task.files.rerun is None else NearestImages(recording, task.image_topic)
    if images is not None and images.topic is not None and images.others:
        remarks.append(f"images: of {images.topic.name}; --image-topic takes others of {topics_text(images.others)}")
    for line in remarks:
        reporter.remark(line)
    births, weak = track_thresholds(options.bundle, task.score)
    least = weak if task.track else task.score
    detector = open_detector(options, least, mounting, around=around)
    about = _about(task, reading, mounting, detector, topic.name, least, around=around)
    with Journal(task.out, about, detector.spec.class_names) as journal:
        if journal.done:
            reporter.remark(f"resuming after the {journal.done} scans that {journal.path} holds")
        if journal.differs:
            reporter.remark(f"beginning anew: another run was killed here, with another {journal.differs}")
        start = process_time()
        run = _Run(detector, scans, journal)
        for _ in reporter.track(run.results(), "Detecting", topic.messages, journal.done):
            pass
        seconds = process_time() - start
        tracker = Tracker(birth_score=births) if task.track else None
        damages.add(recording.damage)
        times_ns = [result.time_ns for result in journal.results() if result.detections is not None]
        if not times_ns:
            why = run.first() or (f": {recording.damage}" if recording.damage else "")
            raise ScanError(f"{task.path}: none of the {topic.messages} scans of {topic.name} can be read{why}")
        if task.track:
            _check_times(times_ns, task, topic.name, poses, reporter)
        pose_at = None if poses is None else partial(_pose_of_scan, poses, mounting)
        results = _with_points(track_results(journal, tracker, pose_at), scans if task.files.show_points else None)
        opened = partial(task.files.open, detector=detector, times_ns=times_ns, pose_at=pose_at, images=images)
        scope = detector_scope(detector.spec, around=around)
        written, classes = _write(task, results, calibration, scope, about, opened)
        journal.remove()
    for line in (*repairs(run.kept), *(() if images is None else images.remarks())):
        reporter.remark(line)
    kitti = [] if task.calib is None else [task.out / KITTI_FILE]
    return RecordingResult(
        written,
        {name: classes[name] for name in detector.spec.class_names},
        (task.out / RUN_FILE, *kitti, *task.files.paths),
        1e3 * seconds / len(run.kept) if run.kept else None,
        (*sorted(filter(None, damages)), *run.skipped()),
        tuple(reporter.remarks),
    )


class _Run:
    """Detection of the scans that the journal does not hold yet."""

    def __init__(self, detector: Detector, scans: RecordedScans, journal: Journal) -> None:
        self._detector, self._scans, self._journal = detector, scans, journal
        self._coming: deque[RecordedScan] = deque()
        self.error_texts = (
            [result.error_text for result in journal.results() if result.error_text] if journal.done else []
        )
        self.kept: list[DetectedScan] = []

    def results(self) -> Iterator[None]:
        """Yield one item for each scan that is in the journal now."""
        for detections in self._detector.stream(self._points()):
            yield from self._skip()
            scan = self._coming.popleft()
            assert scan.scan is not None, "only scans that could be read are streamed"
            self._journal.add(
                ScanResult(
                    scan.number,
                    scan.time_ns,
                    scan.frame_id,
                    detections,
                    dropped_points=scan.scan.dropped_points + detections.report.non_finite_points,
                )
            )
            where = self._scans.recording.path / str(scan.number)
            self.kept.append(DetectedScan(where, scan.scan.notes, detections))
            yield
        yield from self._skip()

    def first(self) -> str:
        """Return the first reason why a scan was skipped, as the end of a sentence."""
        return f": {self.error_texts[0]}" if self.error_texts else ""

    def skipped(self) -> list[str]:
        """Return a sentence on skipped scans, if there are any."""
        return [f"{len(self.error_texts)} scans were skipped{self.first()}"] if self.error_texts else []

    def _points(self) -> Iterator[NDArray[np.float32]]:
        first = next(number for number in count() if number not in self._journal)
        for recorded in self._scans.read(first):
            if recorded.number in self._journal:
                continue
            self._coming.append(recorded)
            if recorded.scan is not None:
                yield recorded.scan.points

    def _skip(self) -> Iterator[None]:
        """Note the scans before the next one that could be read."""
        while self._coming and self._coming[0].scan is None:
            recorded = self._coming.popleft()
            self.error_texts.append(str(recorded.error_text))
            self._journal.add(
                ScanResult(recorded.number, recorded.time_ns, recorded.frame_id, None, recorded.error_text)
            )
            yield


def _check_times(times: Sequence[int], task: _Task, topic: str, poses: Poses | None, reporter: Reporter) -> None:
    """Report stamps out of order or too short odometry; ScanError if the odometry is of another time."""
    if stamps := timestamp_note(times):
        reporter.remark(f"{task.path}, {topic}: {stamps}")
    if poses is None:
        return
    outside = [time for time in times if not poses.covers(time)]
    if not outside:
        return
    began, ended = ((int(poses.times_ns[end]) - min(times)) / 1e9 for end in (0, -1))
    share = f"{len(outside)} of {len(times)} scans"
    covered = f"{task.path}, {task.odometry}: poses from {began:+.1f} to {ended:+.1f} s of the first scan; {share}"
    if len(outside) == len(times):
        raise ScanError(f"{covered} are at other times, as of another clock; leave --odometry out")
    reporter.remark(f"{covered} lie outside, with wrong velocities over ground")


def _about(
    task: _Task,
    reading: ScanSettings,
    mounting: Mounting,
    detector: Detector,
    topic: str,
    least: ScoreThresholds | None,
    *,
    around: bool,
) -> dict[str, Any]:
    """Return all that detections depend on; a journal is only resumed if it is the same."""
    files = recording_files(task.path)
    return {
        "recording": str(task.path),
        "files": [[file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in files],
        "topic": topic,
        "frame": task.frame,
        "made_by": detector.made_by,
        "model": {name: graph.sha256 for name, graph in detector.bundle.graphs.items()},
        "runs_on": detector.runs_on,
        **detector_scope(detector.spec, around=around).to_json(),
        "score": least,
        "around": around,
        "mounting": to_dict(mounting),  # content of the files that `reading` names
        "reading": {name: None if value is None else str(value) for name, value in asdict(reading).items()},
    }


def _pose_of_scan(poses: Poses, mounting: Mounting, time_ns: int) -> NDArray[np.float64]:
    """Return the pose of the scan, turned to x forward as the odometry's axes, in the fixed frame."""
    level = np.eye(4)
    level[:3, :3], level[:3, 3] = mounting.level.axes, mounting.level.shift_m
    return np.asarray(poses.at(time_ns) @ level)


def _with_points(
    results: Iterator[FrameResult], scans: RecordedScans | None
) -> Iterator[tuple[FrameResult, NDArray[np.float32] | None]]:
    """Yield each result with the points of its scan, which is read once more; None without `scans`."""
    again = iter(()) if scans is None else scans.read()
    for result in results:
        points = (other.scan.points for other in again if other.number == result.number and other.scan is not None)
        yield result, None if scans is None else next(points)


def _write(
    task: _Task,
    results: Iterator[tuple[FrameResult, NDArray[np.float32] | None]],
    calibration: Any,
    scope: DetectorScope,
    about: dict[str, Any],
    opened: Callable[[ExitStack, ExitStack], list[ResultFile]],
) -> tuple[int, Counter[str]]:
    """Write all files, none of which appears before all are complete; return the counts of scans and boxes by class."""
    with ExitStack() as places, ExitStack() as handles:
        place = places.enter_context(atomic_path(task.out / ABOUT_FILE))
        place.write_text(json.dumps(about | {"tracks": task.track}, indent=1) + "\n", encoding="utf-8")
        text = places.enter_context(atomic_path(task.out / RUN_FILE))
        files: list[ResultFile] = [JsonLines(open_text(handles, text), task.path.name, scope)]
        if calibration is not None:
            kitti = places.enter_context(atomic_path(task.out / KITTI_FILE))
            files.append(KittiTracks(open_text(handles, kitti), calibration))
        files += opened(places, handles)
        scans_written = 0
        classes: Counter[str] = Counter()
        for result, points in results:
            scans_written += 1
            classes.update(result.detections.names)
            for file in files:
                file.write(result, points)
        handles.close()  # before the names are changed
    remove_companions(task.out, [ABOUT_FILE, *([] if calibration is None else [KITTI_FILE])])
    return scans_written, classes
