"""LZF, which compressed PCD files are packed with, against streams made by hand."""

import struct

import numpy as np
import pytest

from asca_pillars.data.scans.pcd import lzf_decompress
from tests.data.scans.test_scan_reader import literal_lzf, read

# --- LZF


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (b"\x02abc" + b"\x20\x02", b"abcabc"),  # length 1 + 2, distance 2 + 1
        (b"\x00a" + b"\xe0\x05\x00", b"a" * 15),  # length 7 + 5 + 2, distance 1: repeats its own output
        (b"\x01ab" + b"\x60\x01" + b"\x00c", b"ab" + b"ababa" + b"c"),  # length 3 + 2, distance 2
        (literal_lzf(bytes(300)) + b"\x21\x2b", bytes(303)),  # distance 256 + 43 + 1 = 300: the very start
        (b"", b""),
    ],
)
def test_lzf_by_hand(stream, expected):
    assert lzf_decompress(stream, len(expected)) == expected


@pytest.mark.parametrize(
    ("stream", "size"),
    [
        (b"\x02ab", 3),
        (b"\x00a\x20", 4),
        (b"\x00a\xe0\x05", 15),
        (b"\x00a\x20\x01", 4),
        (b"\x00a", 2),
        (b"\x01ab", 1),
    ],
    ids=[
        "literals end",
        "distance missing",
        "distance after long length",
        "before the start",
        "short",
        "long",
    ],
)
def test_damaged_lzf(stream, size):
    with pytest.raises(ValueError, match=r"missing|start|instead"):
        lzf_decompress(stream, size)


def test_compressed_pcd_with_references(tmp_path):
    """Two points at (1, 1, 1): six equal floats, one written out and the rest a reference 4 bytes back."""
    stream = b"\x03" + struct.pack("<f", 1.0) + b"\xe0" + bytes([20 - 2 - 7, 3])
    header = "FIELDS z y x\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary_compressed\n"
    scan = read(tmp_path, "a.pcd", header.encode() + struct.pack("<2I", len(stream), 24) + stream)
    np.testing.assert_array_equal(scan.points, [[1, 1, 1, 0]] * 2)


def test_columns_is_the_old_name_of_fields(tmp_path):
    header = "COLUMNS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
    np.testing.assert_array_equal(read(tmp_path, "a.pcd", header.encode() + b"1 2 3\n").points, [[1, 2, 3, 0]])
