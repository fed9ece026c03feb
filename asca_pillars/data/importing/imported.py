"""Frames imported from any source, and the dataset written from them (`data.boxes.box_split`).

Scans are referenced, not copied. Invalid values in tables of other programs are counted and reported.
"""

import math
import reprlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, DatasetError, OutputError
from asca_pillars.base.files import atomic_path, file_inside, write_text
from asca_pillars.base.own_files import json_lines, require_own, require_own_file, starting_with
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.data.boxes.box_records import BoxRecords, can_be_written, json_line, records_from
from asca_pillars.data.boxes.box_split import DATASET_FILE, BoxDataset, find_frames, frame_id_of
from asca_pillars.data.kitti import write_image_set
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.scans.find_scans import natural_order

_LARGEST = 1e9  # of any length or angle
_LONGEST_TEXT = 200
_QUOTE = reprlib.Repr()
_QUOTE.maxstring = _QUOTE.maxother = _QUOTE.maxlong = 60


class SkippedEntries:
    """Counts of unusable data by kind, with the reason for the first of each kind."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.first: dict[str, str] = {}

    def add(self, kind: str, place: object, reason: object) -> None:
        """Count one more.

        Args:
            kind: plural noun.
            place: its location.
            reason: why it cannot be used.
        """
        self.counts[kind] += 1
        self.first.setdefault(kind, f"{place}: {reason}")

    def lines(self) -> list[str]:
        """Return a sentence for each kind."""
        return [f"left out, {kind}: {count}, the first: {self.first[kind]}" for kind, count in self.counts.items()]


def text_of(value: Any, name: str) -> str:
    """Return a text of one line with whitespace normalized.

    Raises:
        ValueError: it is not text, empty, longer than a name, or has unprintable characters.
    """
    text = " ".join(value.split()) if isinstance(value, str) and len(value) <= _LONGEST_TEXT else ""
    if not text or not text.isprintable():
        raise ValueError(f"{name} is {_QUOTE.repr(value)}, not a name")
    return text


def whole_number(value: Any, name: str) -> int:
    """Return an integer of 64 bits.

    Raises:
        ValueError: it is not one.
    """
    number = int(value) if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None or not -(2**63) <= number < 2**63:
        raise ValueError(f"{name} is {_QUOTE.repr(value)}, not a whole number")
    return number


def numbers(values: Any, count: int | None, name: str) -> NDArray[np.float64]:
    """Return `count` numbers of a list or array (N,) in double precision; None: at least one.

    Raises:
        ValueError: the count differs, or one is not a number, not finite or of no physical size.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "iuf":
        array = values.astype(np.float64)
    elif isinstance(values, list | tuple | np.ndarray):
        plain: list[Any] = [value for value in values if isinstance(value, int | float | np.integer | np.floating)]
        usual = [float(value) for value in plain if not isinstance(value, bool) and abs(value) <= _LARGEST]
        array = np.array(usual if len(usual) == len(values) else [np.nan])
    else:
        array = np.zeros(0)
    if array.ndim != 1 or len(array) != (count or max(len(array), 1)) or not (np.abs(array) <= _LARGEST).all():
        raise ValueError(f"{name} is {_QUOTE.repr(values)}, not {count or 'some'} finite numbers")
    return array


def entry(row: Any, name: str) -> Any:
    """Return the value of a row by its name.

    Raises:
        ValueError: the row has none, or is not a row.
    """
    if not isinstance(row, dict) or name not in row:
        raise ValueError(f"no `{name}`")
    return row[name]


COMMAND = "asca import"
LABELS_FILE = "labels.jsonl"
MARKER = "# Written by `asca import`, which may replace lists and labels beside it; without this line it does not.\n"
"""First line of an import's dataset.yaml: without it, the file and its labels are taken as written by hand."""


class ImportedFrame(NamedTuple):
    """Scan, its boxes in the LiDAR frame (x forward), its recording, and its time stamp if it has one."""

    scan: Path
    records: BoxRecords
    recording: str
    time_s: float | None = None


