"""Proposals on disk: computed once, whole or not at all, and never of another first stage."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import AscaError, DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.insertion.prepared import require_writable
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.models.two_stage.preparation import ProposalCache
from asca_pillars.ops.two_stage.first_stage import FirstStageSettings, run_first_stage
from asca_pillars.scans.scan_reader import write_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.scenes import SPEC, write_dataset
from tests.models.two_stage.random_stage import SETTINGS, RandomStage


@pytest.fixture
def split(tmp_path: Path) -> KittiSplit:
    return KittiSplit(write_dataset(tmp_path / "data", 2))


def test_reads_what_was_computed(split: KittiSplit, tmp_path: Path) -> None:
    stage = RandomStage()
    cache = ProposalCache(tmp_path / "prepared", "pool", stage, SETTINGS)
    cache.fill(split)
    for frame_id in split.frame_ids:
        expected = run_first_stage(RandomStage(), split.points(frame_id, camera_view=True), SETTINGS)
        found = cache.files.read(frame_id)
        for name in ("boxes", "scores", "labels"):
            np.testing.assert_array_equal(getattr(found.proposals, name), getattr(expected.proposals, name))
        np.testing.assert_array_equal(found.keypoints, expected.keypoints)
        np.testing.assert_allclose(found.bev, expected.bev, rtol=1e-3, atol=1e-6)


def test_several_processes_write_the_same(tmp_path: Path) -> None:
    split = KittiSplit(write_dataset(tmp_path / "data", 6))
    one, two = (ProposalCache(tmp_path / name, "pool", RandomStage(), SETTINGS) for name in ("one", "two"))
    one.fill(split)
    two.fill(split, workers=2)
    for frame_id in split.frame_ids:
        assert one.files.path(frame_id).read_bytes() == two.files.path(frame_id).read_bytes()


def add_line(path: Path) -> None:
    path.write_text(path.read_text() + "\n")


def leave_stamp_out(path: Path) -> None:
    with np.load(path) as arrays:
        kept = {name: arrays[name] for name in arrays.files if name != "stamp"}
    np.savez(path, **kept)  # type: ignore[arg-type]


CHANGES: dict[str, Callable[[KittiSplit, Path], object]] = {
    "missing": lambda _, path: path.unlink(),
    "damaged": lambda _, path: path.write_bytes(path.read_bytes()[:100]),
    "of nobody knows what": lambda _, path: leave_stamp_out(path),
    "another scan": lambda split, _: write_scan(split.scan_path("000001"), split.points("000000", camera_view=False)),
    "another calibration": lambda split, _: add_line(split.calib_path("000001")),
}


@pytest.mark.parametrize("change", CHANGES)
def test_only_what_is_missing_damaged_or_changed_is_computed_again(
    split: KittiSplit, tmp_path: Path, change: str
) -> None:
    stage = RandomStage()
    cache = ProposalCache(tmp_path / "prepared", "pool", stage, SETTINGS)
    cache.fill(split)
    assert stage.calls == 2
    CHANGES[change](split, cache.files.path("000001"))
    for _ in range(2):
        cache.fill(split)
        assert stage.calls == 3
    split.scan_path("000000").unlink()
    with pytest.raises(AscaError, match=r"000000\.bin"):
        cache.fill(split)
    same_scan = np.array_equal(cache.files.read("000001").keypoints, cache.files.read("000000").keypoints)
    assert same_scan == (change == "another scan")


def test_other_axes_are_other_proposals(tmp_path: Path) -> None:
    root = write_box_dataset(tmp_path / "own", 2)
    stage = RandomStage()
    cache = ProposalCache(tmp_path / "prepared", "pool", stage, SETTINGS)
    cache.fill(BoxSplit(root))
    (root / "dataset.yaml").write_text("axes: y-forward")
    cache.fill(BoxSplit(root))
    assert stage.calls == 4


def test_a_killed_run_leaves_no_half_file(split: KittiSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = ProposalCache(tmp_path / "prepared", "pool", RandomStage(), SETTINGS)

    def broken(file: object, **_: object) -> None:
        file.write(b"PK")  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", broken)
    with pytest.raises(KeyboardInterrupt):
        cache.fill(split)
    assert not list(cache.files.folder.glob("*.npz"))


def test_another_stage_or_setting_is_another_folder(tmp_path: Path) -> None:
    folders = {
        ProposalCache(tmp_path / "prepared", "pool", RandomStage(identity), settings, camera_view=view).files.folder
        for identity, settings, view in (
            ("a", SETTINGS, True),
            ("b", SETTINGS, True),
            ("a", FirstStageSettings(), True),
            ("a", SETTINGS, False),
        )
    }
    limited = dataclasses.replace(SPEC, limits=dataclasses.replace(SPEC.limits, max_points=8))
    folders.add(ProposalCache(tmp_path / "prepared", "pool", RandomStage("a", limited), SETTINGS).files.folder)
    assert len(folders) == 5
    assert ProposalCache(tmp_path / "prepared", "pool", RandomStage("a"), SETTINGS).files.folder in folders


def test_missing_and_damaged_files_are_named(split: KittiSplit, tmp_path: Path) -> None:
    cache = ProposalCache(tmp_path / "prepared", "pool", RandomStage(), SETTINGS)
    with pytest.raises(DatasetError, match=r"000000\.npz: no proposals"):
        cache.files.read("000000")
    cache.fill(split)
    path = cache.files.path(split.frame_ids[0])
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DatasetError, match=f"{path.name}: damaged"):
        cache.files.read(split.frame_ids[0])


def test_what_trains_with_inserted_objects_finds_a_folder_of_its_own(split: KittiSplit, tmp_path: Path) -> None:
    """Both keep what they compute in the dataset's folder; proposals of earlier versions left no note there."""
    prepared = tmp_path / "prepared"
    ProposalCache(prepared, "pool", RandomStage(), SETTINGS).fill(split)
    require_writable(prepared)
    (prepared / "README.txt").rename(next((prepared / "pool").iterdir()) / "README.txt")
    require_writable(prepared)
    assert (prepared / "README.txt").is_file()
