"""Maps of free ground on disk: what is read is what was computed, and it is computed again when it has to be."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.insertion import free_space as free_maps
from asca_pillars.data.insertion.free_space import FreeSpace, find_free_space, load_free_space, prepare_free_spaces
from asca_pillars.data.kitti import KittiSplit, in_image
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.data.insertion.simple_streets import street, write_streets


@pytest.fixture
def split(tmp_path: Path) -> KittiSplit:
    return KittiSplit(write_streets(tmp_path / "data", 1))


def load(split: KittiSplit, prepared: Path, frame_id: str = "000000", camera_view: bool = False) -> FreeSpace:
    return load_free_space(split, frame_id, prepared, camera_view=camera_view)


def assert_same(a: FreeSpace, b: FreeSpace) -> None:
    assert np.array_equal(a.free, b.free) and np.array_equal(a.clusters, b.clusters)
    assert (a.ground is None) == (b.ground is None)
    if a.ground is not None and b.ground is not None:
        for field in dataclasses.fields(a.ground):
            one, other = getattr(a.ground, field.name), getattr(b.ground, field.name)
            assert np.array_equal(one, other) and one.dtype == other.dtype, field.name


def files(prepared: Path) -> list[Path]:
    return sorted(path for path in prepared.rglob("*.npz"))


def test_what_is_read_is_what_was_computed(split: KittiSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = tmp_path / "prepared"
    computed = find_free_space(read_scan(split.scan_path("000000")).points)
    assert computed.free.any() and len(computed.clusters)
    assert_same(load(split, prepared), computed)
    monkeypatch.setattr(free_maps, "find_free_space", lambda _: pytest.fail("computed again"))
    assert_same(load(split, prepared), computed)
    assert len(files(prepared)) == 1 and not list(prepared.rglob(".*"))


def test_the_camera_sees_less(split: KittiSplit, tmp_path: Path) -> None:
    prepared = tmp_path / "prepared"
    points = read_scan(split.scan_path("000000")).points
    seen = points[in_image(points, split.calibration("000000"))]
    assert len(seen) < len(points)
    assert_same(load(split, prepared, camera_view=True), find_free_space(seen))
    assert_same(load(split, prepared), find_free_space(points))
    assert len(files(prepared)) == 2


def test_another_scan_or_a_damaged_file_is_computed_again(split: KittiSplit, tmp_path: Path) -> None:
    prepared = tmp_path / "prepared"
    before = load(split, prepared)
    points = street(7)[0]
    write_scan(split.scan_path("000000"), points)
    os.utime(split.scan_path("000000"), ns=(1, 1))
    after = load(split, prepared)
    assert_same(after, find_free_space(points))
    assert not np.array_equal(before.free, after.free)
    whole = files(prepared)[0].read_bytes()
    for damaged in (b"", b"nonsense", whole[: len(whole) // 2], whole[:-4] + b"1234"):
        files(prepared)[0].write_bytes(damaged)
        assert_same(load(split, prepared), after)


def test_a_scan_without_ground_is_remembered_as_such(split: KittiSplit, tmp_path: Path) -> None:
    prepared = tmp_path / "prepared"
    write_scan(split.scan_path("000000"), np.array([[9, 0, 0, 0.5]], np.float32))
    for _ in range(2):
        space = load(split, prepared)
        assert space.ground is None and not space.free.any()
    assert len(files(prepared)) == 1


def test_all_at_once_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_maps, "_AT_ONCE", 1)  # three frames are too few for two processes otherwise
    split = KittiSplit(write_streets(tmp_path / "data", 3), "train")
    prepare_free_spaces(split, tmp_path / "all", camera_view=True, workers=2)
    for frame_id in split.frame_ids:
        load(split, tmp_path / "each", frame_id, camera_view=True)
    at_once, one_by_one = files(tmp_path / "all"), files(tmp_path / "each")
    assert len(at_once) == len(one_by_one) == 3
    assert [path.read_bytes() for path in at_once] == [path.read_bytes() for path in one_by_one]


def test_a_folder_that_cannot_be_written_is_named(split: KittiSplit, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    prepared = tmp_path / "file" / "prepared"
    for attempt in (
        lambda: load(split, prepared),
        lambda: prepare_free_spaces(split, prepared, camera_view=True, workers=1),
    ):
        with pytest.raises(DatasetError, match=r"file/prepared/.*: cannot be written.*data\.prepared") as caught:
            attempt()
        assert "\n" not in str(caught.value)
