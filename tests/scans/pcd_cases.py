"""PCD files at the edge of what is read, with what they hold: for read_pcd and for the page's readers.js."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.scans.scan_files import POINTS, literal_lzf, pcd

XYZ = POINTS * np.array([1, 1, 1, 0], np.float32)
_UNIT = np.array([1, 1, 1, 255], np.float32)
BYTES = np.floor(POINTS * _UNIT)
_BINARY, _ASCII, _PACKED = pcd("binary"), pcd("ascii"), pcd("binary_compressed")
_BODY = _BINARY[_BINARY.index(b"DATA binary\n") + len(b"DATA binary\n") :]

# What PCL packs the body of a binary_compressed file with, and what it unpacks to.
LZF_STREAMS = [
    (b"\x02abc" + b"\x20\x02", b"abcabc"),  # length 1 + 2, distance 2 + 1
    (b"\x00a" + b"\xe0\x05\x00", b"a" * 15),  # length 7 + 5 + 2, distance 1: repeats its own output
    (b"\x01ab" + b"\x60\x01" + b"\x00c", b"ab" + b"ababa" + b"c"),  # length 3 + 2, distance 2
    (literal_lzf(b"a" + bytes(299)) + b"\x21\x2b", b"a" + bytes(299) + b"a\0\0"),  # distance 256 + 43 + 1: the start
    (b"", b""),
]


class Case(NamedTuple):
    """A file by its name, and its points (N, 4) if it is read; None if it is refused."""

    name: str
    content: bytes
    points: NDArray[np.float32] | None
    has_padding: bool = False


def stretched(content: bytes, page_bytes: int, fill: bytes = b"\0") -> bytes:
    """As PCL up to 1.8 writes a file: as large as a page of memory and the points together."""
    return content + fill * (page_bytes - (len(content) - len(_BODY)))


def text(header: str, *rows: str) -> bytes:
    """An ASCII PCD of four points x, y, z."""
    lines = rows or tuple(f"{x} {y} {z}" for x, y, z in POINTS[:, :3])
    return "\n".join([header, *lines, ""]).encode()


HEADER = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA ascii"
_DOUBLES = b"FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 4\nDATA binary\n" + POINTS[:, :3].astype("<f8").tobytes()
_HALVES = b"FIELDS x y z\nSIZE 2 2 2\nTYPE F F F\nPOINTS 4\nDATA binary\n" + POINTS[:, :3].astype("<f2").tobytes()

READ = [
    *(Case(f"page of {page}", stretched(_BINARY, page), POINTS, True) for page in (4096, 8192, 16384, 32768, 65536)),
    Case("page of 4096 that is not zero", stretched(_BINARY, 4096, b"P"), POINTS, True),
    Case("zeros", _BINARY + bytes(1000), POINTS, True),
    Case("less than a point follows", _BINARY + b"\n\n", POINTS),
    Case("compressed, page", stretched(_PACKED, 4096), POINTS, True),
    Case("compressed, zeros", _PACKED + bytes(300), POINTS, True),
    *(
        Case(f"types in lower case, {name}", content.replace(b"TYPE U F F I F F", b"TYPE u f f i f f"), POINTS)
        for name, content in (("binary", _BINARY), ("ascii", _ASCII), ("compressed", _PACKED))
    ),
    Case("bytes in lower case", pcd("binary", BYTES, kind="U1").replace(b"F U\n", b"F u\n"), BYTES / _UNIT),
    Case("keywords in lower case", text(HEADER.lower()), XYZ),
    Case("encoding in capitals", _BINARY.replace(b"DATA binary", b"DATA BINARY"), POINTS),
    Case("COLUMNS", text(HEADER.replace("FIELDS", "COLUMNS")), XYZ),
    Case("byte-order mark", b"\xef\xbb\xbf" + _ASCII, POINTS),
    Case("byte-order mark, binary", b"\xef\xbb\xbf" + _BINARY, POINTS),
    Case("lines of Windows", _ASCII.replace(b"\n", b"\r\n"), POINTS),
    Case("header of Windows", _BINARY[: -len(_BODY)].replace(b"\n", b"\r\n") + _BODY, POINTS),
    Case("byte-order mark, Windows", b"\xef\xbb\xbf" + _ASCII.replace(b"\n", b"\r\n"), POINTS),
    Case("tabs and empty lines", _ASCII.replace(b" ", b" \t").replace(b"DATA", b"\n# \xff\n\nDATA"), POINTS),
    Case("doubles", _DOUBLES, XYZ),
    Case("halves", _HALVES, np.concatenate([XYZ[:, :3].astype(np.float16).astype(np.float32), XYZ[:, 3:]], 1)),
    Case("without COUNT and HEIGHT", text(HEADER.replace("HEIGHT 1\n", "")), XYZ),
    Case("WIDTH alone", text(HEADER.replace("POINTS 4\n", "")), XYZ),
]
REFUSED = [
    Case("page and a point", stretched(_BINARY, 4096, b"P") + _BODY[-27:], None),
    Case("another body", _BINARY + _BODY, None),
    Case("a point too few", _BINARY[:-27], None),
    Case("unknown keyword", text(f"VENDOR a\n{HEADER}"), None),
    Case("keyword twice", text(f"WIDTH 4\n{HEADER}"), None),
    Case("COLUMNS beside FIELDS", text(f"COLUMNS x y z\n{HEADER}"), None),
    Case("another byte-order mark", "\ufeff".encode() * 2 + _ASCII, None),
    Case("UTF-16", _ASCII.decode().encode("utf-16"), None),
    Case("U+FEFF in the header", _ASCII.replace(b"FIELDS _ x", b"FIELDS _ \xef\xbb\xbfx"), None),
    Case("U+FEFF for a blank", text(HEADER, "1 2\ufeff3", *["1 2 3"] * 3), None),
    Case("a blank that is not ASCII", text(HEADER, "1 2\u20033", *["1 2 3"] * 3), None),
    Case("a separator of ASCII", text(HEADER, "1 2\x1c3", *["1 2 3"] * 3), None),
    Case("underscores", text(HEADER, "1_0 2 3", *["1 2 3"] * 3), None),
    Case("sizes with zeros", text(HEADER.replace("SIZE 4", "SIZE 04")), None),
    Case("fewer sizes", text(HEADER.replace("SIZE 4", "SIZE")), None),
    Case("more counts", text(HEADER.replace("TYPE", "COUNT 1 1 1 1\nTYPE")), None),
    Case("a count that is none", text(HEADER.replace("TYPE", "COUNT 1 1 one\nTYPE")), None),
    Case("two values of x", text(HEADER.replace("TYPE", "COUNT 2 1 1\nTYPE"), *["1 1 2 3"] * 4), None),
    Case("two numbers of points", text(HEADER.replace("POINTS 4", "POINTS 4 4")), None),
    Case("a number with a sign", text(HEADER.replace("POINTS 4", "POINTS +4")), None),
    Case("more lines", text(HEADER, *["1 2 3"] * 5), None),
    Case("long header", b"#\n" * 40_000 + _ASCII, None),
    Case("compressed bytes missing", _PACKED[:-1], None),
    Case("Git LFS", b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4" * 64 + b"\nsize 5\n", None),
]
CASES = READ + REFUSED
