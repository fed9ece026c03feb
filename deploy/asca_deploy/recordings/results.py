"""The files that `asca detect` makes of a recording: JSON lines, KITTI's tracking text, Foxglove, rerun.

They are written from a journal, whose lines remain of a killed run and which the next one resumes from. The journal
holds the detections of every scan, to the last bit; track identities and all output files are made from it at the end,
atomically. So they are the same whether the run was killed or not. Its first line says what the results depend on; if
that differs, the journal is begun anew. Every line has a digest (`base.files`): a truncated or damaged one is dropped,
and its scan processed again.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asca_deploy.result_files import COMMAND
from asca_deploy.tracker import MAX_SCAN_GAP_S, Tracker, Tracks
from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import add_checksum, atomic_path, verify_checksum
from asca_pillars.base.locks import only_writer
from asca_pillars.base.own_files import require_no_link
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.kitti import DEFAULT_IMAGE_SIZE_WH, Calibration, labels_text, objects_from_boxes
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.frame_change import FrameChange

JOURNAL_FILE = "detections.partial.jsonl"
_LONGEST_HEAD_BYTES = 1 << 24
_KEY = "journal of asca detect"  # key of the first line, whose text is the key of the others


class ScanResult(NamedTuple):
    """Result of one message: its number, time and frame, and its detections or why it was skipped."""

    number: int
    time_ns: int
    frame_id: str
    detections: Detections | None
    error_text: str | None = None
    dropped_points: int = 0


def is_journal(path: Path) -> bool:
    """Return whether a file begins as a journal does."""
    with path.open("rb") as file:
        return verify_checksum(file.readline(_LONGEST_HEAD_BYTES), _KEY) is not None


class Journal:
    """The journal of a run in `folder`, which no other run writes into while it is open.

    Attributes:
        differs: what another run that left one here had otherwise, the first key; None if there was none.

    Raises:
        OutputError: when the block is entered, if another process works in `folder`, or a file of the journal's name
            is not a journal.
    """

    def __init__(self, folder: Path, about: dict[str, Any], class_names: tuple[str, ...]) -> None:
        self.path, self._class_names = folder / JOURNAL_FILE, class_names
        self._about = json.dumps(about)
        self._stack = ExitStack()
        self._file: IO[bytes]
        self._starts: dict[int, int] = {}  # number of a message -> where its line starts
        self._end = 0
        self.differs: str | None = None

    @property
    def done(self) -> int:
        """Number of messages in the journal."""
        return len(self._starts)

    def __contains__(self, number: int) -> bool:
        return number in self._starts

    def __enter__(self) -> "Journal":
        with ExitStack() as stack:
            stack.enter_context(only_writer(self.path.parent, COMMAND))
            require_no_link(self.path)
            if self.path.exists() and not is_journal(self.path):
                raise OutputError(
                    f"{self.path}: is not a journal of `{COMMAND}`, or damaged in its first line; delete it or move it "
                    "away, or choose another --out"
                )
            kept = self._whole_lines()
            if kept is not None:  # written anew rather than cut
                with atomic_path(self.path) as temporary, temporary.open("wb") as new:
                    new.write(add_checksum(self._about, _KEY).encode())
                    new.writelines(self._lines(kept))
                self._whole_lines()
            self._file = stack.enter_context(self.path.open("ab"))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def add(self, result: ScanResult) -> None:
        """Append a scan's result; it outlives a kill from here on."""
        detections = result.detections
        line: dict[str, Any] = {"number": result.number, "time_ns": result.time_ns, "frame_id": result.frame_id}
        if detections is None:
            line["trouble"] = result.error_text
        else:
            line |= {
                "boxes": detections.boxes.tolist(),
                "scores": detections.scores.tolist(),
                "labels": detections.labels.tolist(),
            }
            line["dropped_points"] = result.dropped_points
        content = add_checksum(json.dumps(line), self._about).encode()
        try:
            self._file.write(content)
            self._file.flush()
        except OSError as error:  # a full disk names no file
            raise OSError(error.errno, error.strerror, str(self.path)) from error
        self._starts[result.number] = self._end
        self._end += len(content)

    def results(self) -> Iterator[ScanResult]:
        """Yield all results in the order of the messages."""
        for line in self._lines([self._starts[number] for number in sorted(self._starts)]):
            text = verify_checksum(line, self._about)
            if text is None:
                raise OutputError(f"{self.path}: was changed while it was written; run the same command again")
            yield self._result(json.loads(text))

    def remove(self) -> None:
        """Delete the journal after its results have been written."""
        self.path.unlink()

    def _whole_lines(self) -> list[int] | None:
        """Find the lines that are whole and of this run.

        Returns:
            None if the journal holds nothing else; where they start if it must be written anew.
        """
        self._starts, self._end = {}, 0
        if not self.path.exists():
            return []
        with self.path.open("rb") as file:
            first = file.readline()
            before = verify_checksum(first, _KEY)
            if before != self._about:
                self.differs = _first_difference(json.loads(before or "{}"), json.loads(self._about))
                return []
            self._end, whole = len(first), True
            for line in file:
                text = verify_checksum(line, self._about)
                if text is None:
                    whole = False
                else:
                    self._starts[json.loads(text)["number"]] = self._end
                self._end += len(line)
        return None if whole else sorted(self._starts.values())

    def _lines(self, starts: list[int]) -> Iterator[bytes]:
        if not starts:
            return
        with self.path.open("rb") as file:
            for start in starts:
                file.seek(start)
                yield file.readline()

    def _result(self, line: dict[str, Any]) -> ScanResult:
        place = line["number"], line["time_ns"], line["frame_id"]
        if "trouble" in line:
            return ScanResult(*place, None, line["trouble"])
        boxes = np.array(line["boxes"], np.float32).reshape(-1, 7)
        scores, labels = np.array(line["scores"], np.float32), np.array(line["labels"], np.int64)
        return ScanResult(
            *place, Detections(boxes, scores, labels, self._class_names), dropped_points=line["dropped_points"]
        )


