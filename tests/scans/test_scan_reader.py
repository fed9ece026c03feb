"""Every scan format, written here byte by byte, and what damaged files say."""

import os
import struct
import time
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from asca_pillars.base.errors import ScanError
from asca_pillars.scans import scan_reader
from asca_pillars.scans.find_scans import SCAN_SUFFIXES
from asca_pillars.scans.ply import MAX_LISTS
from asca_pillars.scans.records import points_from_array
from asca_pillars.scans.scan_reader import decide_scale, read_scan, write_scan
from asca_pillars.scans.scan_settings import folder_reflectance_scale
from tests.scans.scan_files import CHANGES, POINTS, assert_scan_or_scan_error, npy, pcd, ply, read, text

FILES = {
    "a.bin": POINTS.astype("<f4").tobytes(),
    "a.npy": npy(POINTS),
    "wide.npy": npy(np.hstack([POINTS, POINTS])),
    "ascii.pcd": pcd("ascii"),
    "binary.pcd": pcd("binary"),
    "compressed.PCD": pcd("binary_compressed"),
    "ascii.ply": ply("ascii"),
    "little.ply": ply("binary_little_endian"),
    "big.ply": ply("binary_big_endian"),
    "a.xyz": text(),
    "a.csv": text(",", "x,y,z,intensity\n"),
    "tabs.txt": text("\t", "//X (m)\tY (m)\tZ (m)\tReflectivity\n"),
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
@given(changes=CHANGES)
def test_a_file_with_wrong_bytes_is_a_scan_or_a_scan_error(tmp_path_factory, name, changes):
    assert_scan_or_scan_error(tmp_path_factory.mktemp("fuzz"), name, FILES[name], changes)


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
        ("a.bin", bytes(40), "file size (40 bytes) is not a multiple of 16"),
        ("a.e57", b"1 2 3", ", ".join(SCAN_SUFFIXES)),
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


def test_files_without_a_reader_or_too_large_for_memory(tmp_path, monkeypatch) -> None:
    (tmp_path / "folder.bin").mkdir()
    for name in ("missing.bin", "folder.bin"):
        with pytest.raises(ScanError, match=rf"{name}: cannot be read"):
            read_scan(tmp_path / name)

    def too_little(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(np, "fromfile", too_little)
    with pytest.raises(ScanError, match="64 bytes do not fit into memory"):
        read(tmp_path, "a.bin", POINTS.tobytes())


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


# --- well-formed files that are not what they seem


RNG = np.random.default_rng(0)
STREET = np.column_stack([RNG.uniform(-60, 60, (4000, 2)), RNG.uniform(-2, 3, 4000), RNG.beta(1, 3, 4000)]).astype("f4")
NUSCENES = np.column_stack([STREET, RNG.integers(0, 32, 4000)]).astype("f4")


def ascii_pcd(*rows: str, fields: str = "x y z i") -> bytes:
    width = len(fields.split())
    header = f"FIELDS {fields}\nSIZE{' 4' * width}\nTYPE{' F' * width}\nPOINTS {len(rows)}\nDATA ascii"
    return "\n".join([header, *rows, ""]).encode()


# --- what would take minutes or gigabytes


ENDLESS = b"strip 100000000000000000"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    {
        "many words in POINTS": ("a.pcd", ASCII_PCD.replace(b"POINTS 4", b"POINTS" + b" 9" * 20_000), "POINTS is"),
        "a million fields": ("a.pcd", ASCII_PCD.replace(b"normal", b"n " * 1_000_000), "no DATA line within"),
        "LZF bomb": (
            "a.pcd",
            pcd("binary_compressed")[:-120] + struct.pack("<2I", 20_000_002, 16) + b"\x00a" + b"\xe0\xff\x00" * 9**7,
            "unpacked bytes where",
        ),
        "many elements": ("a.ply", ASCII_PLY.replace(b"element camera", b"element c 1\n" * 9999), "no PLY header"),
        "empty lists": ("a.ply", FILES["little.ply"].replace(b"strip 2", ENDLESS), f"at most {MAX_LISTS}"),
        "many lines": ("a.ply", ASCII_PLY.replace(b"strip 2", ENDLESS), "0 lines where"),
    }.values(),
)
def test_bombs_are_refused_at_once(tmp_path, name, content, words):
    start = time.process_time()
    with pytest.raises(ScanError, match=words):
        read(tmp_path, name, content)
    assert time.process_time() - start < 10  # a minute and more before; no bar on speed


def test_a_feather_file_that_unpacks_to_gigabytes_is_refused_before_it_is_read(tmp_path):
    feather, pyarrow = pytest.importorskip("pyarrow.feather"), pytest.importorskip("pyarrow")
    columns = dict.fromkeys(("x", "y", "z", "intensity"), np.zeros(2**23 + 1, np.uint8))
    feather.write_feather(pyarrow.table(columns), tmp_path / "1.feather", compression="zstd")
    with pytest.raises(ScanError, match=r"1\.feather: 8388609 rows, at most 8388608 are read"):
        read_scan(tmp_path / "1.feather")


def test_files_with_too_many_points_are_refused_before_they_are_read(tmp_path, monkeypatch):
    (tmp_path / "a.bin").touch()
    os.truncate(tmp_path / "a.bin", 40 * 10**9)
    with pytest.raises(ScanError, match=r"a\.bin: 40000000000 bytes"):
        read_scan(tmp_path / "a.bin")
    monkeypatch.setattr(scan_reader, "MAX_POINTS", 3)
    with pytest.raises(ScanError, match="more than 3 points"):
        read(tmp_path, "b.bin", POINTS.tobytes())


# --- shifted columns


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.pcd", ascii_pcd("1 2 3", "1 2 3 .4", "1 2 3 .4 5"), "point 0 has 3 values where the fields need 4"),
        ("a.pcd", ascii_pcd("1 2 3 .4 5", fields="x y z i x"), "2 fields x"),
        ("a.ply", ply("ascii").replace(b" 70.125 1.0\n", b" 70.125\n"), "point 1 has 4 values where the fields need 5"),
    ],
)
def test_a_line_with_a_value_too_few_or_too_many_shifts_nothing(tmp_path, name, content, words):
    with pytest.raises(ScanError, match=words):
        read(tmp_path, name, content)


