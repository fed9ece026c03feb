"""PCD files at the edge of what is read, and LZF, which compressed ones are packed with, by hand."""

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
    {
        "literals end": (b"\x02ab", 3),
        "distance missing": (b"\x00a\x20", 4),
        "distance after long length": (b"\x00a\xe0\x05", 15),
        "before the start": (b"\x00a\x20\x01", 4),
        "short": (b"\x00a", 2),
        "long": (b"\x01ab", 1),
    }.values(),
)
def test_damaged_lzf(stream, size):
    with pytest.raises(ValueError, match=r"missing|start|instead"):
        lzf_decompress(stream, size)