def _first_difference(before: dict[str, Any], about: dict[str, Any]) -> str:
    return next((key for key in about if before.get(key) != about[key]), "its content")


_MIRROR = FrameChange(np.diag([1.0, -1.0, 1.0]), np.zeros(3))


class FrameResult(NamedTuple):
    """Boxes of one scan as they are written; `tracks` is None without tracking."""

    number: int
    time_ns: int
    frame_id: str
    detections: Detections
    tracks: Tracks | None
    dropped_points: int = 0


class ResultFile(Protocol):
    """Output of results, one scan after the other."""

    def write(self, result: FrameResult, points: NDArray[np.float32] | None) -> None:
        """Write the next scan, and its points (N, 4) where some file of the run draws them."""


def track_results(
    journal: Journal, tracker: Tracker | None, pose_at: Callable[[int], NDArray[np.float64]] | None = None
) -> Iterator[FrameResult]:
    """Yield the results of a journal, in its order, with identities if there is a tracker; not those that were skipped.

    Args:
        journal: of all scans.
        tracker: a new one.
        pose_at: from a time, nanoseconds, to the (4, 4) pose of the scan, metres; None: unknown.
    """
    tracked = (
        FrameResult(result.number, result.time_ns, result.frame_id, result.detections, None, result.dropped_points)
        for result in journal.results()
        if result.detections is not None
    )
    if tracker is None:
        yield from tracked
        return
    results = list(tracked)
    for index in tracking_order([result.time_ns for result in results]):
        result = results[index]
        tracks = _track(tracker, result, None if pose_at is None else pose_at(result.time_ns))
        results[index] = result._replace(detections=tracks.detections, tracks=tracks)
    yield from results