# --- the scale of reflectance


def test_bright_points_scales_and_masked_points(tmp_path) -> None:
    points = STREET.copy()
    points[5, 3] = 1.02
    for name, content in (("a.bin", points.tobytes()), ("a.npy", npy(points)), ("a.pcd", pcd("binary", points))):
        scan = read(tmp_path, name, content)
        np.testing.assert_allclose(scan.points[:, 3], np.minimum(points[:, 3], 1))
        assert (scan.notes.reflectance_scale, scan.notes.clipped_reflectances) == (1, 1)
    stored = points_from_array(np.ma.masked_greater(POINTS, 30))
    np.testing.assert_array_equal(stored.xyz, np.delete(POINTS[:, :3], 1, axis=0))
    assert stored.remarks == ("1 masked points left out",)


def scaled(brightness: float) -> bytes:
    return (STREET * np.array([1, 1, 1, brightness], np.float32)).tobytes()


@pytest.mark.parametrize("scale", [1, 255, 65535])
def test_scales_are_found_and_reported(tmp_path, scale):
    scan = read(tmp_path, "a.bin", scaled(scale))
    np.testing.assert_allclose(scan.points, STREET, atol=1e-6)
    assert (scan.notes.reflectance_scale, scan.notes.remarks) == (scale, ())


def test_a_scale_of_100_is_doubted_and_can_be_stated(tmp_path):
    assert "0..100" in read(tmp_path, "a.bin", scaled(100)).notes.remarks[0]
    scan = read_scan(tmp_path / "a.bin", reflectance_scale=100)
    np.testing.assert_allclose(scan.points, STREET, atol=1e-6)
    assert scan.notes.remarks == ()
    wrongs: tuple[Any, ...] = (0, -1, float("nan"), "bright")
    for wrong in wrongs:
        with pytest.raises(ScanError, match="reflectance_scale"):
            read_scan(tmp_path / "a.bin", reflectance_scale=wrong)


def test_a_folder_has_one_scale(tmp_path):
    """A dark scan, nothing above 1 of 255, among brighter ones, and one that is damaged."""
    paths = [tmp_path / f"{number}.bin" for number in range(5)]
    for path, content in zip(paths, (*map(scaled, (255, 255, 1, 255)), b"damaged"), strict=True):
        path.write_bytes(content)
    assert read_scan(paths[2]).notes.reflectance_scale == 1
    assert folder_reflectance_scale(paths) == (255, None)
    assert read_scan(paths[2], reflectance_scale=255).points[:, 3].max() <= 1 / 255


