"""The Point Cloud Library's PCD format, version 0.7: ascii, binary and binary_compressed."""

import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.scans.records import AGAIN, Field, points_from_bytes, points_from_text, whole_number
from asca_pillars.errors import ScanError

_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_TYPES = {
    f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IUF" for size in (1, 2, 4, 8) if kind + str(size) != "F1"
}


def read_pcd(path: Path) -> NDArray[np.float32]:
    """Points (N, 4) of a PCD file in its own frame: VIEWPOINT is where the sensor stood, and is not applied.

    Raises:
        ScanError: the header is not PCD's, lacks x, y or z, or the body is damaged.
    """
    data = path.read_bytes()
    header, body = _split_header(path, data)
    fields = _fields(path, header)
    count = _point_count(path, header)
    if count == 0:
        return points_from_bytes(str(path), b"", fields, 0)
    encoding = " ".join(header["DATA"]).lower()
    if encoding == "ascii":
        return points_from_text(str(path), body.split(), fields, count)
    if encoding == "binary":
        return points_from_bytes(str(path), body, fields, count)
    if encoding == "binary_compressed":
        return points_from_bytes(str(path), _decompress(path, body), fields, count, by_field=True)
    raise ScanError(f"{path}: DATA is '{encoding}'; PCD knows ascii, binary and binary_compressed")


def lzf_decompress(data: bytes, size: int) -> bytearray:
    """Decompress an LZF stream (Marc Lehmann's liblzf, which PCL uses) of `size` bytes.

    A control byte below 32 precedes that many literals plus one. Any other starts a reference: three bits of
    length (7: one more byte follows to be added) plus two, and thirteen bits of distance minus one, counted
    back from the end of what is written. A reference may overlap its own output.

    Raises:
        ValueError: the stream ends within a token, refers to before its start, or has another size.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
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
        raise ValueError(f"{len(out)} bytes instead of {size}")
    return out


def _decompress(path: Path, body: bytes) -> bytearray:
    if len(body) < 8:
        raise ScanError(f"{path}: the compressed body is missing; {AGAIN}")
    packed_size, size = struct.unpack_from("<2I", body)
    packed = body[8 : 8 + packed_size]
    if len(packed) < packed_size:
        raise ScanError(f"{path}: {len(packed)} of {packed_size} compressed bytes are there; {AGAIN}")
    try:
        return lzf_decompress(packed, size)
    except ValueError as error:
        raise ScanError(f"{path}: the compressed body does not unpack ({error}); {AGAIN}") from error


def _split_header(path: Path, data: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = data.find(b"\n", position)
        if end < 0:
            raise ScanError(f"{path}: the PCD header ends before its DATA line; {AGAIN}")
        words = data[position:end].decode("ascii", errors="replace").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS:
            raise ScanError(f"{path}: {words[0][:20]!r} is not a line of a PCD header; {AGAIN}")
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
        if kind + size not in _TYPES or (values := whole_number(count)) is None:
            raise ScanError(
                f"{path}: field {name} has TYPE {kind}, SIZE {size}, COUNT {count}; "
                "TYPE is I, U or F, SIZE 1, 2, 4 or 8, COUNT a whole number"
            )
        fields.append(Field(name, np.dtype(_TYPES[kind + size]), values))
    return fields


def _point_count(path: Path, header: dict[str, list[str]]) -> int:
    words = header["POINTS"] if "POINTS" in header else header.get("WIDTH", []) + header.get("HEIGHT", ["1"])
    numbers = [number for word in words if (number := whole_number(word)) is not None]
    if not words or len(numbers) != len(words):
        raise ScanError(f"{path}: no whole number of POINTS in the header; correct the header")
    return math.prod(numbers)
