"""Writing files: all or nothing.

Every reader refuses pipes, devices, sockets and pointers of Git LFS at once, and takes byte-order marks.
"""

import errno
import os
import shutil
import socket
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from asca_deploy import default_bundle_path
from asca_deploy.manifest import load_bundle
from asca_pillars.base.errors import AscaError, OutputError
from asca_pillars.base.files import (
    atomic_directory,
    atomic_path,
    file_inside,
    portable_name,
    read_text,
    remove_directory,
)
from asca_pillars.config.tree import load_config
from asca_pillars.data.boxes.box_records import read_frame_file, read_frames
from asca_pillars.data.kitti import read_calibration, read_labels
from asca_pillars.data.kitti.kitti_split import KittiSplit, read_image_set
from asca_pillars.scans.find_scans import SCAN_SUFFIXES, find_scans
from asca_pillars.scans.mounting import read_pose
from asca_pillars.scans.recordings.recorded_scans import open_recording
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.simulation import load_simulation_config
from tests.helpers.bundle_folder import EXPORT, names, old_bundle


@pytest.mark.parametrize("name", ["result.json", f"{'é' * 120}.json"])  # and one as long as a file system takes
def test_a_file_has_its_name_when_it_is_complete_and_the_old_one_stays_until_then(tmp_path: Path, name: str) -> None:
    target = tmp_path / "new" / name
    for old, new in ((None, "{}"), ("{}", "[]")):
        with atomic_path(target) as temporary:
            temporary.write_text(new)
            assert (target.read_text() if target.exists() else None) == old
            assert temporary.parent == target.parent and temporary.suffix == ".json"
        assert target.read_text() == new
    with pytest.raises(RuntimeError, match="halfway"), atomic_path(str(target)) as temporary:
        temporary.write_text("ne")
        raise RuntimeError("halfway")
    assert target.read_text() == "[]" and names(target.parent) == [name]


@pytest.mark.skipif(os.name == "nt", reason="POSIX permissions")
def test_permissions_follow_the_umask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    previous = os.umask(0o027)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "umask", lambda _: pytest.fail("to read it is to change it for all threads"))
            with atomic_path(tmp_path / "file"), atomic_directory(tmp_path / "folder", *EXPORT):
                pass
    finally:
        os.umask(previous)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750


def test_a_folder_has_its_name_when_it_is_complete_and_is_replaced_as_a_whole(tmp_path: Path) -> None:
    target = tmp_path / "models" / "bundle"
    with atomic_directory(target, *EXPORT) as temporary:
        (temporary / "bundle.json").write_text('{"file": "a.onnx"}')
        (temporary / "a.onnx").write_text("a")
        assert not target.exists()
    with pytest.raises(RuntimeError, match="halfway"), atomic_directory(target, *EXPORT) as temporary:
        (temporary / "half.onnx").write_text("new")
        raise RuntimeError("halfway")
    with atomic_directory(target, *EXPORT) as temporary:
        (temporary / "fresh.onnx").write_text("new")
        assert names(target) == ["a.onnx", "bundle.json"]
    assert names(target) == ["fresh.onnx"] and names(target.parent) == ["bundle"]
    # A foreign file that appears meanwhile is kept; the rule is tested in test_own_files.
    (target / "bundle.json").write_text('{"file": "fresh.onnx"}')
    with pytest.raises(OutputError, match="notes"), atomic_directory(target, *EXPORT) as temporary:
        (temporary / "bundle.json").write_text("new")
        (target / "notes").write_text("precious")
    assert names(target) == ["bundle.json", "fresh.onnx", "notes"] and names(target.parent) == ["bundle"]


def test_the_old_folder_returns_if_the_new_one_cannot_take_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, replace = old_bundle(tmp_path / "bundle"), os.replace

    def refuse_the_new_one(source: Path, destination: Path) -> None:
        if destination == target and not Path(source).name.endswith("-old"):
            raise OSError("no")
        replace(source, destination)

    monkeypatch.setattr(os, "replace", refuse_the_new_one)
    with pytest.raises(OSError, match="no"), atomic_directory(target, *EXPORT) as temporary:
        (temporary / "fresh.onnx").write_text("new")
    assert names(target) == ["a.onnx", "bundle.json"] and names(tmp_path) == ["bundle"]


