"""`asca detect`: one result per scan whatever their names, one bad scan does not end the rest, and what it says."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from asca_deploy.result_files import ResultWriter
from asca_pillars.base.errors import OutputError, ScanError
from asca_pillars.cli.detect import detect
from asca_pillars.data.kitti import KittiSplit, read_labels
from asca_pillars.scans.scan_reader import write_scan
from tests.cli.short_drive import read_lines
from tests.deploy.conftest import make_scan
from tests.helpers.scenes import write_dataset

POINTS = make_scan(count=300)


@pytest.fixture(autouse=True)
def _tiny_model(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asca_deploy.shipped.default_bundle_path", lambda: bundle)


def write_scans(folder: Path, *names: str) -> Path:
    for name in names:
        write_scan(folder / name, POINTS)
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_dropped_points_and_arithmetic_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = POINTS.copy()
    points[:7, 0] = np.nan
    np.save(tmp_path / "scan.npy", points)
    detect([tmp_path / "scan.npy"], out=tmp_path / "out", threads=1, around=False)
    output = " ".join(capsys.readouterr().out.split())
    assert "scan.npy: 7 points are not finite and were dropped" in output and output.count("not finite") == 1
    assert "cpu float32, 1 threads" in output
    written = json.loads((tmp_path / "out" / "scan.json").read_text())
    assert (written["points_not_finite"], written["points"]) == (7, len(points) - 7)


def test_a_damaged_scan_is_named_and_the_others_are_detected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scans, out = write_scans(tmp_path / "mix", "1.bin", "3.bin"), tmp_path / "out"
    (scans / "\x1b[31m\n2.bin").write_bytes(b"torn")
    with pytest.raises(ScanError, match=r"1 of 3 scans could not be read"):
        detect([scans], out=out, pictures=False)
    captured = capsys.readouterr()
    assert r"\x1b[31m\n2.bin: file size (4 bytes)" in captured.err and "3.bin" in captured.out
    assert files(out).keys() == {"1.json", "3.json", "detections.jsonl"}
    for name in ("1.bin", "3.bin"):
        (scans / name).write_bytes(b"torn")
    with pytest.raises(ScanError, match="none of the 3 scans can be read"):
        detect([scans], out=tmp_path / "none")


def test_scans_of_one_stem_keep_their_results_apart(tmp_path: Path) -> None:
    scans = write_scans(tmp_path / "same", "a.bin", "below/a.bin")
    np.save(scans / "a.npy", POINTS[:100])
    detect([scans], out=tmp_path / "out", pictures=False)
    assert files(tmp_path / "out").keys() == {"a.bin.json", "a.npy.json", "below/a.json", "detections.jsonl"}


def test_a_folder_of_other_files_is_refused_and_one_of_an_earlier_run_is_not(tmp_path: Path) -> None:
    scans, out, mine = write_scans(tmp_path / "scans", "1.bin", "2.bin"), tmp_path / "out", tmp_path / "mine"
    mine.mkdir()
    for name, content in (("1.json", "mine"), ("detections.jsonl", '{"mine": 1}')):
        (mine / name).write_text(content)
        with pytest.raises(OutputError, match=rf"holds {name} and nothing that `asca detect` wrote"):
            detect([scans / "1.bin"], out=mine)
        assert (mine / name).read_text() == content
        (mine / name).unlink()
    detect([scans], out=out)
    lines = read_lines(out)
    assert [Path(line["scan"]).name for line in lines] == ["1.bin", "2.bin"]
    assert lines == [json.loads((out / f"{name}.json").read_text()) for name in ("1", "2")]
    assert (out / "1_bev.png").is_file()
    detect([scans / "2.bin"], out=out, pictures=False)
    assert files(out).keys() >= {"1.json", "2.json", "1_bev.png"}
    assert len(read_lines(out)) == 1


def test_a_run_that_was_broken_off_can_be_given_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans, out = write_scans(tmp_path / "scans", "1.bin", "2.bin"), tmp_path / "out"
    write = ResultWriter.__call__

    def stop_at_the_second(self: ResultWriter, path: Path, *rest: Any) -> None:
        if path.name == "2.bin":
            raise KeyboardInterrupt
        write(self, path, *rest)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ResultWriter, "__call__", stop_at_the_second)
        detect([scans], out=out, pictures=False)
    assert (out / "1.json").is_file()
    detect([scans], out=out, pictures=False)
    assert len(read_lines(out)) == 2


def test_a_file_of_somebody_else_in_an_earlier_run_s_folder_is_kept(tmp_path: Path) -> None:
    scans, out = write_scans(tmp_path / "scans", "0.bin", "1.bin"), tmp_path / "out"
    detect([scans / "0.bin"], out=out, pictures=False)
    for name in ("1.json", "1.txt", "1_bev.png", "1_image.png", "recording.json", "tracks.txt"):
        (out / name).write_text('{"scan": "1.bin", "boxes": []}')
        before = files(out)
        with pytest.raises(OutputError, match=f"{name}: `asca detect` did not write it and would replace it"):
            detect([scans], out=out)
        assert files(out) == before, "refused before anything is written"
        (out / name).unlink()


def test_results_are_not_written_through_links(tmp_path: Path) -> None:
    scans, out, elsewhere = write_scans(tmp_path / "scans", "below/1.bin"), tmp_path / "out", tmp_path / "elsewhere"
    detect([scans], out=out)
    for name in ("detections.jsonl", "below/1.json", "below/1_bev.png", "below"):
        (out / name).rename(elsewhere)
        (out / name).symlink_to(elsewhere)
        before = files(tmp_path)
        with pytest.raises(OutputError, match=f"{name}: is a link"):
            detect([scans], out=out)
        assert files(tmp_path) == before
        (out / name).unlink()
        elsewhere.rename(out / name)


def test_the_folder_may_be_a_link_and_scans_have_the_names_of_other_results(tmp_path: Path) -> None:
    scans = write_scans(tmp_path / "scans", "recording.bin", "tracks.bin", "unreadable.bin")
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    for _ in range(2):
        detect([scans], out=tmp_path / "out", pictures=False)
    names = {"detections.jsonl", "recording.json", "tracks.json", "unreadable.json"}
    assert files(tmp_path / "disk").keys() == names
    assert json.loads((tmp_path / "out" / "recording.json").read_text())["scan"].endswith("recording.bin")


def test_pictures_of_other_boxes_do_not_stay(tmp_path: Path) -> None:
    split = KittiSplit(write_dataset(tmp_path / "kitti", 2))
    scans, out = split.scan_path("000000").parent, tmp_path / "out"
    detect([scans], out=out)
    before = files(out)
    assert before.keys() >= {"000000.txt", "000000_bev.png", "000001_bev.png"}
    detect([scans], out=out, pictures=False)
    assert files(out) == before, "they are of the same boxes"
    detect([split.scan_path("000001")], out=out, pictures=False, score=["0.99"])
    left = files(out).keys()
    assert left == before.keys() - {"000001_bev.png", "index.html"}, "other scans' stay"
    split.calib_path("000001").unlink()
    detect([split.scan_path("000001")], out=out, pictures=False)
    assert files(out).keys() == left - {"000001.txt"}


def test_what_lies_beside_a_scan_is_used_or_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A calibration becomes KITTI text, and with an image a picture of the boxes in it."""
    split, out = KittiSplit(write_dataset(tmp_path / "kitti", 4)), tmp_path / "out"
    split.image_path("000000").parent.mkdir()
    cv2.imwrite(str(split.image_path("000000")), np.full((375, 1242, 3), 90, np.uint8))
    split.image_path("000001").write_bytes(b"no picture")
    split.calib_path("000002").write_text("P2: 1 2\n")
    split.calib_path("000003").unlink()
    detect([split.scan_path("000000").parent], out=out)
    output, names = " ".join(capfd.readouterr().out.split()), files(out).keys()
    assert "000001.png: cannot be read as an image" in output
    assert names >= {"000000.txt", "000000_image.png", "000001.txt", "000002.json", "000002_bev.png", "000003.json"}
    assert not names & {"000001_image.png", "000002.txt", "000003.txt"}
    items = read_labels(out / "000000.txt")
    for item in items:
        assert item.score is not None and 0 <= item.bbox[0] < item.bbox[2] <= 1242
    assert items and [Path(line["scan"]).stem for line in read_lines(out)] == list(split.frame_ids)
    detect([split.scan_path("000002")], out=out)  # of several remarks the first is said
    output = " ".join(capfd.readouterr().out.split())
    assert "no KITTI text is written: " in output and "000002.txt: " in output
