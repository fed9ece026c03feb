"""`asca detect --rerun`: the file is read back, none of others is replaced, and a full disk ends it."""

import sys
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_deploy import sample_scan_path
from asca_deploy.recordings import sequence_files
from asca_deploy.recordings.rerun_file import is_own_rrd
from asca_deploy.recordings.results import JOURNAL_FILE
from asca_pillars.base.errors import ConfigError, OutputError, ScanError
from asca_pillars.cli.detect import detect
from asca_pillars.pictures.colors import class_rgb
from tests.cli.short_drive import SCANS, run
from tests.scans.recordings.cloud_recordings import clouds, compressed_image, image_message, stamps, store, write_mcap


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


def test_the_nearest_image_to_each_scan_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A camera of half the lidar's rate that ends early, and another one."""
    rerun = pytest.importorskip("rerun", reason="needs pip install -e '.[view]'")
    times, pixels = stamps(12), np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    stored: dict[int, bytes] = {}
    for time_ns in (times[0] + 1, times[2] + 1):
        _, picture = cv2.imencode(".jpg", pixels + len(stored))
        stored[time_ns] = picture.tobytes()
    one, kind = store(), "sensor_msgs/msg/Image"
    raw = [(time_ns, bytes(one.serialize_cdr(image_message(time_ns, pixels, "bgr8"), kind))) for time_ns in times[:1]]
    jpeg = [(time_ns, compressed_image(time_ns, content)) for time_ns, content in stored.items()]
    images = {"/front": ("sensor_msgs/msg/CompressedImage", "cdr", jpeg), "/rear": (kind, "cdr", raw)}
    path = write_mcap(tmp_path / "drive.mcap", {"/lidar": clouds(12, 2000)}, images=images)
    run(path, tmp_path / "out", rerun=tmp_path / "out.rrd")
    assert "images: of /front; --image-topic takes others of /front (" in " ".join(capsys.readouterr().out.split())
    logged, views = read_camera(rerun, tmp_path / "out.rrd")
    assert logged == [
        (times[0], "file", stored[times[0] + 1]),
        (times[2], "file", stored[times[2] + 1]),  # as near to the scan before
        (times[8], "clear", None),
    ]
    assert {"3D", "2D"} == views
    run(path, tmp_path / "out", rerun=tmp_path / "out.rrd", image_topic="/rear")
    logged, _ = read_camera(rerun, tmp_path / "out.rrd")
    assert logged[0] == (times[0], "pixels", pixels.tobytes()) and [kind for _, kind, _ in logged[1:]] == ["clear"]


def test_without_images_there_is_no_view_of_them(drive: Path, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="needs pip install -e '.[view]'")
    run(drive, tmp_path / "out", rerun=tmp_path / "out.rrd")
    assert read_camera(rerun, tmp_path / "out.rrd") == ([], {"3D"})
    with pytest.raises(ScanError, match="no images on a topic /camera; there are none"):
        run(drive, tmp_path / "other", rerun=tmp_path / "out.rrd", image_topic="/camera")
    with pytest.raises(ConfigError, match="--image-topic /camera: is shown in the file of --rerun"):
        run(drive, tmp_path / "other", image_topic="/camera")
    with pytest.raises(ConfigError, match="--image-topic and --calib need a recording"):
        detect([sample_scan_path()], out=tmp_path / "other", image_topic="/camera")


def read_camera(rerun: Any, path: Path) -> tuple[list[tuple[int, str, bytes | None]], set[str]]:
    """Time, kind and bytes of what is logged of the camera, and the kinds of views."""
    logged: list[tuple[int, str, bytes | None]] = []
    reader = rerun.chunk.RrdReader(path)
    fields = {"EncodedImage:blob": "file", "Image:buffer": "pixels", "Clear:is_recursive": "clear"}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path != "/camera":
            continue
        field = next(name for name in batch.schema.names if name in fields)
        for time_ns, (value,) in zip(batch["time"].cast("int64").to_pylist(), batch[field].to_pylist(), strict=True):
            logged.append((time_ns, fields[field], bytes(value) if fields[field] != "clear" else None))
    views = set()
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        if "ViewBlueprint:class_identifier" in batch.schema.names:
            views |= {kind for (kind,) in batch["ViewBlueprint:class_identifier"].to_pylist()}
    return sorted(logged), views


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

    made = MagicMock()
    stream = made.RecordingStream.return_value
    stream.flush.side_effect = RuntimeError("File-writer thread shut down prematurely")
    stream.disconnect.side_effect = AssertionError("it would wait forever")
    stream.save.side_effect = lambda path: path.write_bytes(b"")
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
    output = " ".join(capsys.readouterr().out.split())
    assert f"{SCANS} scans, in all {counts['Car']} Car, {counts['Pedestrian']} Pedestrian" in output
