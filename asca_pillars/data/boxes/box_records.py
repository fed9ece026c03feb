"""Boxes as JSON and CSV records: detections of `asca detect`, own labels, and predictions of other programs.

A record has a class and seven numbers, in the LiDAR frame (x forward, y left, z up):

    class, x_m, y_m, z_m (of the box's center), length_m, width_m, height_m, yaw_rad (counter-clockwise from x)

and may have a `score` and a `track_id`; other keys are ignored. The unit may be left out of a name (`x`, `yaw`). Three
types of files hold records:

    *.jsonl  a line for each frame: {"scan": "scans/000000.bin", "boxes": [record, ...], ...}
    *.json   one frame: {"boxes": [record, ...], ...}
    *.csv    a record in each row below a line of names; a column `scan` if it holds more than one frame
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import read_text
from asca_pillars.data.boxes.detector_scope import DetectorScope, scope_from_json
from asca_pillars.data.yaw_units import LARGEST_YAW_RAD, yaw_error
from asca_pillars.geometry.boxes import wrap_angle

FIELDS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
_SHORT = {name.rpartition("_")[0]: name for name in FIELDS}
_TOO_LARGE = 1e6  # for any number, metres
_DECIMALS = 4  # in written files
_LAST_TIME_S = 1e18  # beyond int64's nanoseconds


class BoxRecords(NamedTuple):
    """N records of one frame.

    `boxes` (N, 7) float32, LiDAR frame; `types` class of each; `scores` (N,) float32, NaN where a record has none;
    `track_ids` None where a record has none.
    """

    boxes: NDArray[np.float32]
    types: tuple[str, ...]
    scores: NDArray[np.float32]
    track_ids: tuple[str | None, ...]


class NamedRecords(NamedTuple):
    """Records of a frame, the stated path of its scan, and their place in the file: FILE:LINE.

    `time_s` is the frame's time stamp, `detector` the scope of the detector; None if a line does not state it.
    """

    scan: str
    records: BoxRecords
    place: str
    time_s: float | None = None
    detector: DetectorScope | None = None


def read_frames(path: Path) -> Iterator[NamedRecords]:
    """Yield the frames of a *.jsonl or *.csv file, in the order in which they first appear.

    Raises:
        DatasetError: the file cannot be read, or a record is invalid; names file, line, value and remedy.
    """
    if path.suffix.lower() == ".jsonl":
        yield from _json_lines(path)
    elif path.suffix.lower() == ".csv":
        rows: dict[str, list[tuple[str, Mapping[str, Any]]]] = {}
        for place, row in _csv_rows(path):
            if not row.get("scan"):
                raise DatasetError(
                    f"{place}: no `scan`; a file for several frames says in each row which scan it is of"
                )
            rows.setdefault(row["scan"], []).append((place, row))
        for scan, placed in rows.items():
            yield NamedRecords(scan, _records(placed), placed[0][0])
    else:
        raise DatasetError(f"{path}: labels of several frames are .jsonl or .csv; rename or convert the file")


def read_frame_file(path: Path) -> BoxRecords:
    """Read the records of a *.json or *.csv file of one frame; an empty .csv is a frame without objects.

    Raises:
        DatasetError: as `read_frames`.
    """
    if path.suffix.lower() == ".csv":
        return _records(_csv_rows(path))
    content = _parsed(_text(path), str(path))
    return _json_records(content, str(path))


def read_time(path: Path) -> float | None:
    """Read the time stamp `time_s`, seconds, of a *.json file of one frame; None if it has none, as a .csv.

    Raises:
        DatasetError: the file cannot be read.
    """
    return None if path.suffix.lower() == ".csv" else _time_s(_parsed(_text(path), str(path)))


def records_from(
    boxes: NDArray[np.floating],
    types: Sequence[str],
    scores: Sequence[float] | NDArray[np.floating] | None = None,
    track_ids: Sequence[str | None] | None = None,
) -> BoxRecords:
    """Return records of arrays of boxes (N, 7), metres and radians."""
    count = len(types)
    return BoxRecords(
        np.asarray(boxes, np.float32).reshape(count, 7),
        tuple(types),
        np.full(count, np.nan, np.float32) if scores is None else np.asarray(scores, np.float32),
        (None,) * count if track_ids is None else tuple(track_ids),
    )


def json_line(
    scan: str, records: BoxRecords, time_s: float | None = None, detector: DetectorScope | None = None
) -> str:
    """Return the line of a scan for a *.jsonl file, with line break, time stamp and detector."""
    boxes = []
    for box, kind, score, track_id in zip(*records, strict=True):
        record: dict[str, Any] = {"class": kind}
        record |= {name: round(float(value), _DECIMALS) for name, value in zip(FIELDS, box, strict=True)}
        if not math.isnan(score):
            record["score"] = round(float(score), _DECIMALS)
        if track_id is not None:
            record["track_id"] = track_id
        boxes.append(record)
    line: dict[str, Any] = {"scan": scan}
    if time_s is not None:
        line["time_s"] = time_s
    line["boxes"] = boxes
    if detector is not None:
        line["detector"] = detector.to_json()
    return json.dumps(line) + "\n"


def can_be_written(boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the mask of the boxes (N, 7), metres and radians, whose output by `json_line` can be read again."""
    written = np.round(np.asarray(boxes, np.float64), _DECIMALS)
    within = (np.abs(written) < _TOO_LARGE).all(axis=1)  # False where a number is not finite
    return np.asarray(within & (written[:, 3:6] > 0).all(axis=1) & (np.abs(written[:, 6]) <= LARGEST_YAW_RAD))


