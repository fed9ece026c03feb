"""Scans in the bytes of each format."""

import io
import struct
from typing import Literal

import numpy as np
from hypothesis import strategies as st

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.scan_reader import Scan, read_scan

POINTS = np.array([[1.5, -2.25, 0.5, 0.25], [70.125, 39.5, -3, 1.0], [0, 0, 0, 0], [-5.0, 8.0, 1.0, 0.5]], np.float32)


def literal_lzf(data: bytes) -> bytes:
    """An LZF stream without references: up to 32 literals after a byte that counts them minus one."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def pcd(encoding: str, points=POINTS, *, field="intensity", kind="F4") -> bytes:
    """A PCD with padding before x, two values per point between y and z, and the reflectance after."""
    count = len(points)
    header = (
        "# .PCD v0.7\nVERSION 0.7\n"
        f"FIELDS _ x y normal z {field}\nSIZE 1 4 8 2 4 {kind[1]}\nTYPE U F F I F {kind[0]}\n"
        "COUNT 3 1 1 2 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {encoding}\n"
    ).encode()
    types = ["3u1", "<f4", "<f8", "2<i2", "<f4", f"<{kind.lower()}"]
    records = np.zeros(count, [(f"f{i}", t) for i, t in enumerate(types)])
    records["f0"], records["f3"] = 7, -3
    records["f1"], records["f2"], records["f4"] = points[:, :3].T
    records["f5"] = points[:, 3]
    if encoding == "ascii":
        rows = (f"7 7 7 {r['f1']} {r['f2']} -3 -3 {r['f4']} {r['f5']}\n" for r in records)
        return header + "".join(rows).encode()
    if encoding == "binary":
        return header + records.tobytes()
    columns = b"".join(records[name].tobytes() for name in records.dtype.names or ())
    packed = literal_lzf(columns)
    return header + struct.pack("<2I", len(packed), len(columns)) + packed


def ply(encoding: str, points=POINTS, *, kind="float") -> bytes:
    """A PLY whose vertices stand between a plain element and faces, after an element with a list."""
    order: Literal["<", ">"] = ">" if encoding == "binary_big_endian" else "<"
    header = (
        f"ply\nformat {encoding} 1.0\ncomment made by a test\n"
        "element camera 2\nproperty double focus\nproperty uchar flag\n"
        "element strip 2\nproperty short id\nproperty list uchar int items\n"
        f"element vertex {len(points)}\nproperty uchar red\nproperty float z\nproperty double y\n"
        f"property float x\nproperty {kind} scalar_Intensity\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    strips = [(5, [1, 2, 3]), (6, [])]
    code = {"float": "f4", "uchar": "u1", "ushort": "u2"}[kind]
    records = np.zeros(len(points), [("r", "u1"), ("z", "f4"), ("y", "f8"), ("x", "f4"), ("i", code)])
    records["x"], records["y"], records["z"], records["i"] = points.T
    if encoding == "ascii":
        lines = ["1.5 1", "2.5 0", *(" ".join(map(str, [a, len(b), *b])) for a, b in strips)]
        lines += [" ".join(str(value) for value in record) for record in records]
        return header + ("\n".join([*lines, "3 0 1 2"]) + "\n").encode()
    body = struct.pack(order + "dBdB", 1.5, 1, 2.5, 0)
    body += b"".join(struct.pack(f"{order}hB{len(b)}i", a, len(b), *b) for a, b in strips)
    return header + body + records.astype(records.dtype.newbyteorder(order)).tobytes() + bytes(13)


def las(points=POINTS) -> bytes:
    """LAS 1.2 with points of format 0: coordinates in steps of 0.125 m from an offset, intensities of 0..255."""
    header = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I3d3d6d",
        *(b"LASF", 0, 0, 0, 0, 0, b"", 1, 2, b"", b"made by a test", 1, 2024, 227, 227, 0, 0, 20, len(points)),
        *(len(points), 0, 0, 0, 0, 0.125, 0.125, 0.125, 8, 0, 0, *[0] * 6),
    )
    steps = np.round((points[:, :3] - [8, 0, 0]) / 0.125).astype(int)
    intensities = np.round(points[:, 3] * 255).astype(int)
    records = [struct.pack("<iiiHBBbBH", *xyz, i, 9, 1, 0, 0, 0) for xyz, i in zip(steps, intensities, strict=True)]
    return header + b"".join(records)


def laz() -> bytes:
    """The same, as laspy compresses it."""
    import laspy

    stream = io.BytesIO()
    laspy.read(io.BytesIO(las())).write(stream, do_compress=True)
    return stream.getvalue()


def text(separator: str = " ", first: str = "", points=POINTS) -> bytes:
    """A line of x, y, z and reflectance for each point, below a first line."""
    return (first + "".join(separator.join(map(str, row)) + "\n" for row in points.tolist())).encode()


def npy(array: np.ndarray) -> bytes:
    header = str({"descr": array.dtype.str, "fortran_order": False, "shape": array.shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + array.tobytes()


CHANGES = st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=4)
"""Positions in a file and bytes to write there."""


def assert_scan_or_scan_error(folder, name: str, content: bytes, changes) -> None:
    damaged = bytearray(content)
    for position, value in changes:
        damaged[position % len(damaged)] = value
    try:
        assert read(folder, name, bytes(damaged)).points.shape[1] == 4
    except ScanError as error:
        assert "\n" not in str(error)


def read(tmp_path, name: str, content: bytes) -> Scan:
    (tmp_path / name).write_bytes(content)
    return read_scan(tmp_path / name)