# --- columns


@pytest.mark.parametrize(
    ("stored", "said"),
    {
        "five": (NUSCENES, True),
        "five, not a multiple of four": (NUSCENES[:3999], True),
        "five, rings left out by an exporter": (NUSCENES * np.array([1, 1, 1, 1, 0], np.float32), True),
        "four": (STREET, False),
    }.values(),
)
def test_four_or_five_columns_are_found_and_five_are_said(tmp_path, stored, said):
    scan = read(tmp_path, "a.bin", stored.tobytes())
    np.testing.assert_array_equal(scan.points, stored[:, :4])
    assert ["5 columns" in remark for remark in scan.notes.remarks] == [True] * said


def test_columns_can_be_stated_and_are_asked_for_where_both_fit(tmp_path):
    (tmp_path / "a.bin").write_bytes(NUSCENES.tobytes())
    np.testing.assert_array_equal(read_scan(tmp_path / "a.bin", columns=5).points, STREET)
    assert len(read_scan(tmp_path / "a.bin", columns=4).points) == 5000
    (tmp_path / "b.bin").write_bytes(np.ascontiguousarray(STREET[:, :3]).tobytes())
    scan = read_scan(tmp_path / "b.bin", columns=3)
    np.testing.assert_array_equal(scan.points, STREET * np.array([1, 1, 1, 0], np.float32))
    assert scan.notes.reflectance_scale is None
    for wrong, words in ((7, "7 columns"), (2, "3 to 16"), (17, "3 to 16")):
        with pytest.raises(ScanError, match=words):
            read_scan(tmp_path / "a.bin", columns=wrong)
    with pytest.raises(ScanError, match=r"four columns .* or five .*state which"):
        read(tmp_path, "c.bin", np.arange(80, dtype="<f4").tobytes())


# --- arrays


def test_python_says_nothing_of_a_damaged_npy_header(tmp_path):
    """NumPy reads it as Python source, of which Python has opinions that users would see."""
    content = npy(POINTS.astype("<f4")).replace(b"'<f4', ", rb"'<f\d',")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with pytest.raises(ScanError, match="not an array of numbers"):
            read(tmp_path, "a.npy", content)
    assert [str(one.message) for one in said] == []


@pytest.mark.parametrize(
    ("array", "words"),
    [
        *((STREET.T[:rows], "transpose it") for rows in (3, 4)),
        *((np.zeros((5, 4), dtype), "real numbers") for dtype in ("c8", "U3", "M8[s]", "?", "O")),
    ],
)
def test_arrays_on_their_side_or_of_other_things_than_real_numbers_are_refused(array, words):
    with pytest.raises(ScanError, match=words):
        points_from_array(array)


@pytest.mark.parametrize("shape", [(4,), (2, 2)])
def test_records_are_read_by_the_names_of_their_fields(tmp_path, shape):
    records = np.zeros(
        shape, [("ring", "u1"), ("z", "<f4"), ("y", ">f8"), ("rgb", "u1", 3), ("x", "<f4"), ("intensity", "u1")]
    )
    records["x"], records["y"], records["z"] = (POINTS[:, axis].reshape(shape) for axis in range(3))
    records["intensity"] = [[0, 51], [102, 255]] if shape == (2, 2) else [0, 51, 102, 255]
    np.save(tmp_path / "a.npy", records)
    points = read_scan(tmp_path / "a.npy").points
    np.testing.assert_array_equal(points[:, :3], POINTS[:, :3])
    np.testing.assert_allclose(points[:, 3], [0, 0.2, 0.4, 1], rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ([("x", "f4"), ("y", "f4")], "no field z among x, y"),
        ([("x", "f4", 3), ("y", "f4"), ("z", "f4")], "x has 3 values per point"),
        ([("x", "f4"), ("y", "f4"), ("z", "U3")], "field z holds <U3"),
    ],
)
def test_records_without_coordinates_are_refused(fields, words):
    with pytest.raises(ScanError, match=words):
        points_from_array(np.zeros(3, fields))
