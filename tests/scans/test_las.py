"""LAS files written byte by byte, and LAZ files as laspy compresses them."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings

from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.scans import records
from tests.scans.scan_files import CHANGES, POINTS, assert_scan_or_scan_error, las, laz, read

for module in ("laspy", "lazrs"):
    pytest.importorskip(module, reason="needs the extra `import`")


@pytest.mark.parametrize(("name", "form"), [("a.las", las), ("A.LAZ", laz)])
def test_points_and_intensities(tmp_path, name, form):
    scan = read(tmp_path, name, form())
    np.testing.assert_array_equal(scan.points[:, :3], POINTS[:, :3])
    np.testing.assert_allclose(scan.points[:, 3], np.round(POINTS[:, 3] * 255) / 255, rtol=1e-6)
    assert scan.notes.reflectance_scale == 255


@pytest.mark.parametrize(("name", "form"), [("a.las", las), ("a.laz", laz)])
def test_a_file_cut_anywhere_is_refused(tmp_path, name, form):
    content = form()
    for size in range(1, len(content), 7):
        with pytest.raises(ScanError, match=name):
            read(tmp_path, name, content[:size])


@pytest.mark.parametrize(("name", "form"), [("a.las", las), ("a.laz", laz)])
@settings(max_examples=60)
@given(changes=CHANGES)
def test_a_file_with_wrong_bytes_is_a_scan_or_a_scan_error(tmp_path_factory, name, form, changes):
    assert_scan_or_scan_error(tmp_path_factory.mktemp("fuzz"), name, form(), changes)


def test_a_header_of_more_records_than_the_file_holds_is_refused_at_once(tmp_path):
    content = bytearray(las())
    content[100:104] = b"\xff" * 4  # laspy would read records of nothing for minutes
    with pytest.raises(ScanError, match="more records than the file holds"):
        read(tmp_path, "a.las", bytes(content))


@pytest.mark.parametrize("at_end", [False, True])
def test_a_table_of_more_chunks_than_the_file_holds_is_refused(tmp_path, at_end):
    content = bytearray(laz())
    start = int.from_bytes(content[96:100], "little")
    table = int.from_bytes(content[start : start + 8], "little")
    if at_end:  # as written to a stream
        content += content[start : start + 8]
        content[start : start + 8] = b"\xff" * 8
    assert len(read(tmp_path, "a.laz", bytes(content)).points) == len(POINTS)
    content[table + 4 : table + 8] = b"\xff" * 4  # lazrs would end the process for want of memory
    with pytest.raises(ScanError, match="more records than the file holds"):
        read(tmp_path, "a.laz", bytes(content))


def test_more_points_than_a_scan_has_are_refused_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "MAX_POINTS", 3)
    with pytest.raises(ScanError, match="4 points are more than 3"):
        read(tmp_path, "a.las", las())


@pytest.mark.parametrize("module", ["laspy", "lazrs"])
def test_without_laspy_the_command_that_installs_it_is_named(tmp_path, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(AscaError, match=rf"{module} not installed: pip install .*import"):
        read(tmp_path, "a.las", las())
