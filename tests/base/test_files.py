"""Writing files: all or nothing."""

import errno
import os
import stat
import sys
from pathlib import Path

import pytest

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import atomic_directory, atomic_path, file_inside, portable_name, remove_directory
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
        (atomic_path("/dev/null"), "no regular file"),
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
