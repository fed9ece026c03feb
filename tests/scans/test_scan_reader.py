"""Every scan format, written here byte by byte, and what damaged files say."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.find_scans import SCAN_SUFFIXES
from asca_pillars.scans.scan_reader import decide_scale, read_scan, write_scan
from tests.scans.scan_files import POINTS, npy, pcd, ply, read

FILES = {
    "a.bin": POINTS.astype("<f4").tobytes(),
    "a.npy": npy(POINTS),
    "ascii.pcd": pcd("ascii"),
    "binary.pcd": pcd("binary"),
    "compressed.PCD": pcd("binary_compressed"),
    "ascii.ply": ply("ascii"),
    "little.ply": ply("binary_little_endian"),
    "big.ply": ply("binary_big_endian"),
}
BRIGHT = POINTS * np.array([1, 1, 1, 200], np.float32)


@pytest.mark.parametrize("name", FILES)
def test_each_format_gives_the_same_points(tmp_path, name):
    scan = read(tmp_path, name, FILES[name])
    np.testing.assert_array_equal(scan.points, POINTS)
    assert scan.points.dtype == np.float32
    assert scan.points.flags["C_CONTIGUOUS"]
    assert scan.dropped_points == 0


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_anywhere_is_a_scan_or_a_scan_error(tmp_path, name):
    complete = 0
    for size in range(len(FILES[name])):
        try:
            complete += len(read(tmp_path, name, FILES[name][:size]).points) == len(POINTS)
        except ScanError as error:
            assert name in str(error)
            assert "\n" not in str(error)
    # Whole without the newline, the last digit or the faces that follow the vertices; never earlier.
    assert complete <= (13 if name.endswith("ply") else 3)


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=60)
@given(changes=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_file_with_wrong_bytes_is_a_scan_or_a_scan_error(tmp_path_factory, name, changes):
    content = bytearray(FILES[name])
    for position, value in changes:
        content[position % len(content)] = value
    try:
        assert read(tmp_path_factory.mktemp("fuzz"), name, bytes(content)).points.shape[1] == 4
    except ScanError as error:
        assert "\n" not in str(error)


# --- reflectance, points that are not finite, empty scans


@pytest.mark.parametrize(
    ("name", "content"),
    {
        "b.npy": npy(BRIGHT),
        "f.pcd": pcd("ascii", BRIGHT, kind="F4", field="reflectance"),
        "u.pcd": pcd("binary", BRIGHT, kind="U1", field="i"),
        "c.pcd": pcd("binary_compressed", BRIGHT, kind="U2"),
        "r.pcd": pcd("ascii", BRIGHT, field="reflectivity"),
        "a.ply": ply("ascii", BRIGHT, kind="uchar"),
        "b.ply": ply("binary_big_endian", BRIGHT, kind="ushort"),
    }.items(),
)
def test_reflectance_of_0_to_255_comes_to_0_to_1(tmp_path, name, content):
    np.testing.assert_allclose(read(tmp_path, name, content).points[:, 3], POINTS[:, 3] * 200 / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "form", "kind", "expected"),
    [("a.pcd", pcd, "U1", 1 / 255), ("b.ply", ply, "uchar", 1 / 255), ("f.pcd", pcd, "F4", 1)],
)
def test_integers_are_of_0_to_255_even_in_a_dark_scan(tmp_path, name, form, kind, expected):
    dark = POINTS * np.array([1, 1, 1, 0], np.float32) + np.array([0, 0, 0, 1], np.float32)
    np.testing.assert_allclose(read(tmp_path, name, form("ascii", dark, kind=kind)).points[:, 3], expected)


@pytest.mark.parametrize(("large", "scale"), [(2, 1.0), (3, 255.0)])
def test_one_value_in_a_thousand_may_be_too_large(large, scale):
    values = np.full(2000, 0.5, np.float32)
    values[:large] = 200
    assert decide_scale(values) == (scale, True)


@pytest.mark.parametrize(
    ("name", "content"),
    {
        "a.npy": npy(POINTS[:, :3].astype(">f8")),
        "a.pcd": pcd("binary", field="ring"),
        "a.ply": FILES["little.ply"].replace(b"scalar_Intensity", b"gps_time"),
    }.items(),
)
def test_missing_reflectance_is_zero(tmp_path, name, content):
    np.testing.assert_array_equal(read(tmp_path, name, content).points, POINTS * [1, 1, 1, 0])


def test_more_columns_than_four_are_left_out(tmp_path):
    assert np.array_equal(read(tmp_path, "a.npy", npy(np.hstack([POINTS, POINTS]))).points, POINTS)


SPOILT = POINTS.copy()
SPOILT[0, 1], SPOILT[1, 3], SPOILT[3, 2] = np.nan, np.inf, -np.inf


@pytest.mark.parametrize(
    ("name", "content"),
    {
        "a.bin": SPOILT.tobytes(),
        "a.npy": npy(SPOILT),
        "a.pcd": pcd("ascii", SPOILT),
        "a.ply": ply("binary_big_endian", SPOILT),
    }.items(),
)
def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path, name, content):
    scan = read(tmp_path, name, content)
    assert scan.dropped_points == 3
    np.testing.assert_array_equal(scan.points, POINTS[2:3])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npy", npy(POINTS[:0])),
        *(("a.pcd", pcd(encoding, POINTS[:0])) for encoding in ("ascii", "binary", "binary_compressed")),
        *(("a.ply", ply(encoding, POINTS[:0])) for encoding in ("ascii", "binary_little_endian")),
    ],
)
def test_well_formed_files_without_points_are_empty_scans(tmp_path, name, content):
    scan = read(tmp_path, name, content)
    assert scan.points.shape == (0, 4) and scan.dropped_points == 0


# --- what is wrong with a file, in one line


ASCII_PCD, ASCII_PLY = pcd("ascii"), ply("ascii")


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("a.bin", b"", "empty (0 bytes)"),
        ("a.bin", bytes(40), "40 bytes are no whole number of points of 16"),
        ("a.xyz", b"1 2 3", ", ".join(SCAN_SUFFIXES)),
        ("a.npy", npy(POINTS[:, 0].copy()), "(4,)"),
        ("a.npy", npy(POINTS)[:-1], "not an array of numbers"),
        ("a.npy", npy(np.array([["x"]], dtype=object)), "not an array of numbers"),
        ("a.npy", npy(POINTS).replace(b"(4, 4)", b"(10**12, 4)"), "not an array of numbers"),
        ("a.npy", npy(POINTS).replace(b"(4, 4)", b"(999999999999, 4)"), "not an array of numbers"),
        ("a.pcd", ASCII_PCD.replace(b" z ", b" Q "), "no field z"),
        ("a.pcd", ASCII_PCD.replace(b"TYPE U F", b"TYPE U Q"), "TYPE Q"),
        ("a.pcd", ASCII_PCD.replace(b"DATA ascii", b"DATA base64"), "DATA is 'base64'"),
        ("a.pcd", ASCII_PCD.replace(b"WIDTH 4", b"WIDTH 3"), "POINTS is 4 and WIDTH times"),
        ("a.ply", ASCII_PLY.replace(b"property float z", b"property float w"), "no field z"),
        ("a.ply", ASCII_PLY.replace(b"element vertex", b"element points"), "no element vertex"),
        ("a.ply", ASCII_PLY.replace(b"element face", b"element vertex"), "two elements vertex"),
        ("a.ply", ASCII_PLY.replace(b"uchar red", b"uchar x"), "2 fields x"),
        ("a.ply", ASCII_PLY.replace(b"format ascii", b"format utf8"), "the PLY format is utf8"),
        ("a.ply", ASCII_PLY.replace(b"float z", b"list uchar float z"), "list property"),
        ("a.ply", ASCII_PLY.replace(b"double y", b"quad y"), "quad y"),
        ("a.ply", b"solid cube", "no PLY header"),
    ],
    ids=range(20),  # by number: a pickled object's bytes hold an address, and parallel runs want the same names
)
def test_damaged_files_are_explained(tmp_path, name, content, word):
    with pytest.raises(ScanError) as caught:
        read(tmp_path, name, content)
    message = str(caught.value)
    assert str(tmp_path / name) in message and word in message and "\n" not in message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((f"{encoding}.pcd", pcd(encoding)) for encoding in ("ascii", "binary", "binary_compressed")),
        *((f"{encoding}.ply", ply(encoding)) for encoding in ("ascii", "binary_little_endian")),
    ],
)
def test_a_header_that_claims_too_much_costs_no_memory(tmp_path, name, content):
    claims = content
    for claim in (b"POINTS", b"vertex", b"WIDTH"):
        claims = claims.replace(claim + b" 4", claim + b" 1000000000000")
    with pytest.raises(ScanError, match=r"1000000000000 points|points need 27000000000000"):
        read(tmp_path, name, claims)
    with pytest.raises(ScanError):
        read(tmp_path, name, content.replace(b"strip 2", b"strip 1000000000000").replace(b"COUNT 3", b"COUNT 9999999"))


def test_a_path_without_a_readable_file(tmp_path):
    (tmp_path / "folder.bin").mkdir()
    for name in ("missing.bin", "folder.bin"):
        with pytest.raises(ScanError, match=rf"{name}: cannot be read"):
            read_scan(tmp_path / name)


# --- writing and finding


def test_what_is_written_is_read(tmp_path):
    write_scan(tmp_path / "new" / "a.bin", POINTS.astype(np.float64))
    assert (tmp_path / "new" / "a.bin").read_bytes() == FILES["a.bin"]
    for name, points, error, message in (
        ("b.bin", POINTS[:0], ScanError, "without points"),
        ("b.pcd", POINTS, ScanError, r"\.bin only"),
        ("b.bin", POINTS[:, :3], ValueError, r"\(4, 3\)"),
    ):
        with pytest.raises(error, match=message):
            write_scan(tmp_path / name, points)
