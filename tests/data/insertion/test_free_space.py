"""Free ground on made-up streets, where it is known what stands and what is hidden."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import MultiPoint, Point

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.insertion import free_space as free_maps
from asca_pillars.data.insertion.free_space import (
    CELL_M,
    FreeSpace,
    _azimuth_bin,
    find_free_space,
    load_free_space,
    prepare_free_spaces,
)
from asca_pillars.data.insertion.ground_fit import cluster_boxes, fit_ground
from asca_pillars.data.kitti import KittiSplit, in_image
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.data.insertion.simple_streets import AZIMUTHS_RAD, LEVEL, cast, polygons, stand, street, write_streets

BOXES = np.array(
    [stand("Car", 10, 3, 0.3), stand("Car", 15, -4, 1.2), stand("Pedestrian", 9, -1), stand("Cyclist", 20, 1, 2.0)]
)


def middles(space: FreeSpace) -> np.ndarray:
    return space.cells[0].T


def along_rays(ground: np.ndarray, start: float, end: float) -> np.ndarray:
    """(100 n, 3) along the sight lines to points (n, 2) of the ground."""
    return (np.linspace(start, end, 100)[:, None, None] * np.insert(ground, 2, LEVEL[2], axis=1)).reshape(-1, 3)


def test_ground_is_free_where_it_is_seen_and_nothing_stands() -> None:
    space = find_free_space(cast(LEVEL, BOXES))
    free = middles(space)
    assert len(free) > 5000
    assert np.abs(np.arctan2(free[:, 1], free[:, 0])).max() < AZIMUTHS_RAD.max() + 0.05, "nothing beside the view"
    assert not space.is_free(np.array([[-5.0, 0.0], [1e6, 0.0], [10.0, 30.0]])).any()
    clusters = polygons(space.clusters)
    assert len(clusters) == len(BOXES)
    for outline in polygons(BOXES):
        assert sum(outline.intersects(cluster) for cluster in clusters) == 1
    # The lowest returns of a side may pass for ground: its own cell, no more, may be free.
    outlines = [outline.buffer(-CELL_M) for outline in polygons(BOXES)]
    assert not any(outline.contains(Point(xy)) for xy in free for outline in outlines)

    # A sight line to the ground between a box and the end of its shadow passes through the box.
    inside = points_in_boxes(along_rays(free, 0.02, 0.98), BOXES, margin_m=-0.15).any(axis=1)
    assert inside.reshape(100, -1).any(axis=0).mean() < 0.01

    # Nearly everything else within 20 m, cell by cell, is free, although the rings there are metres apart.
    grid = np.meshgrid(np.arange(6, 20, CELL_M), np.arange(-6, 6, CELL_M), indexing="ij")
    every = np.stack(grid, axis=-1).reshape(-1, 2)
    every = every[np.abs(np.arctan2(every[:, 1], every[:, 0])) < AZIMUTHS_RAD.max() - 0.02]
    inside = points_in_boxes(along_rays(every, 0.02, 1), BOXES, margin_m=0.4).any(axis=1)
    clear = every[~inside.reshape(100, -1).any(axis=0)]
    assert len(clear) > 1000 and space.is_free(clear).mean() > 0.97


@pytest.mark.parametrize(("slope", "some"), [(0.03, True), (0.12, False)])
def test_steep_ground_is_not_free(slope: float, some: bool) -> None:
    space = find_free_space(cast((0.0, slope, -1.73), BOXES[:0]))
    assert space.ground is not None and space.free.any() == some


def test_rectangles_are_the_smallest_and_two_walls_do_not_take_the_yard() -> None:
    points = cast(LEVEL, BOXES)
    ground = fit_ground(points)
    assert ground is not None
    standing = points[points_in_boxes(points, BOXES).any(axis=1) & (points[:, 2] > LEVEL[2] + 0.25)].astype(float)
    found = cluster_boxes(standing, ground)
    inside = points_in_boxes(standing, found, margin_m=1e-3)
    assert inside.any(axis=1).all()
    for box, own in zip(found, inside.T, strict=True):
        smallest = MultiPoint(standing[own, :2]).minimum_rotated_rectangle
        assert box[3] * box[4] == pytest.approx(smallest.area, rel=0.01, abs=0.01)
        assert box[2] - box[5] / 2 == pytest.approx(LEVEL[2], abs=0.1)
    # A cluster of 20 m by 20 m; its one rectangle would hold everything in the corner.
    walls = np.array([[30.0, 0.0, -0.5, 0.3, 20.0, 2.5, 0.0], [20.0, -10.0, -0.5, 20.0, 0.3, 2.5, 0.0]], np.float32)
    space = find_free_space(cast(LEVEL, walls))
    assert space.clusters[:, 3:5].max() < 8
    assert space.is_free(np.array([[20.0, 0.0], [25.0, -5.0]])).all()


@pytest.mark.parametrize(("height_m", "free"), [(1.5, False), (4.0, True)])
def test_under_branches_the_ground_is_free(height_m: float, free: bool) -> None:
    """Branches above the height of people and cars neither block a place nor form a cluster."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(9, 12, 0.1), np.arange(-1, 1, 0.1)))
    leaves = np.column_stack([x, y, np.full(x.size, LEVEL[2] + height_m), np.full(x.size, 0.3)]).astype(np.float32)
    space = find_free_space(np.concatenate([cast(LEVEL, BOXES[:0]), leaves]))
    assert space.is_free(np.array([[10.0, 0.0], [11.0, 0.5]])).tolist() == [free, free]
    assert len(space.clusters) == (0 if free else 1)


@pytest.mark.parametrize("points", [np.zeros((0, 4), np.float32), np.full((50, 4), 5, np.float32)])
def test_nothing_is_free_without_ground(points: np.ndarray) -> None:
    space = find_free_space(points)
    assert space.ground is None and not len(middles(space)) and space.clusters.shape == (0, 7)
    assert not space.is_free(np.zeros((3, 2))).any()


def test_azimuths_are_equally_wide_and_cells_agree_with_lookups() -> None:
    """Straight ahead, where the angle changes its sign, too."""
    angle = np.radians(np.arange(-180, 180, 0.1) + 0.05)
    assert (np.bincount(_azimuth_bin(np.cos(angle), np.sin(angle))) == 4).all()
    space = find_free_space(street(3)[0])
    assert len(middles(space)) == space.free.sum() > 0 and space.is_free(middles(space)).all()
    x, y = middles(space).T
    assert np.array_equal(space.cells[1], np.hypot(x, y))


# --- maps on disk


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
