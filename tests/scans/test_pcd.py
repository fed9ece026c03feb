"""PCD files at the edge of what is read, and LZF, which compressed ones are packed with, by hand."""

import struct

import numpy as np
import pytest

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.pcd import lzf_decompress
from tests.scans.pcd_cases import LZF_STREAMS, READ, REFUSED
from tests.scans.scan_files import read


@pytest.mark.parametrize("case", READ, ids=lambda case: case.name)
def test_what_is_read(tmp_path, case):
    scan = read(tmp_path, "a.pcd", case.content)
    np.testing.assert_array_equal(scan.points, case.points)
    assert bool(scan.notes.remarks) == case.has_padding
    assert all("bytes after the points were left out" in remark for remark in scan.notes.remarks)


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.name)
def test_what_is_refused(tmp_path, case):
    with pytest.raises(ScanError, match=r"a\.pcd"):
        read(tmp_path, "a.pcd", case.content)


# --- LZF


@pytest.mark.parametrize(("stream", "expected"), LZF_STREAMS)
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
