"""Writing files: all or nothing."""

import os
import stat
from pathlib import Path

import pytest

from asca_pillars.files import atomic_directory, atomic_path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "new" / "result.json"
    with atomic_path(target) as temporary:
        temporary.write_text("{}")
        assert not target.exists()
        assert temporary.parent == target.parent and temporary.suffix == ".json"
    assert target.read_text() == "{}"
    assert names(target.parent) == ["result.json"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")
    with pytest.raises(RuntimeError, match="halfway"), atomic_path(str(target)) as temporary:
        temporary.write_text("ne")
        raise RuntimeError("halfway")
    assert target.read_text() == "old"
    assert names(tmp_path) == ["result.json"]


def test_a_file_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")
    with atomic_path(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"
    assert names(tmp_path) == ["result.json"]


@pytest.mark.skipif(os.name == "nt", reason="POSIX permissions")
def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    previous = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "file") as temporary:
            temporary.write_text("")
        with atomic_directory(tmp_path / "folder"):
            pass
    finally:
        os.umask(previous)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750


def test_a_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "models" / "bundle"
    with atomic_directory(target) as temporary:
        (temporary / "a.onnx").write_text("a")
        assert not target.exists()
    assert names(target) == ["a.onnx"]
    assert names(target.parent) == ["bundle"]


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    target = tmp_path / "bundle"
    target.mkdir()
    (target / "stale.onnx").write_text("old")
    with atomic_directory(target) as temporary:
        (temporary / "fresh.onnx").write_text("new")
        assert names(target) == ["stale.onnx"]
    assert names(target) == ["fresh.onnx"]
    assert names(tmp_path) == ["bundle"]


def test_a_failed_folder_leaves_the_old_one(tmp_path: Path) -> None:
    target = tmp_path / "bundle"
    target.mkdir()
    (target / "whole.onnx").write_text("old")
    with pytest.raises(RuntimeError, match="halfway"), atomic_directory(target) as temporary:
        (temporary / "half.onnx").write_text("new")
        raise RuntimeError("halfway")
    assert names(target) == ["whole.onnx"]
    assert names(tmp_path) == ["bundle"]


def test_the_old_folder_returns_if_the_new_one_cannot_take_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "bundle"
    target.mkdir()
    (target / "whole.onnx").write_text("old")
    replace = os.replace

    def refuse_the_new_one(source: Path, destination: Path) -> None:
        if destination == target and not Path(source).name.endswith("-old"):
            raise OSError("no")
        replace(source, destination)

    monkeypatch.setattr(os, "replace", refuse_the_new_one)
    with pytest.raises(OSError, match="no"), atomic_directory(target) as temporary:
        (temporary / "fresh.onnx").write_text("new")
    assert names(target) == ["whole.onnx"]
    assert names(tmp_path) == ["bundle"]