def _track(tracker: Tracker, result: FrameResult, pose: NDArray[np.float64] | None) -> Tracks:
    """Track the next scan; mirrored, if its frame is a mirror image, as its pose is then no rotation."""
    time_s = result.time_ns * 1e-9
    if pose is None or np.linalg.det(pose[:3, :3]) > 0:
        return tracker(result.detections, time_s, pose)
    boxes = _MIRROR.boxes(result.detections.boxes)
    tracks = tracker(replace(result.detections, boxes=boxes), time_s, pose @ np.diag([1.0, -1.0, 1.0, 1.0]))
    detections = replace(tracks.detections, boxes=_MIRROR.boxes(tracks.detections.boxes))
    return Tracks(detections, tracks.track_ids, tracks.velocities_mps @ _MIRROR.axes[:2, :2])


def tracking_order(times_ns: Sequence[int]) -> list[int]:
    """Return the order in which recorded scans are tracked: by time, drive by drive.

    A scan that came late, or one wrong stamp, then ends no tracks but its own. Another drive begins where two scans lie
    more than MAX_SCAN_GAP_S before the two recorded before them, as when a clock was set or a drive is played again:
    sorted as one, such drives would mix.
    """
    times = np.array(times_ns, np.int64)
    begins = np.zeros(len(times), bool)
    if len(times) > 3:
        pairs = np.stack([times[:-1], times[1:]])
        latest, earliest = pairs.max(axis=0), pairs.min(axis=0)
        begins[2:-1] = latest[2:] < earliest[:-2] - round(MAX_SCAN_GAP_S * 1e9)
    return [int(index) for index in np.lexsort((times, np.cumsum(begins)))]


def timestamp_note(times_ns: Sequence[int]) -> str | None:
    """Return a sentence if stamps of recorded scans go back, or on by more than the pause that ends tracks."""
    steps = np.diff(np.array(times_ns, np.int64))
    back, ahead = int((steps < 0).sum()), int((steps > round(MAX_SCAN_GAP_S * 1e9)).sum())
    if not back and not ahead:
        return None
    return (
        f"of {len(times_ns)} time stamps {back} go back and {ahead} jump ahead by more than {MAX_SCAN_GAP_S:g} s: "
        "scans are tracked in the order of their times, and tracks end at such jumps"
    )


class JsonLines:
    """A line for each scan: records as `asca detect` writes them for files, with time, and with identities if any."""

    def __init__(self, file: IO[str], recording: str, scope: DetectorScope) -> None:
        self._file, self._recording, self._detector = file, recording, scope.to_json()

    def write(self, result: FrameResult, points: NDArray[np.float32] | None = None) -> None:
        """Write one line."""
        boxes = result.detections.to_dicts() if result.tracks is None else result.tracks.to_dicts()
        line = {
            "scan": f"{self._recording}/{result.number:06d}",
            "time_s": result.time_ns / 1e9,
            "time_ns": result.time_ns,
            "frame_id": result.frame_id,
            "boxes": boxes,
            "detector": self._detector,
            "points_not_finite": result.dropped_points,
        }
        self._file.write(json.dumps(line) + "\n")


class KittiTracks:
    """KITTI's tracking text: frame and identity (-1: none) before each line of what the camera sees."""

    def __init__(self, file: IO[str], calibration: Calibration) -> None:
        self._file, self._calibration = file, calibration

    def write(self, result: FrameResult, points: NDArray[np.float32] | None = None) -> None:
        """Write the lines of one scan."""
        boxes = result.detections
        objects = objects_from_boxes(boxes.boxes, boxes.names, self._calibration, DEFAULT_IMAGE_SIZE_WH, boxes.scores)
        ids = [-1] * len(objects) if result.tracks is None else result.tracks.track_ids.tolist()
        for number, item in zip(ids, objects, strict=True):
            if item.bbox[2] > item.bbox[0]:
                self._file.write(f"{result.number} {number} {labels_text([item])}")


def open_text(stack: ExitStack, path: Path) -> IO[str]:
    """Open a text file for writing; it is closed with the stack."""
    return stack.enter_context(path.open("w", encoding="utf-8"))