def _json_lines(path: Path) -> Iterator[NamedRecords]:
    for number, line in enumerate(io.StringIO(_text(path)), start=1):  # text within JSON may contain other line breaks
        if not line.strip():
            continue
        place = f"{path}:{number}"
        content = _parsed(line, place)
        scan = content.get("scan") if isinstance(content, dict) else None
        if not isinstance(scan, str) or not scan:
            raise DatasetError(f'{place}: no "scan"; a line is {{"scan": "NAME.bin", "boxes": [...]}}')
        detector = scope_from_json(content.get("detector"))
        yield NamedRecords(scan, _json_records(content, place), place, _time_s(content), detector)


def _time_s(content: Any) -> float | None:
    time_s = content.get("time_s") if isinstance(content, dict) else None
    if isinstance(time_s, bool) or not isinstance(time_s, int | float):
        return None
    return float(time_s) if abs(time_s) < _LAST_TIME_S else None  # compared, because an integer may exceed any float


def _json_records(content: Any, place: str) -> BoxRecords:
    boxes = content.get("boxes") if isinstance(content, dict) else None
    if (remedy := _of_other_tool(content)) is not None:
        raise DatasetError(f"{place}: {remedy}")
    if not isinstance(boxes, list):
        raise DatasetError(f'{place}: no list "boxes"; a frame without objects has "boxes": []')
    return _records((f"{place}, box {number}", box) for number, box in enumerate(boxes, start=1))


def _of_other_tool(content: Any) -> str | None:
    """Return advice for the file of a known labelling tool; None for other files."""
    if isinstance(content, dict) and "boxes" not in content and isinstance(content.get("objects"), list):
        tool = ("Supervisely", "supervisely") if "figures" in content else ("labelCloud", "labelcloud")
    elif isinstance(content, list) and content and all(isinstance(item, dict) and "psr" in item for item in content):
        tool = ("SUSTechPOINTS", "sustechpoints")
    else:
        return None
    return f"labels of {tool[0]}; read them with `asca import LABELS OUT --from {tool[1]} --scans SCANS`"


def _csv_rows(path: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    text = _text(path)
    if not text.strip():
        return
    reader = csv.reader(io.StringIO(text, newline=None), skipinitialspace=True)
    cells_of_rows = _cells(reader, path)
    names = [name.strip() for name in next(cells_of_rows, [])]
    if len(names) == 1 and ";" in names[0]:
        raise DatasetError(f"{path}:1: columns are separated by semicolons; separate them by commas")
    if twice := [name for name in names if names.count(name) > 1]:
        raise DatasetError(f"{path}:1: the column `{twice[0]}` is there twice; remove one")
    for cells in cells_of_rows:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(names):
            raise DatasetError(
                f"{path}:{reader.line_num}: {len(cells)} values for {len(names)} columns; correct the row"
            )
        values = {name: cell.strip() for name, cell in zip(names, cells, strict=True)}
        yield f"{path}:{reader.line_num}", {name: value for name, value in values.items() if value}


def _cells(reader: Any, path: Path) -> Iterator[list[str]]:
    try:
        yield from reader
    except csv.Error as error:
        raise DatasetError(f"{path}:{reader.line_num}: not valid CSV ({error}); close the quotes") from None


def _records(placed: Iterable[tuple[str, Any]]) -> BoxRecords:
    boxes, types, scores, track_ids = [], [], [], []
    for place, record in placed:
        if not isinstance(record, Mapping):
            raise DatasetError(
                f"{place}: {str(record)[:40]} is not a record; write an object with `class` and {_listed()}"
            )
        kind = record.get("class")
        if not isinstance(kind, str) or not kind.strip():
            raise DatasetError(f"{place}: no `class`; name what is in the box")
        full = {_SHORT.get(name, name): value for name, value in record.items()}
        if len(full) < len(record):
            short = next(name for name in record if _SHORT.get(name, name) in record and name in _SHORT)
            raise DatasetError(f"{place}: both `{short}` and `{_SHORT[short]}`; remove one")
        if missing := [name for name in FIELDS if name not in full]:
            raise DatasetError(f"{place}: no `{missing[0]}`; a box has `class`, {_listed()}")
        box = [_number(full[name], name, place) for name in FIELDS]
        for name, size in zip(FIELDS[3:6], box[3:6], strict=True):
            if size <= 0:
                raise DatasetError(f"{place}: {name} is {size:g}; a box has a positive size: correct or remove it")
        if (reason := yaw_error(box[6])) is not None:
            raise DatasetError(f"{place}: yaw_rad {reason}")
        boxes.append(box)
        types.append(kind.strip())
        scores.append(_number(full["score"], "score", place) if full.get("score") is not None else math.nan)
        track_id = full.get("track_id")
        track_ids.append(None if track_id is None else str(track_id))
    array = np.array(boxes, np.float64).reshape(-1, 7)
    array[:, 6] = wrap_angle(array[:, 6])
    return records_from(array, types, scores, track_ids)


def _listed() -> str:
    return ", ".join(FIELDS)


def _number(value: Any, name: str, place: str) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) < _TOO_LARGE:
        raise DatasetError(f"{place}: {name} is {str(value)[:40]!r}, not a usable number; correct or remove the box")
    return number


def _text(path: Path) -> str:
    try:
        return read_text(path, DatasetError)  # spreadsheets write a byte order mark before the first name
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); correct the path") from None


def _parsed(text: str, place: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{place}: not valid JSON ({str(error)[:80]}); correct it") from None
