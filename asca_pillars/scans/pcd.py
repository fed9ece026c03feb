"""The Point Cloud Library's PCD format, version 0.7: ascii, binary and binary_compressed."""

import codecs
import struct
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

_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_OLD_KEYS = {"COLUMNS": "FIELDS"}  # in PCD's first version
_PAGE_BYTES = tuple(2**power for power in range(12, 17))  # of memory: 4 KiB on most machines, up to 64 KiB on others
_TYPES = {
    f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IUF" for size in (1, 2, 4, 8) if kind + str(size) != "F1"
}


def read_pcd(path: Path) -> StoredPoints:
    """Read the points of a PCD file in its own frame: VIEWPOINT, the sensor's pose, is not applied.

    Bytes after the points are ignored, with a remark, where they are padding: all zeros, or as many as PCL up to 1.8
    appends, for a file size of the points plus a page of memory.

    Raises:
        ScanError: the header is not PCD's, contradicts itself, lacks x, y or z, or the body is damaged or not of
            the length that the header states.
    """
    data = path.read_bytes()
    header, body = _split_header(path, data)
    fields = _fields(path, header)
    count = _point_count(path, header)
    encoding = " ".join(header["DATA"]).lower()
    size = sum(field.size_bytes for field in fields)
    if encoding == "ascii":
        lines = [line for line in body.splitlines() if line.strip()]
        if len(lines) > count:
            raise ScanError(f"{path}: {len(lines)} lines where the header states {count} points; correct the header")
        return points_from_text(str(path), lines, fields, count)
    if encoding == "binary":
        stored, used = points_from_bytes(str(path), body, fields, count), count * size
        padded = body.count(0, used) == len(body) - used or len(data) - used in _PAGE_BYTES
        if len(body) - used >= size and not padded:
            raise ScanError(
                f"{path}: {len(body)} bytes where the header states {count} points of {size}; correct the header"
            )
    elif encoding == "binary_compressed":
        unpacked, used = _decompress(path, body, count * size) if count else (b"", 0)
        stored = points_from_bytes(str(path), unpacked, fields, count, by_field=True)
    else:
        raise ScanError(f"{path}: DATA is '{encoding}'; PCD knows ascii, binary and binary_compressed")
    if (surplus := len(body) - used) < size:
        return stored
    return stored._replace(remarks=(f"{surplus} bytes after the points were left out",))


def lzf_decompress(data: bytes, size: int) -> bytearray:
    """Decompress an LZF stream (Marc Lehmann's liblzf, which PCL uses) of `size` bytes.

    A control byte below 32 precedes that many literals plus one. Any other starts a reference: three bits of
    length (7: one more byte follows to be added) plus two, and thirteen bits of distance minus one, counted
    back from the end of the output. A reference may overlap its own output.

    Raises:
        ValueError: the stream ends within a token, refers to before its start, or has another size. It is followed
            no further than that size.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end and len(out) <= size:
            control = data[position]
            position += 1
            if control < 32:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            length += 2
            start = len(out) - ((control & 31) << 8) - data[position] - 1
            position += 1
            if start < 0:
                raise ValueError("a reference to before the start")
            chunk = out[start : start + length]
            if len(chunk) < length:
                chunk = (chunk * (length // len(chunk) + 1))[:length]
            out += chunk
    except IndexError:
        raise ValueError("the end is missing") from None
    if position != end or len(out) != size:
        raise ValueError(f"{len(out)}{' or more' if position < end else ''} bytes instead of {size}")
    return out


def _decompress(path: Path, body: bytes, needed: int) -> tuple[bytearray, int]:
    """Decompress the points; also return the number of bytes read."""
    if len(body) < 8:
        raise ScanError(f"{path}: the compressed body is missing; {AGAIN}")
    packed_size, size = struct.unpack_from("<2I", body)
    if size != needed:
        raise ScanError(f"{path}: {size} unpacked bytes where the header's points need {needed}; {AGAIN}")
    packed = body[8 : 8 + packed_size]
    if len(packed) < packed_size:
        raise ScanError(f"{path}: {len(packed)} of {packed_size} compressed bytes are there; {AGAIN}")
    try:
        return lzf_decompress(packed, size), 8 + packed_size
    except ValueError as error:
        raise ScanError(f"{path}: the compressed body does not unpack ({error}); {AGAIN}") from error


def _split_header(path: Path, data: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = len(codecs.BOM_UTF8) if data.startswith(codecs.BOM_UTF8) else 0
    while "DATA" not in header:
        end = data.find(b"\n", position, MAX_HEADER_BYTES)
        if end < 0:
            raise ScanError(f"{path}: no DATA line within the first {MAX_HEADER_BYTES} bytes; {AGAIN}")
        words = [word.decode("ascii", errors="replace") for word in data[position:end].split()]
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        words[0] = _OLD_KEYS.get(words[0].upper(), words[0].upper())
        if words[0] not in _KEYS:
            raise ScanError(f"{path}: {words[0][:20]!r} is not a line of a PCD header; {AGAIN}")
        if words[0] in header:
            raise ScanError(f"{path}: two {words[0]} lines; correct the header")
        header[words[0]] = words[1:]
    return header, data[position:]


def _fields(path: Path, header: dict[str, list[str]]) -> list[Field]:
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    columns = {"SIZE": header.get("SIZE", []), "TYPE": header.get("TYPE", []), "COUNT": counts}
    for key, column in columns.items():
        if len(column) != len(names):
            raise ScanError(f"{path}: {key} has {len(column)} values for {len(names)} FIELDS; correct the header")
    fields = []
    for name, size, kind, count in zip(names, *columns.values(), strict=True):
        if kind.upper() + size not in _TYPES or (values := whole_number(count)) is None:
            raise ScanError(
                f"{path}: field {name} has TYPE {kind}, SIZE {size}, COUNT {count}; "
                "TYPE is I, U or F, SIZE 1, 2, 4 or 8, COUNT a whole number"
            )
        fields.append(Field(name, np.dtype(_TYPES[kind.upper() + size]), values))
    return fields


def _point_count(path: Path, header: dict[str, list[str]]) -> int:
    """Return POINTS, which must be WIDTH times HEIGHT where those are given too."""
    numbers = {}
    for key in ("POINTS", "WIDTH", "HEIGHT"):
        words = header.get(key)
        if words is None:
            continue
        number = whole_number(words[0]) if len(words) == 1 else None
        if number is None:
            raise ScanError(f"{path}: {key} is {' '.join(words)[:40]!r} and not one whole number; correct the header")
        numbers[key] = number
    if not {"POINTS", "WIDTH"} & numbers.keys():
        raise ScanError(f"{path}: neither POINTS nor WIDTH in the header; correct the header")
    area = numbers["WIDTH"] * numbers.get("HEIGHT", 1) if "WIDTH" in numbers else numbers["POINTS"]
    if numbers.get("POINTS", area) != area:
        raise ScanError(f"{path}: POINTS is {numbers['POINTS']} and WIDTH times HEIGHT is {area}; correct the header")
    return area
