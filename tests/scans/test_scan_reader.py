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
    "content",
    {
        "b.npy": npy(POINTS * [1, 1, 1, 200]),
        "f.pcd": pcd("ascii", POINTS * np.array([1, 1, 1, 200], np.float32), kind="F4", field="reflectance"),
        "u.pcd": pcd("binary", POINTS * np.array([1, 1, 1, 200], np.float32), kind="U1", field="i"),
        "c.pcd": pcd("binary_compressed", POINTS * np.array([1, 1, 1, 200], np.float32), kind="U2"),
        "a.ply": ply("ascii", POINTS * np.array([1, 1, 1, 200], np.float32), kind="uchar"),
        "b.ply": ply("binary_big_endian", POINTS * np.array([1, 1, 1, 200], np.float32), kind="ushort"),
    }.items(),
    ids=lambda item: item[0],
)
def test_reflectance_of_0_to_255_comes_to_0_to_1(tmp_path, content):
    np.testing.assert_allclose(read(tmp_path, *content).points[:, 3], POINTS[:, 3] * 200 / 255, atol=1e-6)


def test_integers_are_of_0_to_255_even_in_a_dark_scan(tmp_path):
    dark = POINTS * np.array([1, 1, 1, 0], np.float32) + np.array([0, 0, 0, 1], np.float32)
    for name, content in (
        ("a.pcd", pcd("ascii", dark, kind="U1")),
        ("b.ply", ply("ascii", dark, kind="uchar")),
    ):
        np.testing.assert_allclose(read(tmp_path, name, content).points[:, 3], 1 / 255)
    np.testing.assert_allclose(read(tmp_path, "f.pcd", pcd("ascii", dark)).points[:, 3], 1)


@pytest.mark.parametrize(("large", "scale"), [(2, 1.0), (3, 255.0)])
def test_one_value_in_a_thousand_may_be_too_large(large, scale):
    values = np.full(2000, 0.5, np.float32)
    values[:large] = 200
    assert decide_scale(values) == (scale, True)


def test_missing_reflectance_is_zero(tmp_path):
    for name, content in (
        ("a.npy", npy(POINTS[:, :3].astype(">f8"))),
        ("a.pcd", pcd("binary", field="ring")),
        ("a.ply", FILES["little.ply"].replace(b"scalar_Intensity", b"gps_time")),
    ):
        points = read(tmp_path, name, content).points
        np.testing.assert_array_equal(points, POINTS * [1, 1, 1, 0])


def test_more_columns_than_four_are_left_out(tmp_path):
    assert np.array_equal(read(tmp_path, "a.npy", npy(np.hstack([POINTS, POINTS]))).points, POINTS)


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path):
    points = POINTS.copy()
    points[0, 1], points[1, 3], points[3, 2] = np.nan, np.inf, -np.inf
    for name, content in (
        ("a.bin", points.tobytes()),
        ("a.npy", npy(points)),
        ("a.pcd", pcd("ascii", points)),
        ("a.ply", ply("binary_big_endian", points)),
    ):
        scan = read(tmp_path, name, content)
        assert scan.dropped_points == 3
        np.testing.assert_array_equal(scan.points, POINTS[2:3])


def test_well_formed_files_without_points_are_empty_scans(tmp_path):
    none = POINTS[:0]
    for name, content in (
        ("a.npy", npy(none)),
        *((f"{encoding}.pcd", pcd(encoding, none)) for encoding in ("ascii", "binary", "binary_compressed")),
        *((f"{encoding}.ply", ply(encoding, none)) for encoding in ("ascii", "binary_little_endian")),
    ):
        scan = read(tmp_path, name, content)
        assert scan.points.shape == (0, 4)
        assert scan.dropped_points == 0


