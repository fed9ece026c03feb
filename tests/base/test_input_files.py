"""Every reader refuses pipes, devices, sockets and pointers of Git LFS at once, and takes byte-order marks."""

import os
import shutil
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from asca_deploy import default_bundle_path
from asca_deploy.manifest import load_bundle
from asca_pillars.base.errors import AscaError
from asca_pillars.base.input_files import read_text
from asca_pillars.config.tree import load_config
from asca_pillars.data.boxes.box_records import read_frame_file, read_frames
from asca_pillars.data.kitti import read_calibration, read_labels
from asca_pillars.data.kitti.kitti_split import KittiSplit, read_image_set
from asca_pillars.scans.find_scans import SCAN_SUFFIXES, find_scans
from asca_pillars.scans.mounting import read_pose
from asca_pillars.scans.recordings.open_recording import open_recording
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.simulation import load_simulation_config

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
