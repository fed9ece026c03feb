"""What an import reads of any source, and the dataset that it writes of it (`data.boxes.box_split`).

Nothing is copied that can be referred to.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from asca_pillars.data.boxes.box_frames import DATASET_FILE, frame_id_of
from asca_pillars.data.boxes.box_records import BoxRecords, json_line
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.kitti import write_image_set
from asca_pillars.data.scans.find_scans import natural_order
from asca_pillars.errors import ConfigError, DatasetError, OutputError
from asca_pillars.files import atomic_path, write_text
from asca_pillars.own_files import json_lines, require_own, require_own_file, starting_with
from asca_pillars.schema import to_dict

COMMAND = "asca import"
LABELS_FILE = "labels.jsonl"
MARKER = "# Written by `asca import`, which may replace lists and labels beside it; without this line it does not.\n"
"""First line of the dataset.yaml of an import: others are written by hand, and so may be the labels beside them."""


class ImportedFrame(NamedTuple):
    """A scan, its boxes in the LiDAR frame (x forward), its recording, and its time stamp if it has one."""

    scan: Path
    records: BoxRecords
    recording: str
    time_s: float | None = None


class Imported(NamedTuple):
    """The frames of a source, and how its scans are to be read; `settings.scans` is the folder that they are below."""

    settings: BoxDataset
    frames: Sequence[ImportedFrame]


Importer = Callable[[Path], Imported]
"""From the source's folder."""


class ImportCounts(NamedTuple):
    """What was written: frames of both lists, and boxes by class."""

    train: int
    val: int
    boxes: dict[str, int]


def renamed(imported: Imported, names: Mapping[str, str]) -> Imported:
    """The same with classes of other names; several may get one name.

    Raises:
        ConfigError: a class that no box has.
    """
    there = {kind for frame in imported.frames for kind in frame.records.types}
    if unknown := sorted(set(names) - there):
        raise ConfigError(
            f"--rename {unknown[0]}: no box has that class; there are {', '.join(sorted(there)) or 'none'}"
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
        source: what is imported; it may not be what an earlier import wrote there.

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

    Raises:
        DatasetError: there is no frame.
        OutputError: `out` holds something else.
    """
    scans = Path(imported.settings.scans)
    frames = sorted(
        imported.frames, key=lambda frame: (natural_order(Path(frame.recording)), natural_order(frame.scan))
    )
    if not frames:
        raise DatasetError(f"{scans}: no labelled scan there; give the folder that holds the recordings")
    require_own_dataset(out)
    with atomic_path(out / LABELS_FILE) as temporary, temporary.open("w", encoding="utf-8") as file:
        for frame in frames:
            file.write(json_line(frame.scan.relative_to(scans).as_posix(), frame.records, frame.time_s))
    train, val = _lists(frames, val_share)
    for name, own in (("train", train), ("val", val)):
        write_image_set(out, name, (frame_id_of(frame.scan, scans) for frame in own))
    usual = to_dict(BoxDataset())
    content = {key: value for key, value in to_dict(imported.settings).items() if value != usual[key]}
    write_text(out / DATASET_FILE, MARKER + yaml.safe_dump(content, sort_keys=False))
    boxes = Counter(kind for frame in frames for kind in frame.records.types)
    return ImportCounts(len(train), len(val), dict(boxes.most_common()))


def _lists(frames: list[ImportedFrame], val_share: float) -> tuple[list[ImportedFrame], list[ImportedFrame]]:
    """The last recordings for validation, or the end of the only one: neighboring scans look alike."""
    recordings = list(dict.fromkeys(frame.recording for frame in frames))
    if len(recordings) > 1:
        held_out = set(recordings[len(recordings) - max(1, math.floor(val_share * len(recordings))) :])
        val = [frame for frame in frames if frame.recording in held_out]
        return [frame for frame in frames if frame.recording not in held_out], val
    if len(frames) == 1:  # both lists need a frame
        return frames, frames
    first = max(1, len(frames) - math.ceil(val_share * len(frames)))
    return frames[:first], frames[first:]
