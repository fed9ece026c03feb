"""Labels of a scan as lines of text: OpenPCDet's custom datasets, and KITTI's fields without a camera.

    OpenPCDet   x y z dx dy dz heading class; https://github.com/open-mmlab/OpenPCDet, docs/CUSTOM_DATASET_TUTORIAL.md
    KITTI       type truncated occluded alpha left top right bottom height width length x y z yaw [score]

KITTI's labels are in the camera's frame and need a calibration. Without one, tools write the center of the box
and its yaw in the LiDAR's frame into the same fields (`kitti_untransformed` of labelCloud). Both use radians.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import OutputError
from asca_pillars.data.importing.imported import Imported
from asca_pillars.data.importing.tool_labels import ScanLabels, ToolBox, read_tool_labels, rounded
from asca_pillars.scans.scan_settings import ScanSettings

_OPENPCDET_FIELDS = 8
_KITTI_FIELDS = 15
_NO_OBJECT = "DontCare"


def read_openpcdet(source: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every label file below `source`; see `read_tool_labels`."""

    def parse(text: str) -> Iterable[ToolBox]:
        for number, fields in _lines(text):
            if len(fields) != _OPENPCDET_FIELDS:
                raise ValueError(f"line {number}: {len(fields)} fields, not x y z dx dy dz heading class; correct it")
            x, y, z, dx, dy, dz, yaw = _floats(fields[:7], number)
            yield ToolBox(fields[7], [x, y, z], [dx, dy, dz], yaw)

    return read_tool_labels(source, scans, settings, ".txt", parse)


def read_kitti_no_camera(source: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every label file below `source`; see `read_tool_labels`."""

    def parse(text: str) -> Iterable[ToolBox]:
        for number, fields in _lines(text):
            if len(fields) not in (_KITTI_FIELDS, _KITTI_FIELDS + 1):
                raise ValueError(f"line {number}: {len(fields)} fields, KITTI's have {_KITTI_FIELDS}; correct it")
            if fields[0] == _NO_OBJECT:
                continue
            height, width, length, x, y, z, yaw = _floats(fields[8:15], number)
            yield ToolBox(fields[0], [x, y, z], [length, width, height], yaw)

    return read_tool_labels(source, scans, settings, ".txt", parse)


def write_openpcdet(frames: Sequence[ScanLabels]) -> Mapping[str, str]:
    """Return files by relative paths: a text for each scan."""

    def line(kind: str, box: NDArray[np.float32]) -> str:
        return f"{_text(box)} {kind}"

    return _files(frames, line)


def write_kitti_no_camera(frames: Sequence[ScanLabels]) -> Mapping[str, str]:
    """Return files by relative paths: a text for each scan, with the 2D box set to 0."""

    def line(kind: str, box: NDArray[np.float32]) -> str:
        return f"{kind} 0 0 0 0 0 0 0 {_text(box[[5, 4, 3, 0, 1, 2, 6]])}"

    return _files(frames, line)


def _files(frames: Sequence[ScanLabels], line: Callable[[str, NDArray[np.float32]], str]) -> dict[str, str]:
    files = {}
    for frame in frames:
        for kind in frame.records.types:
            if kind.split() != [kind]:
                raise OutputError(f"class {kind!r}: these labels are separated by blanks; choose another format")
        lines = [line(kind, box) for kind, box in zip(frame.records.types, frame.records.boxes, strict=True)]
        files[f"{frame.name.as_posix()}.txt"] = "".join(f"{text}\n" for text in lines)
    return files


def _text(values: NDArray[np.float32]) -> str:
    return " ".join(f"{value:.4f}" for value in rounded(values))


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the fields of each line that is not empty, with its number."""
    for number, line in enumerate(text.split("\n"), start=1):
        if fields := line.split():
            yield number, fields


def _floats(fields: Sequence[str], number: int) -> list[float]:
    try:
        return [float(field) for field in fields]
    except ValueError as error:
        raise ValueError(f"line {number}: {error}; correct it") from None