class Imported(NamedTuple):
    """Frames of a source, the settings of its scans, and its unusable data.

    `settings.scans` is the base folder of the scans.
    """

    settings: BoxDataset
    frames: Sequence[ImportedFrame]
    skipped: SkippedEntries


class ImportCounts(NamedTuple):
    """Counts of the written frames of both lists and boxes by class, and warnings about them."""

    train: int
    val: int
    boxes: dict[str, int]
    doubt: str | None


def drop_unwritable(imported: Imported) -> Imported:
    """Return the import without boxes and frames that a dataset could not represent; they are counted.

    Line breaks and blanks at the ends are removed from names of classes.

    Raises:
        DatasetError: no frame remains, or no box is usable.
    """
    scans, skipped = Path(imported.settings.scans), imported.skipped
    frames: dict[str, ImportedFrame] = {}
    boxes = 0
    for frame in imported.frames:
        try:
            frame_id = _readable_id(frame, scans)
            if frame_id in frames:
                raise ValueError(f"{frames[frame_id].scan.name} is the same frame")
            text_of(frame.recording, "the recording")
        except ValueError as reason:
            skipped.add("frames", frame.scan, reason)
            continue
        time_s = frame.time_s if frame.time_s is not None and math.isfinite(frame.time_s) else None
        records = _usable_records(frame, skipped)
        boxes += len(records.types)
        frames[frame_id] = frame._replace(records=records, time_s=time_s)
    if not frames or (not boxes and skipped.counts.keys() - {"frames"}):
        first = next(iter(skipped.lines()), "give the folder that holds the recordings")
        raise DatasetError(f"{scans}: no {'box' if frames else 'labelled scan'} there that can be used; {first}")
    return imported._replace(frames=list(frames.values()))


def _readable_id(frame: ImportedFrame, scans: Path) -> str:
    """Return the frame's id; ValueError if a list of ids or the labels could not contain it."""
    if not frame.scan.is_relative_to(scans):
        raise ValueError(f"the scan is not below {scans}")
    name, frame_id = frame.scan.relative_to(scans).as_posix(), frame_id_of(frame.scan, scans)
    frame_id.encode()  # ids that are not valid text cannot be listed
    if "\\" in name or file_inside(scans, name) is None:
        raise ValueError(f"no scan {name[:200]!r} below {scans}")
    if frame_id.splitlines() != [frame_id.strip("\ufeff").strip()]:
        raise ValueError("blanks at the ends of its name, or a line break in it; rename it")
    return frame_id


def _usable_records(frame: ImportedFrame, skipped: SkippedEntries) -> BoxRecords:
    boxes, types, scores, track_ids = frame.records
    kept: dict[int, str] = {}
    for row, (kind, can) in enumerate(zip(types, can_be_written(boxes), strict=True)):
        try:
            name = text_of(kind, "the class")
            if not can:
                numbers = ", ".join(f"{value:g}" for value in boxes[row])
                raise ValueError(f"no box of a {name} has the center, size and yaw {numbers}")
            kept[row] = name
        except ValueError as reason:
            skipped.add("boxes", frame.scan, reason)
    rows = list(kept)
    tracks = [None if track_ids[row] is None else str(track_ids[row]) for row in rows]
    return records_from(boxes[rows], list(kept.values()), scores[rows], tracks)


def rename_types(imported: Imported, names: Mapping[str, str]) -> Imported:
    """Return the import with renamed classes; several may get one name.

    Raises:
        ConfigError: a class that no box has, or an invalid new name.
    """
    try:
        names = {old: text_of(new, "the new name") for old, new in names.items()}
    except ValueError as reason:
        raise ConfigError(f"--rename: {reason}; give a name of one line") from None
    types = {kind for frame in imported.frames for kind in frame.records.types}
    if unknown := sorted(set(names) - types):
        raise ConfigError(
            f"--rename {unknown[0]}: no box has that class; the labels have {', '.join(sorted(types)) or 'none'}"
        )
    frames = [
        frame._replace(
            records=frame.records._replace(types=tuple(names.get(kind, kind) for kind in frame.records.types))
        )
        for frame in imported.frames
    ]
    return imported._replace(frames=frames)


