"""Labels with one file per scan, matched by name: boxes as CSV or JSON, and what labelling tools' formats share."""

import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, DatasetError, OutputError
from asca_pillars.base.files import is_hidden, read_text, write_json, write_text
from asca_pillars.base.own_files import json_object, require_no_link, require_own_file
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.data.boxes.box_records import BoxRecords, read_frames, records_from
from asca_pillars.data.boxes.box_split import BoxDataset, find_frames
from asca_pillars.data.importing.formats import FORMATS, TOOLS
from asca_pillars.data.importing.imported import Imported, ImportedFrame, SkippedEntries, entry, numbers, text_of
from asca_pillars.data.yaw_units import yaw_error
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.scans.find_scans import SCAN_SUFFIXES, files_below, find_scans, natural_order
from asca_pillars.scans.scan_settings import ScanSettings


def read_box_files(labels: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every frame of a .jsonl or .csv file, or of a folder with a .json or .csv for each scan.

    Each folder of scans is a recording.

    Args:
        labels: the file or folder.
        scans: folder of the scans.
        settings: settings of the scans; labels are in the scans' own frame.

    Raises:
        ConfigError: the pose cannot be read.
        DatasetError: as `find_frames`.
    """
    dataset = dataset_settings(scans, settings)
    scans = Path(dataset.scans)
    frames = [
        ImportedFrame(frame.scan, frame.records, frame.scan.parent.relative_to(scans).as_posix(), frame.time_s)
        for frame in find_frames(labels, scans).values()
    ]
    return Imported(dataset, frames, SkippedEntries())


def dataset_settings(scans: Path, settings: ScanSettings) -> BoxDataset:
    """Return the settings of a dataset of these scans, by their absolute path.

    Raises:
        ConfigError: the pose cannot be read.
    """
    settings.stated_mounting()
    stated = to_dict(settings) | {"pose": None if settings.pose is None else str(Path(settings.pose).resolve())}
    return parse(BoxDataset, stated | {"scans": str(scans.resolve())}, "import")


WRITTEN_FILE = "prelabels.json"
"""Digests of the files written for labelling tools, so that corrected ones are not replaced."""
COMMAND = "asca detect --write"
COLORS = ("#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#42d4f4")
"""Colors of classes, for tools that need them."""
_DECIMALS = 4
_ANGLE_DECIMALS = 8  # of converted angles, so that the radians are restored to their last digit
_UPRIGHT_RAD = 0.01
_TOOL_FOLDERS = {"label", "labels", "label_2", "ann", "lidar", "pointcloud", "pointclouds", "points", "velodyne", "ds0"}
"""Folders by which tools separate scans and labels; they do not identify a scan."""


class ScanLabels(NamedTuple):
    """Scan, its path below the folder of scans without a suffix, and its boxes in the scan's own frame."""

    scan: Path
    name: Path
    records: BoxRecords


class ToolBox(NamedTuple):
    """Box in a tool's terms: class, center and size (m; length, width, height), yaw, roll and pitch (rad)."""

    kind: Any
    center: Any
    size: Any
    yaw: float
    tilt: float = 0.0
    track_id: str | None = None


Parser: TypeAlias = Callable[[str], Iterable[ToolBox]]
"""Parser of the text of a file. Raises ValueError with a clause that states the error and the remedy."""


def read_tool_labels(
    source: Path, scans: Path, settings: ScanSettings, suffix: str, parse: Parser, *, left: frozenset[str] = frozenset()
) -> Imported:
    """Read every label file below `source` with the scan of the same name. Scans without a file are left out.

    Args:
        source: a file or folder of labels.
        scans: folder of the scans.
        settings: settings of the scans; labels are in the scans' own frame.
        suffix: suffix of label files.
        parse: parser of a file's boxes.
        left: names of files without labels, in addition to those that begin with an underscore.

    Raises:
        ConfigError: the pose cannot be read.
        ScanError: there are no scans.
        DatasetError: no label file, one that is not of the format, or one that matches no scan or several.
    """
    dataset = dataset_settings(scans, settings)
    scan_of = _scans_by_name(Path(dataset.scans))
    paths = [source] if source.is_file() else sorted(files_below(source), key=natural_order)
    root = source.parent if source.is_file() else source
    skipped, frames = SkippedEntries(), []
    for path in paths:
        relative = path.relative_to(root)
        if path.suffix.lower() != suffix or is_hidden(relative) or path.name in left or path.name.startswith("_"):
            continue
        try:
            records = _records(parse(read_text(path, DatasetError)), path, skipped)
        except UnicodeDecodeError:
            raise DatasetError(f"{path}: not UTF-8 text; export the labels again") from None
        except (ValueError, RecursionError) as reason:
            raise DatasetError(f"{path}: {reason}") from None
        scan = scan_of(path, relative)
        recording = scan.parent.relative_to(dataset.scans).as_posix()
        frames.append(ImportedFrame(scan, records, recording))
    if not frames:
        raise DatasetError(f"{source}: no *{suffix} with labels there; give the folder that the tool writes them to")
    return Imported(dataset, frames, skipped)


def json_of(text: str) -> Any:
    """Parse a JSON text; ValueError with one clause."""
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"not valid JSON ({str(error)[:80]}); export the labels again") from None


