"""The files that `asca detect` makes of a recording: JSON lines, KITTI's tracking text, Foxglove, rerun."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asca_deploy.recordings.journal import Journal
from asca_deploy.tracker import MAX_SCAN_GAP_S, Tracker
from asca_deploy.tracks import Tracks
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.kitti import DEFAULT_IMAGE_SIZE_WH, Calibration, labels_text, objects_from_boxes
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.frame_change import FrameChange

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

    def write(self, found: FrameResult, points: NDArray[np.float32] | None) -> None:
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
    found = (
        FrameResult(one.number, one.time_ns, one.frame_id, one.detections, None, one.dropped_points)
        for one in journal.results()
        if one.detections is not None
    )
    if tracker is None:
        yield from found
        return
    results = list(found)
    for index in tracking_order([one.time_ns for one in results]):
        one = results[index]
        tracks = _track(tracker, one, None if pose_at is None else pose_at(one.time_ns))
        results[index] = one._replace(detections=tracks.detections, tracks=tracks)
    yield from results


def _track(tracker: Tracker, found: FrameResult, pose: NDArray[np.float64] | None) -> Tracks:
    """Track the next scan; mirrored, if its frame is a mirror image, as its pose is then no rotation."""
    time_s = found.time_ns * 1e-9
    if pose is None or np.linalg.det(pose[:3, :3]) > 0:
        return tracker(found.detections, time_s, pose)
    boxes = _MIRROR.boxes(found.detections.boxes)
    tracks = tracker(replace(found.detections, boxes=boxes), time_s, pose @ np.diag([1.0, -1.0, 1.0, 1.0]))
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

    def write(self, found: FrameResult, points: NDArray[np.float32] | None = None) -> None:
        """Write one line."""
        boxes = found.detections.to_dicts() if found.tracks is None else found.tracks.to_dicts()
        line = {
            "scan": f"{self._recording}/{found.number:06d}",
            "time_s": found.time_ns / 1e9,
            "time_ns": found.time_ns,
            "frame_id": found.frame_id,
            "boxes": boxes,
            "detector": self._detector,
            "points_not_finite": found.dropped_points,
        }
        self._file.write(json.dumps(line) + "\n")


class KittiTracks:
    """KITTI's tracking text: frame and identity (-1: none) before each line of what the camera sees."""

    def __init__(self, file: IO[str], calibration: Calibration) -> None:
        self._file, self._calibration = file, calibration

    def write(self, found: FrameResult, points: NDArray[np.float32] | None = None) -> None:
        """Write the lines of one scan."""
        boxes = found.detections
        objects = objects_from_boxes(boxes.boxes, boxes.names, self._calibration, DEFAULT_IMAGE_SIZE_WH, boxes.scores)
        ids = [-1] * len(objects) if found.tracks is None else found.tracks.track_ids.tolist()
        for number, item in zip(ids, objects, strict=True):
            if item.bbox[2] > item.bbox[0]:
                self._file.write(f"{found.number} {number} {labels_text([item])}")


def open_text(stack: ExitStack, path: Path) -> IO[str]:
    """Open a text file for writing; it is closed with the stack."""
    return stack.enter_context(path.open("w", encoding="utf-8"))