def require_own_dataset(out: Path, source: Path | None = None) -> None:
    """Make sure that an import may write into `out`: it is absent, empty, or holds an earlier import.

    Args:
        out: folder of the dataset.
        source: the source, which may not be the output of an earlier import.

    Raises:
        OutputError: it holds something else, such as a dataset that was written by hand.
    """
    path = out / DATASET_FILE
    is_own = starting_with(MARKER)
    if path.is_file() and not is_own(path):
        raise OutputError(
            f"{path}: `{COMMAND}` did not write it, and would replace it and the labels beside it; "
            f"give another OUT, such as {out.parent / out.resolve().name}_imported"
        )
    scans = [folder.relative_to(out) for folder in (out / "scans").glob("*/")]
    require_own(out, COMMAND, {DATASET_FILE: is_own}, folders=("ImageSets", "scans", *scans))
    require_own_file(out / LABELS_FILE, COMMAND, json_lines("scan", "boxes"), (source,))


def write_imported(out: Path, imported: Imported, val_share: float) -> ImportCounts:
    """Write dataset.yaml, labels.jsonl, and the lists train and val, which share no recording where there are several.

    Args:
        out: folder of the dataset.
        imported: frames that are `drop_unwritable`.
        val_share: share of the recordings or, of only one, of its frames that is for validation.

    Raises:
        DatasetError: the labels could not be read again; nothing that was there is replaced.
        ConfigError: the settings of the scans are impossible.
        OutputError: `out` holds something else.
    """
    scans = Path(imported.settings.scans)
    frames = sorted(
        imported.frames, key=lambda frame: (natural_order(Path(frame.recording)), natural_order(frame.scan))
    )
    require_own_dataset(out)
    usual = to_dict(BoxDataset())
    content = {key: value for key, value in to_dict(imported.settings).items() if value != usual[key]}
    settings = yaml.safe_dump(content, sort_keys=False)
    parse(BoxDataset, yaml.safe_load(settings), str(out / DATASET_FILE))
    with atomic_path(out / LABELS_FILE) as temporary:
        with temporary.open("w", encoding="utf-8") as file:
            for frame in frames:
                file.write(json_line(frame.scan.relative_to(scans).as_posix(), frame.records, frame.time_s))
        read = find_frames(temporary, scans)
        for frame in frames:
            if read.pop(frame_id_of(frame.scan, scans)).records.types != frame.records.types:
                raise DatasetError(f"{frame.scan}: its boxes cannot be read again; report this")
    train, val = _lists(frames, val_share)
    for name, part in (("train", train), ("val", val)):
        write_image_set(out, name, (frame_id_of(frame.scan, scans) for frame in part))
    write_text(out / DATASET_FILE, MARKER + settings)
    boxes = Counter(kind for frame in frames for kind in frame.records.types)
    doubt = check_yaws([frame.records.boxes[:, 6] for frame in frames])
    return ImportCounts(len(train), len(val), dict(boxes.most_common()), doubt)


def _lists(frames: list[ImportedFrame], val_share: float) -> tuple[list[ImportedFrame], list[ImportedFrame]]:
    """Return frames for training and the last recordings, or the end of the only one, for validation.

    Neighboring scans are similar, so they are not split between the lists.
    """
    recordings = list(dict.fromkeys(frame.recording for frame in frames))
    if len(recordings) > 1:
        held_out = set(recordings[len(recordings) - max(1, math.floor(val_share * len(recordings))) :])
        val = [frame for frame in frames if frame.recording in held_out]
        return [frame for frame in frames if frame.recording not in held_out], val
    if len(frames) == 1:  # both lists need a frame
        return frames, frames
    first = max(1, len(frames) - math.ceil(val_share * len(frames)))
    return frames[:first], frames[first:]