def xyz(row: Any, name: str, keys: Sequence[str] = ("x", "y", "z")) -> NDArray[np.float64]:
    """Return three numbers of a nested object; ValueError if they are missing."""
    vector = entry(row, name)
    return numbers([entry(vector, key) for key in keys], 3, name)


def rounded(values: Iterable[float]) -> list[float]:
    """Return lengths and angles with the four decimals of `asca detect`."""
    return [round(float(value), _DECIMALS) for value in values]


def rounded_angle(angle: float) -> float:
    """Return a converted angle with enough decimals to restore the four of the radians."""
    return round(angle, _ANGLE_DECIMALS)


def class_names(frames: Iterable[ScanLabels]) -> list[str]:
    """Return the classes of all boxes, sorted."""
    return sorted({kind for frame in frames for kind in frame.records.types})


def write_prelabels(run_file: Path, name: str, out: Path) -> Path:
    """Write the boxes of a run as labels of a tool, and return their folder, `out`/`name`.

    Args:
        run_file: detections.jsonl of `asca detect`.
        name: name of the format.
        out: folder of the results.

    Raises:
        OutputError: a file there was changed since, or a label cannot be written in the format.
    """
    require_unchanged(out, name)
    lines = list(read_frames(run_file))
    paths = [Path(line.scan).absolute() for line in lines]
    common = Path(os.path.commonpath([path.parent for path in paths])) if paths else Path()
    named = [path.relative_to(common).with_suffix("") for path in paths]
    if twice := [path for path in paths if named.count(path.relative_to(common).with_suffix("")) > 1]:
        raise OutputError(f"{twice[0]}: another scan has the same name, and labels go by names; detect them one by one")
    labels = [ScanLabels(path, stem, line.records) for path, stem, line in zip(paths, named, lines, strict=True)]
    texts = FORMATS[name].files(labels)
    folder = out / name
    digests = {relative: hashlib.sha256(text.encode()).hexdigest() for relative, text in texts.items()}
    before = _written(out)
    known = {
        path: [*before.get(name, {}).get(path, ()), digests.get(path, "")] for path in before.get(name, {}) | digests
    }
    write_json(out / WRITTEN_FILE, before | {name: known})  # of both runs: after a kill, files of either are ours
    for relative, text in texts.items():
        (folder / relative).parent.mkdir(parents=True, exist_ok=True)
        write_text(folder / relative, text)
    for relative in known.keys() - digests.keys():
        (folder / relative).unlink(missing_ok=True)
    write_json(out / WRITTEN_FILE, before | {name: {path: [digest] for path, digest in digests.items()}})
    return folder


