"""The files that `asca detect` makes of a recording: JSON lines, KITTI's tracking text, Foxglove, rerun."""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asca_deploy import Detections
from asca_deploy.tracker import Tracker
from asca_deploy.tracks import Tracks
from asca_pillars.commands.recording_journal import Journal
from asca_pillars.data.kitti import DEFAULT_IMAGE_SIZE_WH, Calibration, labels_text, objects_from_boxes


class Found(NamedTuple):
    """The boxes of one scan as they are written; `tracks` is None where nobody asked for identities."""

    number: int
    time_ns: int
    frame_id: str
    detections: Detections
    tracks: Tracks | None
    dropped_points: int = 0


class ResultFile(Protocol):
    """Something that results are written to, one scan after the other."""

    def write(self, found: Found) -> None:
        """The next scan."""


def tracked(
    journal: Journal, tracker: Tracker | None, pose_at: Callable[[int], NDArray[np.float64]] | None = None
) -> Iterator[Found]:
    """The results of a journal, with identities if there is a tracker; scans that could not be read are left out.

    Args:
        journal: of all scans.
        tracker: a new one.
        pose_at: from a time, nanoseconds, to the (4, 4) pose of the scan, metres; None: unknown.
    """
    for result in journal.results():
        if result.detections is None:
            continue
        place = result.number, result.time_ns, result.frame_id
        if tracker is None:
            yield Found(*place, result.detections, None, result.dropped_points)
        else:
            pose = None if pose_at is None else pose_at(result.time_ns)
            tracks = tracker(result.detections, result.time_ns * 1e-9, pose)
            yield Found(*place, tracks.detections, tracks, result.dropped_points)


class JsonLines:
    """A line for each scan: records as `asca detect` writes them for files, with time, and with identities if any."""

    def __init__(self, file: IO[str], recording: str) -> None:
        self._file, self._recording = file, recording

    def write(self, found: Found) -> None:
        """One line."""
        boxes = found.detections.to_dicts() if found.tracks is None else found.tracks.to_dicts()
        line = {
            "scan": f"{self._recording}/{found.number:06d}",
            "time_s": found.time_ns / 1e9,
            "time_ns": found.time_ns,
            "frame_id": found.frame_id,
            "boxes": boxes,
            "points_not_finite": found.dropped_points,
        }
        self._file.write(json.dumps(line) + "\n")


class KittiTracks:
    """KITTI's tracking text: frame and identity (-1: none) before each line of what the camera sees."""

    def __init__(self, file: IO[str], calibration: Calibration) -> None:
        self._file, self._calibration = file, calibration

    def write(self, found: Found) -> None:
        """The lines of one scan."""
        boxes = found.detections
        objects = objects_from_boxes(boxes.boxes, boxes.names, self._calibration, DEFAULT_IMAGE_SIZE_WH, boxes.scores)
        ids = [-1] * len(objects) if found.tracks is None else found.tracks.track_ids.tolist()
        for number, item in zip(ids, objects, strict=True):
            if item.bbox[2] > item.bbox[0]:
                self._file.write(f"{found.number} {number} {labels_text([item])}")


def open_text(stack: ExitStack, path: Path) -> IO[str]:
    """A text file to write that is closed with the stack."""
    return stack.enter_context(path.open("w", encoding="utf-8"))
