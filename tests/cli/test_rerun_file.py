"""`asca detect --rerun`: the file is read back, none of others is replaced, and a full disk ends it."""

import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_deploy.recordings import sequence_files
from asca_deploy.recordings.journal import JOURNAL_FILE
from asca_deploy.recordings.rerun_file import is_own_rrd
from asca_pillars.base.errors import ConfigError, OutputError
from asca_pillars.pictures.colors import class_rgb
from tests.cli.short_drive import SCANS
from tests.cli.test_detect_recording import run


def test_rerun_file_is_read_back(drive: Path, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="needs pip install -e '.[view]'")
    lines = run(drive, tmp_path / "out", track=True, rerun=tmp_path / "out.rrd")
    boxes: dict[int, list[str]] = {}
    points = arrows = 0
    colors: set[int] = set()
    for chunk in rerun.chunk.RrdReader(tmp_path / "out.rrd").stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/boxes":
            times, labels = batch["time"].cast("int64").to_pylist(), batch["Boxes3D:labels"].to_pylist()
            boxes |= dict(zip(times, labels, strict=True))
        if chunk.entity_path == "/scan":
            points += sum(map(len, batch["Points3D:positions"].to_pylist()))
        if chunk.entity_path == "/velocities":
            arrows += sum(map(len, batch["Arrows3D:vectors"].to_pylist()))
        if chunk.entity_path == "/boxes":
            colors |= {color for scan in batch["Boxes3D:colors"].to_pylist() for color in scan}
    assert arrows > 0
    spoken = {box["class"] for line in lines for box in line["boxes"]}
    assert {color >> 8 for color in colors} == {int.from_bytes(bytes(class_rgb(name))) for name in spoken}
    assert is_own_rrd(tmp_path / "out.rrd")
    assert boxes == {line["time_ns"]: [f"{box['class']} {box['track_id']}" for box in line["boxes"]] for line in lines}
    assert 1000 * SCANS < points <= 20_000 * SCANS


@pytest.mark.parametrize("content", [b"RRF2 of mine", b"asca-pillars"])
def test_an_rrd_of_others_is_not_replaced(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    monkeypatch.setattr(sequence_files, "require", lambda extra: None)
    with pytest.raises(ConfigError, match="choose such a name"):
        run(drive, tmp_path / "out", rerun=tmp_path / "boxes.mcap")
    (tmp_path / "mine.rrd").write_bytes(content)
    with pytest.raises(OutputError, match=r"mine\.rrd: `asca detect` did not write it and would replace it"):
        run(drive, tmp_path / "out", rerun=tmp_path / "mine.rrd")
    assert (tmp_path / "mine.rrd").read_bytes() == content and not (tmp_path / "out").exists()


def test_what_rerun_cannot_write_ends_the_run(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its library reports a full disk when it is asked to flush, and waits forever when it is asked to disconnect."""

    class Stream:
        def __init__(self, name: str) -> None:
            assert name

        def flush(self, *, timeout_sec: float) -> None:
            assert timeout_sec > 0
            raise RuntimeError("File-writer thread shut down prematurely")

        def disconnect(self) -> None:
            pytest.fail("it would wait forever")

        def save(self, path: Path) -> None:
            path.write_bytes(b"")

        def __getattr__(self, _: str) -> Any:
            return lambda *_, **__: None

    def nothing(*_: Any, **__: Any) -> None:
        """Stands for what is logged."""

    made = SimpleNamespace(RecordingStream=Stream, Points3D=nothing, Boxes3D=nothing, Arrows3D=nothing)
    made.blueprint = SimpleNamespace(Blueprint=nothing, Spatial3DView=nothing)
    monkeypatch.setitem(sys.modules, "rerun", made)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", made.blueprint)
    monkeypatch.setattr(sequence_files, "require", lambda extra: None)
    with pytest.raises(OSError, match=r"rerun cannot write \(File-writer .*is the disk full") as failure:
        run(drive, tmp_path / "out", rerun=tmp_path / "out.rrd")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {JOURNAL_FILE}
    assert failure.value.filename == str(tmp_path / "out.rrd") and not list(tmp_path.glob("*.rrd"))
    capsys.readouterr()
    lines = run(drive, tmp_path / "out", track=False)  # what was detected is not detected again, and is counted
    counts = Counter(box["class"] for line in lines for box in line["boxes"])
    said = " ".join(capsys.readouterr().out.split())
    assert f"{SCANS} scans, in all {counts['Car']} Car, {counts['Pedestrian']} Pedestrian" in said