# --- what is wrong with a file, in one line


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.bin", b"", ["empty", "0 bytes"]),
        ("a.bin", bytes(40), ["40 bytes", "16"]),
        ("a.xyz", b"1 2 3", ["'.xyz'", *SCAN_SUFFIXES]),
        ("a.npy", npy(POINTS[:, 0].copy()), ["(4,)", "(N, 3)"]),
        ("a.npy", npy(POINTS.astype("c8")), ["complex64"]),
        ("a.npy", npy(POINTS)[:-1], ["a.npy", "again"]),
        ("a.npy", npy(np.array([["x"]], dtype=object)), ["not an array of numbers"]),
        ("a.npy", npy(POINTS).replace(b"(4, 4)", b"(10**12, 4)"), ["not an array of numbers"]),
        ("a.npy", npy(POINTS).replace(b"(4, 4)", b"(999999999999, 4)"), ["not an array of numbers"]),
        ("a.pcd", pcd("ascii").replace(b" z ", b" Q "), ["no field z", "intensity"]),
        ("a.pcd", pcd("ascii").replace(b"COUNT 3 1 1 2 1 1", b"COUNT 3 1 1 1 2 1"), ["z has 2 values"]),
        ("a.pcd", pcd("ascii").replace(b"SIZE 1 4", b"SIZE 4"), ["SIZE has 5 values for 6"]),
        ("a.pcd", pcd("ascii").replace(b"TYPE U F", b"TYPE U Q"), ["TYPE Q"]),
        ("a.pcd", pcd("ascii").replace(b"DATA ascii", b"DATA base64"), ["base64", "binary_compressed"]),
        ("a.pcd", pcd("ascii").replace(b"POINTS 4", b"POINTS -4"), ["POINTS"]),
        ("a.pcd", pcd("ascii").replace(b"-3.0", b"--3"), ["--3"]),
        ("a.pcd", b"P6 this is a picture\n", ["P6"]),
        ("a.ply", ply("ascii").replace(b"property float z", b"property float w"), ["no field z"]),
        ("a.ply", ply("ascii").replace(b"element vertex", b"element points"), ["no element vertex"]),
        ("a.ply", ply("ascii").replace(b"format ascii", b"format utf8"), ["utf8", "binary_big_endian"]),
        ("a.ply", ply("ascii").replace(b"float z", b"list uchar float z"), ["list"]),
        ("a.ply", ply("ascii").replace(b"double y", b"quad y"), ["quad y"]),
        ("a.ply", b"solid cube", ["header"]),
    ],
    ids=range(23),  # by number: a pickled object's bytes hold an address, and parallel runs want the same names
)
def test_damaged_files_are_explained(tmp_path, name, content, words):
    with pytest.raises(ScanError) as caught:
        read(tmp_path, name, content)
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(tmp_path / name), *words]:
        assert word in message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((f"{encoding}.pcd", pcd(encoding)) for encoding in ("ascii", "binary", "binary_compressed")),
        *((f"{encoding}.ply", ply(encoding)) for encoding in ("ascii", "binary_little_endian")),
    ],
)
def test_a_header_that_claims_too_much_costs_no_memory(tmp_path, name, content):
    claims = content.replace(b"POINTS 4", b"POINTS 1000000000000").replace(b"vertex 4", b"vertex 1000000000000")
    claims = claims.replace(b"WIDTH 4", b"WIDTH 1000000000000")
    assert claims != content
    with pytest.raises(ScanError, match=r"1000000000000 points|points need 27000000000000"):
        read(tmp_path, name, claims)
    with pytest.raises(ScanError):
        read(
            tmp_path,
            name,
            content.replace(b"strip 2", b"strip 1000000000000").replace(b"COUNT 3", b"COUNT 9999999"),
        )


def test_a_path_without_a_readable_file(tmp_path):
    (tmp_path / "folder.bin").mkdir()
    for name in ("missing.bin", "folder.bin"):
        with pytest.raises(ScanError, match=rf"{name}: cannot be read"):
            read_scan(tmp_path / name)


# --- writing and finding


def test_what_is_written_is_read(tmp_path):
    write_scan(tmp_path / "new" / "a.bin", POINTS.astype(np.float64))
    assert (tmp_path / "new" / "a.bin").read_bytes() == FILES["a.bin"]
    with pytest.raises(ScanError, match="without points"):
        write_scan(tmp_path / "b.bin", POINTS[:0])
    with pytest.raises(ScanError, match=r"\.bin only"):
        write_scan(tmp_path / "b.pcd", POINTS)
    with pytest.raises(ValueError, match=r"\(4, 3\)"):
        write_scan(tmp_path / "b.bin", POINTS[:, :3])
