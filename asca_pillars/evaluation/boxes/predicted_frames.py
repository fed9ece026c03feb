"""Which frame of a dataset each line of predictions belongs to: by the name of its scan's file, or by its time."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_records import NamedRecords, read_frames
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import DetectorScope, scope_from_json
from asca_pillars.data.labeled_split import LabeledSplit

_SAME_TIME_S = 1e-3
_DEEPEST = 64  # folders of a scan's path that are looked at


def predictions_by_frame(path: Path, split: LabeledSplit) -> dict[str, NamedRecords]:
    """The lines of a *.jsonl or *.csv file by the frames that they belong to; lines of other frames are left out.

    A message of a recording (a line with a time, whose scan is no file: `drive.mcap/000003`) belongs to the frame of
    its time. Its number is no frame's name: a recording may begin later than the dataset. A file belongs to the frame
    whose id is the longest end of its path; where there is none, to that of its time, if it has one.

    Raises:
        DatasetError: the file cannot be read; a line's name and time are of two frames, or its time is of several; a
            frame has two lines; no line belongs to a frame.
    """
    known, times = set(split.frame_ids), split.times_s if isinstance(split, BoxSplit) else {}
    timed_ids, stamps_s = tuple(times), np.array(list(times.values()))
    found: dict[str, NamedRecords] = {}
    for line in read_frames(path):
        frame_id = _frame_of_line(line, known, timed_ids, stamps_s)
        if frame_id in found:
            raise DatasetError(f"{line.place}: frame {frame_id} has predictions in {found[frame_id].place}; join them")
        if frame_id is not None:
            found[frame_id] = line
    if not found:
        raise DatasetError(
            f"{path}: no line belongs to a frame of {split.root} such as {min(known)}; name its scans or, for "
            "predictions of a recording, give its labels the recording's `time_s`"
        )
    return found


def stated_scope(path: Path, lines: Iterable[NamedRecords]) -> DetectorScope | None:
    """What the detector could have found, as all of the lines state it; None where that is not known.

    Lines of earlier versions state nothing; then a `recording.json` beside `path`, the file of the lines, does.

    Raises:
        DatasetError: that file cannot be read.
    """
    stated = {line.detector for line in lines}
    if stated != {None}:
        return stated.pop() if len(stated) == 1 else None
    beside = path.parent / "recording.json"
    if not beside.is_file():
        return None
    try:
        scope = scope_from_json(json.loads(beside.read_text(encoding="utf-8")))
        if scope is None:
            raise ValueError("it states no classes and ranges")
        return scope
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{beside}: cannot be read ({str(error)[:80]}); run asca detect --track again") from None


def _frame_of_line(
    line: NamedRecords, known: set[str], timed_ids: Sequence[str], stamps_s: NDArray[np.float64]
) -> str | None:
    is_message = line.time_s is not None and not PurePosixPath(line.scan).suffix
    named = None if is_message else _frame_of_scan(line.scan, known)
    if line.time_s is None:
        return named
    timed = [timed_ids[int(row)] for row in np.flatnonzero(np.abs(stamps_s - line.time_s) < _SAME_TIME_S)]
    if named is not None:
        if timed and named in timed_ids and named not in timed:
            raise DatasetError(
                f"{line.place}: {line.scan} names frame {named}, but its time_s {line.time_s:.3f} is that of "
                f"{timed[0]}; correct one of them, or leave time_s out"
            )
        return named
    if len(timed) > 1:
        raise DatasetError(
            f"{line.place}: its time_s {line.time_s:.3f} is that of {timed[0]} and {timed[1]}; list the frames that it "
            "may belong to in ImageSets/, and give --split"
        )
    return timed[0] if timed else None


def _frame_of_scan(scan: str, frame_ids: set[str]) -> str | None:
    """The frame whose id is the longest end of a scan's path; None if there is none."""
    path = PurePosixPath(scan.replace("\\", "/"))
    parts = path.with_suffix("").parts[-_DEEPEST:] if path.name else ()
    ends = ("/".join(parts[first:]) for first in range(len(parts)))
    return next((end for end in ends if end in frame_ids), None)