def test_one_s_own_folder_is_removed_and_nobody_else_s(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for removed in (tmp_path / "absent", old_bundle(tmp_path / "bundle"), tmp_path / "empty"):
        remove_directory(removed, *EXPORT)
    assert names(tmp_path) == ["empty"]
    theirs = old_bundle(tmp_path / "theirs")
    (theirs / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"notes\.txt"):
        remove_directory(theirs, *EXPORT)
    assert names(theirs) == ["a.onnx", "bundle.json", "notes.txt"]


@pytest.mark.parametrize("there", [True, False])
def test_nothing_is_written_through_a_link_or_over_what_is_no_file(tmp_path: Path, there: bool) -> None:
    if there:
        old_bundle(tmp_path / "theirs")
    (tmp_path / "file").symlink_to("theirs/a.onnx")
    (tmp_path / "folder").symlink_to("theirs")
    link = "is a link, and nothing is written through links"
    for writing, message in (
        (atomic_path(tmp_path / "file"), link),
        (atomic_directory(tmp_path / "folder", *EXPORT), link),
        (atomic_path(tmp_path), "is a folder"),
        (atomic_path("/dev/null"), "not a regular file"),
    ):
        with pytest.raises(OutputError, match=message), writing:
            raise AssertionError("not reached")
    with pytest.raises(OutputError, match="folder: is a link"):
        remove_directory(tmp_path / "folder", *EXPORT)
    assert names(tmp_path) == ["file", "folder", *["theirs"] * there]
    assert not there or (tmp_path / "theirs" / "a.onnx").read_text() == "old"


# --- the system's errors, the disk, other threads


def test_a_full_disk_and_a_folder_that_takes_no_file_are_told_by_the_file_s_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for writing in (atomic_path(tmp_path / "a.ckpt"), atomic_directory(tmp_path / "a.ckpt", *EXPORT)):
        with pytest.raises(OSError, match=r"a\.ckpt") as full, writing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert (full.value.errno, full.value.filename) == (errno.ENOSPC, str(tmp_path / "a.ckpt"))
    assert names(tmp_path) == []

    def refuse(path: Path, *_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(PermissionError) as caught, atomic_path(tmp_path / "a.json"):
        pass
    assert caught.value.filename == str(tmp_path / "a.json")


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_files_and_folders_are_synced_before_they_get_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(str(Path(f"/proc/self/fd/{handle}").readlink())))
    with atomic_path(tmp_path / "a.txt") as file:
        assert synced == []
    with atomic_directory(tmp_path / "b", *EXPORT) as folder:
        (folder / "bundle.json").write_text('{"file": ""}')
    expected = [file, tmp_path, folder / "bundle.json", folder, tmp_path]
    assert synced == [str(path) for path in expected]


HARMFUL = [
    *("", ".", "..", "../../x", "/etc/passwd", "a/b", "a\\b", "C:x", "a\nb", "a b"),
    *("-x", ".x", "x.", "NUL", "com1.txt"),
]


@pytest.mark.parametrize("text", [*HARMFUL, "a" * 101, "\0", "\udc80", "ü", "\u2028"])
def test_any_text_is_one_plain_name(text: str, tmp_path: Path) -> None:
    name = portable_name(text)
    assert len(name) <= 100 and set(name) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-")
    assert (tmp_path / name).resolve().parent == tmp_path.resolve()
    (tmp_path / name).touch(exist_ok=False)
    assert portable_name(name) == name
    assert name.partition(".")[0].casefold() not in ("nul", "com1")


def test_different_texts_have_different_names_and_plain_ones_stay() -> None:
    plain = ["1000", "segment-10_a.b", "0", "a" * 100, "_", "a_b", "x"]
    assert [portable_name(text) for text in plain] == plain
    texts = [*HARMFUL, "_", "a_b", "a?b", "a*b", "x", "ä", "ö"]
    assert len({portable_name(text) for text in texts}) == len(texts)


def test_a_name_from_data_leads_nowhere_else(tmp_path: Path) -> None:
    folder, file, secret = tmp_path / "data", tmp_path / "data" / "a" / "x.bin", tmp_path / "secret"
    file.parent.mkdir(parents=True)
    for path in (file, secret):
        path.touch()
    assert file_inside(folder, "a/x.bin") == file
    outside = ["../secret", str(secret), "a/../../secret", "a/../a/x.bin"]
    for name in (*outside, "", "a", "none", "a\0", "x" * 5000, "a/" * 3000 + "x"):
        assert file_inside(folder, name) is None


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d7a" * 16 + b"\nsize 131072\n"


def _copied_bundle(path: Path) -> Any:
    """Of the default bundle all but the file at `path`."""
    for file in default_bundle_path().iterdir():
        if file.suffix in (".json", ".onnx") and file.name != path.name:
            shutil.copy(file, path.parent / file.name)
    return load_bundle(path.parent)


def _checkpoint(path: Path) -> Any:
    pytest.importorskip("torch")
    from asca_pillars.models.build import load_checkpoint
    from asca_pillars.models.openpcdet.import_checkpoint import read_foreign

    return load_checkpoint(path) if path.suffix == ".ckpt" else read_foreign(path)


READERS: dict[str, Callable[[Path], Any]] = {
    **{f"scan{suffix}": read_scan for suffix in SCAN_SUFFIXES},
    **{f"drive{suffix}": open_recording for suffix in (".mcap", ".db3", ".bag", ".mcap.zstd", ".db3.zst")},
    "boxes.json": read_frame_file,
    "boxes.csv": lambda path: list(read_frames(path)),
    "boxes.jsonl": lambda path: list(read_frames(path)),
    "label_2/000000.txt": read_labels,
    "calib/000000.txt": read_calibration,
    "pose.txt": read_pose,
    "config.yaml": load_config,
    "simulation.yaml": lambda path: load_simulation_config(str(path)),
    "ImageSets/val.txt": lambda path: read_image_set(path.parents[1], path.stem),
    "training/image_2/000000.png": lambda path: KittiSplit(path.parents[2]).image_size_wh(path.stem),
    "bundle.json": _copied_bundle,
    "encoder.onnx": _copied_bundle,
    "last.ckpt": _checkpoint,
    "pv_rcnn.pth": _checkpoint,
}


def placed(tmp_path: Path, name: str) -> Path:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if name.startswith("training"):
        (tmp_path / "training" / "velodyne").mkdir()
        (tmp_path / "training" / "velodyne" / "000000.bin").touch()
    return path


@pytest.mark.skipif(sys.platform == "win32", reason="has no such files")
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["a named pipe", "a device", "a pointer of Git LFS"])
def test_what_would_be_read_without_end_and_what_is_a_pointer_is_refused(tmp_path: Path, name: str, kind: str) -> None:
    path = placed(tmp_path, name)
    if kind == "a pointer of Git LFS":
        path.write_bytes(POINTER)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    else:
        os.mkfifo(path)
    with pytest.raises(AscaError, match="git lfs pull" if "Git" in kind else f"is {kind}") as refusal:
        READERS[name](path)
    assert name in str(refusal.value)


@pytest.mark.skipif(sys.platform == "win32", reason="has no such files")
def test_sockets_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # their names are short
    with socket.socket(socket.AF_UNIX) as one:
        one.bind("a.bin")
        with pytest.raises(AscaError, match="is a socket"):
            find_scans("a.bin")
        assert [path.name for path in find_scans(tmp_path)] == ["a.bin"], "named and left out when it is read"


def test_a_byte_order_mark_is_no_content(tmp_path: Path) -> None:
    manifest = (default_bundle_path() / "bundle.json").read_bytes()
    for name, content in (
        ("a.txt", b"1"),
        ("pose.txt", b"1 0 0 0\r\n0 1 0 0\r\n0 0 1 0\r\n0 0 0 1\r\n"),
        ("config.yaml", b"name: marked\r\n"),
        ("bundle.json", manifest),
    ):
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + content)
    assert read_text(tmp_path / "a.txt", AscaError) == "1"
    assert read_pose(tmp_path / "pose.txt")[0] == (1, 0, 0, 0)
    assert load_config(tmp_path / "config.yaml").name == "marked"
    assert _copied_bundle(tmp_path / "bundle.json").name == load_bundle(default_bundle_path()).name