def require_unchanged(out: Path, name: str) -> None:
    """Make sure that pre-labels may be written to `out`/`name`: nothing there was corrected since, or added.

    Raises:
        ConfigError: no tool's format has this name.
        OutputError: names the file.
    """
    if name not in TOOLS:
        raise ConfigError(f"--write {name}: no such format; available: {', '.join(TOOLS)}")
    folder = out / name
    require_no_link(out, name)
    require_own_file(out / WRITTEN_FILE, COMMAND, json_object())
    digests = _written(out).get(name, {})
    for path in files_below(folder) if folder.exists() else ():
        if hashlib.sha256(path.read_bytes()).hexdigest() not in digests.get(path.relative_to(folder).as_posix(), ()):
            raise OutputError(
                f"{path}: was changed or added since `{COMMAND} {name}`, and may hold corrections; "
                f"import it first and move {folder} away, or give another --out"
            )


def _written(out: Path) -> dict[str, dict[str, list[str]]]:
    path = out / WRITTEN_FILE
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() and path.stat().st_size else {}


def _records(boxes: Iterable[ToolBox], path: Path, skipped: SkippedEntries) -> BoxRecords:
    rows, types, tracks = [], [], []
    for number, box in enumerate(boxes, start=1):
        try:
            types.append(text_of(box.kind, "the class"))
            center, size = numbers(box.center, 3, "the center"), numbers(box.size, 3, "the size")
            numbers([box.yaw, box.tilt], 2, "the rotation")
        except ValueError as reason:
            raise ValueError(f"box {number}: {reason}; correct it in the tool") from None
        if (why := yaw_error(box.yaw)) is not None:
            raise ValueError(f"box {number}: the yaw {why}")
        if box.tilt > _UPRIGHT_RAD:
            skipped.add("tilts", f"{path}, box {number}", f"rolled or pitched by {box.tilt:.2g} rad, read upright")
        rows.append([*center, *size, box.yaw])
        tracks.append(box.track_id)
    array = np.array(rows, np.float64).reshape(-1, 7)
    array[:, 6] = np.round(wrap_angle(array[:, 6]), _ANGLE_DECIMALS) + 0.0  # 0 instead of -1e-17 or -0
    return records_from(array, types, None, tracks)


def _scans_by_name(scans: Path) -> Callable[[Path, Path], Path]:
    """Return a function from a label file, and its path below the folder of labels, to its scan."""
    by_stem: dict[str, list[Path]] = defaultdict(list)
    for scan in find_scans(scans):
        by_stem[scan.stem].append(scan)

    def place(folder: Path) -> str:
        return "_".join(part for part in folder.parts if part not in _TOOL_FOLDERS)

    def scan_of(path: Path, relative: Path) -> Path:
        name = relative.with_suffix("")
        stem = name.stem if name.suffix.lower() in SCAN_SUFFIXES else name.name  # 000000.pcd.json, 000000.json
        candidates = by_stem.get(stem, [])
        if len(candidates) > 1:
            label_place = place(relative.parent)
            candidates = [scan for scan in candidates if place(scan.parent.relative_to(scans)) == label_place]
        if len(candidates) != 1:
            names = " and ".join(map(str, candidates[:2])) or "none"
            raise DatasetError(f"{path}: belongs to one scan {stem}.* below {scans}, there is {names}; correct --scans")
        return candidates[0]

    return scan_of


def track_numbers(frames: Iterable[ScanLabels]) -> Mapping[tuple[int, int], str]:
    """Return an identity for each box, by frame and row: that of its track, or a new one.

    Tools need one per object; those without a track get numbers above those of all tracks.
    """
    frames = list(frames)
    stated = [track for frame in frames for track in frame.records.track_ids if track is not None]
    following = max((int(track) for track in stated if track.isdecimal()), default=0) + 1
    identities: dict[tuple[int, int], str] = {}
    for number, frame in enumerate(frames):
        for row, track in enumerate(frame.records.track_ids):
            identities[number, row] = str(following) if track is None else track
            following += track is None
    return identities
