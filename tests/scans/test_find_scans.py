"""Which files are scans, in which order, and that no two of them get one name for their results."""

import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from asca_pillars.base.errors import ScanError
from asca_pillars.base.files import atomic_path
from asca_pillars.data.insertion.prepared import require_writable
from asca_pillars.scans.find_scans import evenly_spaced, find_scans, name_scans
from asca_pillars.scans.scan_reader import read_scan


def touch(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


def names(*paths: Path) -> list[str]:
    return [scan.name.as_posix() for scan in name_scans(paths)]


def test_evenly_spaced() -> None:
    assert evenly_spaced("abcdefghij", 4) == ["a", "c", "f", "h"]
    assert evenly_spaced(range(5), 9) == [0, 1, 2, 3, 4]
    assert evenly_spaced([], 3) == []


def test_scans_stand_in_natural_order_and_links_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    touch(tmp_path, "10.bin", "2.bin", "b.npy", "9.pcd", "A1.PLY", "notes.txt", ".hidden.bin", ".cache/1.bin")
    assert [path.name for path in find_scans(tmp_path)] == ["2.bin", "9.pcd", "10.bin", "A1.PLY", "b.npy"]
    assert find_scans(str(tmp_path / "2.bin")) == [tmp_path / "2.bin"]
    real = touch(tmp_path / "real", "b/1.bin", "b/2.bin")
    scans = touch(tmp_path / "scans", "a/1.bin")
    (scans / "b").symlink_to(real / "b")
    (scans / "again").symlink_to(scans)
    (real / "b" / "home").symlink_to(scans)
    assert [scan.relative_to(scans).as_posix() for scan in find_scans(scans)] == ["a/1.bin", "b/1.bin", "b/2.bin"]


def test_folders_that_are_linked_crosswise_are_visited_once(tmp_path: Path) -> None:
    folders = [tmp_path / str(number) for number in range(9)]  # 9! ways through them
    for folder in folders:
        touch(folder, "a.bin")
    for folder in folders:
        for other in folders:
            (folder / f"to{other.name}").symlink_to(other)
    assert names(tmp_path) == [f"{number}/a" for number in range(9)], "by the path without a link"


def test_folders_deeper_than_python_calls_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    depth = 1010
    monkeypatch.chdir(tmp_path)
    for _ in range(depth):
        Path("d").mkdir()
        os.chdir("d")
    Path("a.bin").touch()
    monkeypatch.undo()
    start = time.process_time()
    (scan,) = name_scans([tmp_path])
    assert len(scan.name.parts) == depth + 1
    with atomic_path(tmp_path / "out" / scan.name) as temporary:
        temporary.touch()
    assert time.process_time() - start < 10  # 40 s before; no bar on speed
    subprocess.run(["rm", "-r", tmp_path / "d", tmp_path / "out"], check=True)  # deeper than rmtree goes


@pytest.mark.parametrize("letter", ["n", "ä"])
def test_names_that_are_too_long_for_results_are_shortened(tmp_path: Path, letter: str) -> None:
    longest = 251 // len(letter.encode()) * letter  # with its suffix 255 bytes
    touch(tmp_path, f"{longest}.bin", f"{longest[:-1]}x.bin", f"{letter * 100}.bin")
    found = names(tmp_path)
    assert len(set(found)) == 3 and letter * 100 in found
    for name in found:
        with atomic_path(tmp_path / f"{name}_image.png") as temporary:
            temporary.touch()


def test_links_to_nothing_are_named_when_they_are_read(tmp_path: Path) -> None:
    """As git-annex and DVC leave them where the content was not fetched."""
    touch(tmp_path, "1.bin", "9.bin")
    (tmp_path / "2.bin").symlink_to(tmp_path / "annex" / "content")
    (tmp_path / "3.bin").symlink_to(tmp_path / "3.bin")
    assert names(tmp_path) == ["1", "2", "3", "9"]
    with pytest.raises(ScanError, match=r"2\.bin: cannot be read \(No such file"):
        read_scan(tmp_path / "2.bin")


def test_what_was_prepared_for_training_holds_no_scans(tmp_path: Path) -> None:
    touch(tmp_path, "a/1.bin", "prepared/objects/train.npy", "prepared/objects/maps/2.npy", "other/3.npy")
    assert names(tmp_path) == ["a/1", "other/3", "prepared/objects/maps/2", "prepared/objects/train"]
    shutil.rmtree(tmp_path / "prepared")
    require_writable(tmp_path / "prepared")
    touch(tmp_path, "prepared/objects/train.npy")
    assert names(tmp_path) == ["a/1", "other/3"]
    with pytest.raises(ScanError, match="no scans in this folder"):
        find_scans(tmp_path / "prepared")


def test_what_is_no_scan_is_said_and_names_that_cannot_be_told_apart(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="no such file or folder"):
        find_scans(tmp_path / "missing")
    with pytest.raises(ScanError, match="no scans in this folder"):
        find_scans(touch(tmp_path, "notes.txt"))
    assert find_scans(tmp_path / "notes.txt") == [tmp_path / "notes.txt"], "what is named is read"
    touch(tmp_path, "p/x/1.bin", "q/x/1.bin")
    with pytest.raises(ScanError, match="would have one name"):
        name_scans([tmp_path / "p" / "x", tmp_path / "q" / "x"])


@pytest.mark.parametrize(
    ("files", "given", "expected"),
    [
        (["drive2/a/1.bin", "drive10/1.bin", "0.bin"], [""], ["0", "drive2/a/1", "drive10/1"]),
        (["a.bin", "a.npy", "b.bin"], [""], ["a.bin", "a.npy", "b"]),
        (["x/1.bin", "y/1.bin", "y/2.bin"], ["x", "y"], ["x/1", "y/1", "2"]),
        (["x/1.bin", "y/1.bin"], ["x/1.bin", "y/1.bin"], ["x/1", "y/1"]),
        (["x/1.bin"], ["", "x/1.bin", "x"], ["x/1"]),
    ],
)
def test_every_scan_has_one_name_of_its_own(
    tmp_path: Path, files: list[str], given: list[str], expected: list[str]
) -> None:
    touch(tmp_path, *files)
    assert names(*(tmp_path / path for path in given)) == expected


def test_names_stay_inside_the_folder_of_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, "x/1.bin", "1.bin")
    monkeypatch.chdir(tmp_path / "x")
    for name in map(Path, names(Path("../1.bin"), Path())):
        assert ".." not in name.parts and not name.is_absolute()
