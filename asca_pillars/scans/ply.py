"""The PLY (Stanford polygon) format, ascii and binary of either byte order: its vertices are the points."""

import codecs
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.records import (
    AGAIN,
    MAX_HEADER_BYTES,
    Field,
    StoredPoints,
    points_from_bytes,
    points_from_text,
    whole_number,
)

MAX_LISTS = 1_000_000  # of the elements before the vertices, which are skipped one by one
_BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass
class _Element:
    """Element of the header; a list property has the type of its length and that of its items."""

    name: str
    count: int
    properties: list[tuple[Field, np.dtype[np.generic] | None]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(length is not None for _, length in self.properties)


def read_ply(path: Path) -> StoredPoints:
    """Read the vertices of a PLY file. In an ASCII file every entry of every element has a line.

    Raises:
        ScanError: not a PLY header, no vertices with x, y and z, or the body is damaged.
    """
    encoding, elements, body = _split_header(path, path.read_bytes())
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        vertices = "two elements vertex" if "vertex" in names else "no element vertex"
        raise ScanError(f"{path}: {vertices} among {', '.join(names) or 'none'}; export one point cloud")
    index = names.index("vertex")
    vertex = elements[index]
    if vertex.has_lists:
        raise ScanError(f"{path}: the vertices have a list property; export plain x, y, z and intensity")
    fields = [prop for prop, _ in vertex.properties]
    if encoding == "ascii":
        start = sum(element.count for element in elements[:index])
        lines = [line for line in body.splitlines() if line.strip()][start:]
        if index == len(elements) - 1 and len(lines) > vertex.count:
            raise ScanError(f"{path}: {len(lines)} lines where the header states {vertex.count} points; {AGAIN}")
        return points_from_text(str(path), lines, fields, vertex.count)
    start = _skip_bytes(path, body, elements[:index])
    size = sum(prop.size_bytes for prop in fields)
    if index == len(elements) - 1 and size and len(body) - start >= (vertex.count + 1) * size:
        raise ScanError(
            f"{path}: {len(body) - start} bytes where the header states {vertex.count} points of {size}; {AGAIN}"
        )
    return points_from_bytes(str(path), body[start:], fields, vertex.count)


def _skip_bytes(path: Path, body: bytes, elements: list[_Element]) -> int:
    """Return the number of bytes that `elements` take at the start of a binary body."""
    position = 0
    for element in elements:
        if not element.has_lists:
            position += element.count * sum(prop.size_bytes for prop, _ in element.properties)
            continue
        if element.count > MAX_LISTS:
            raise ScanError(
                f"{path}: {element.count} lists of element {element.name} before the vertices, at most {MAX_LISTS} "
                "are read; export the vertices first"
            )
        for _ in range(element.count):
            for prop, length in element.properties:
                if length is None:
                    position += prop.size_bytes
                    continue
                if position + length.itemsize > len(body):
                    raise ScanError(f"{path}: element {element.name} before the vertices breaks off; {AGAIN}")
                items = int(np.frombuffer(body, dtype=length, count=1, offset=position)[0])
                position += length.itemsize + max(items, 0) * prop.dtype.itemsize
    return position


def _split_header(path: Path, data: bytes) -> tuple[str, list[_Element], bytes]:
    data = data.removeprefix(codecs.BOM_UTF8)
    end = data.find(b"\nend_header", 0, MAX_HEADER_BYTES)
    start_of_body = data.find(b"\n", end + 1) + 1
    if not data.startswith(b"ply") or end < 0 or start_of_body == 0:
        raise ScanError(
            f"{path}: no PLY header from 'ply' to 'end_header' within the first {MAX_HEADER_BYTES} bytes; {AGAIN}"
        )
    lines = [line.split() for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]]
    encoding = next((words[1] for words in lines if len(words) == 3 and words[0] == "format"), "missing")
    if encoding not in _BYTE_ORDERS:
        raise ScanError(f"{path}: the PLY format is {encoding}; known are {', '.join(_BYTE_ORDERS)}")
    elements: list[_Element] = []
    for words in lines:
        match words:
            case ["element", name, number] if (count := whole_number(number)) is not None:
                elements.append(_Element(name, count))
            case ["property", "list", length, kind, name] if (
                elements and kind in _TYPES and _TYPES.get(length, "f")[0] in "iu"
            ):
                prop = Field(name, _dtype(encoding, kind))
                elements[-1].properties.append((prop, _dtype(encoding, length)))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((Field(name, _dtype(encoding, kind)), None))
            case ["format" | "comment" | "obj_info", *_] | []:
                pass
            case _:
                raise ScanError(f"{path}: {' '.join(words)[:60]!r} is not a line of a PLY header; {AGAIN}")
    return encoding, elements, data[start_of_body:]


def _dtype(encoding: str, kind: str) -> np.dtype[np.generic]:
    return np.dtype(_BYTE_ORDERS[encoding] + _TYPES[kind])
