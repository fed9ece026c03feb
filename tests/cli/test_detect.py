"""`asca detect`: one result per scan whatever their names, one bad scan does not end the rest, and what it says."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from asca_deploy import sample_scan_path
from asca_deploy.result_files import ResultWriter
from asca_pillars.base.errors import OutputError, ScanError
from asca_pillars.cli.detect import detect
from asca_pillars.data.kitti import KittiSplit, read_labels
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.helpers.scenes import write_dataset

POINTS = read_scan(sample_scan_path()).points[::10].copy()


def test_dropped_points_and_arithmetic_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = POINTS.copy()
    points[:7, 0] = np.nan
    np.save(tmp_path / "scan.npy", points)
    detect([tmp_path / "scan.npy"], out=tmp_path / "out", threads=1, around=False)
    output = " ".join(capsys.readouterr().out.split())
    assert "scan.npy: 7 points are not finite and were dropped" in output and output.count("not finite") == 1
    assert "cpu int8, 1 threads" in output
    written = json.loads((tmp_path / "out" / "scan.json").read_text())
    assert (written["points_not_finite"], written["points"]) == (7, len(points) - 7)


def test_a_damaged_scan_is_named_and_the_others_are_detected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("1.bin", "3.bin"):
        write_scan(tmp_path / "mix" / name, POINTS)
    (tmp_path / "mix" / "\x1b[31m\n2.bin").write_bytes(b"torn")
    with pytest.raises(ScanError, match=r"1 of 3 scans could not be read"):
        detect([tmp_path / "mix"], out=tmp_path / "out", threads=1, pictures=False)
    for name in ("1.bin", "2.bin"):
        write_scan(tmp_path / "torn" / name, POINTS)
        (tmp_path / "torn" / name).write_bytes(b"torn")
    captured = capsys.readouterr()
    with pytest.raises(ScanError, match="none of the 2 scans can be read"):
        detect([tmp_path / "torn"], out=tmp_path / "none", threads=1)
    assert r"\x1b[31m\n2.bin: 4 bytes" in captured.err and "3.bin" in captured.out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"1.json", "3.json", "detections.jsonl"}


def test_scans_of_one_stem_keep_their_results_apart(tmp_path: Path) -> None:
    write_scan(tmp_path / "same" / "a.bin", POINTS)
    np.save(tmp_path / "same" / "a.npy", POINTS[:100])
    write_scan(tmp_path / "same" / "below" / "a.bin", POINTS)
    detect([tmp_path / "same"], out=tmp_path / "out", threads=1, pictures=False)
    names = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.json")}
    assert names == {"a.bin.json", "a.npy.json", "below/a.json"}


def test_one_file_holds_the_whole_run_line_by_line(tmp_path: Path) -> None:
    for name in ("1.bin", "2.bin"):
        write_scan(tmp_path / "drive" / name, POINTS)
    detect([tmp_path / "drive"], out=tmp_path / "out", threads=1)
    lines = [json.loads(line) for line in (tmp_path / "out" / "detections.jsonl").read_text().splitlines()]
    assert [Path(line["scan"]).name for line in lines] == ["1.bin", "2.bin"]
    assert lines == [json.loads((tmp_path / "out" / f"{name}.json").read_text()) for name in ("1", "2")]
    assert (tmp_path / "out" / "1_bev.png").is_file()


def test_a_folder_of_other_files_is_refused_and_one_of_an_earlier_run_is_not(tmp_path: Path) -> None:
    for name in ("1.bin", "2.bin"):
        write_scan(tmp_path / "scans" / name, POINTS)
    (tmp_path / "mine").mkdir()
    for name, content in (("1.json", "mine"), ("detections.jsonl", '{"mine": 1}')):
        (tmp_path / "mine" / name).write_text(content)
        with pytest.raises(OutputError, match=rf"holds {name} and nothing that `asca detect` wrote"):
            detect([tmp_path / "scans" / "1.bin"], out=tmp_path / "mine", threads=1)
        assert (tmp_path / "mine" / name).read_text() == content
        (tmp_path / "mine" / name).unlink()
    for scans in (tmp_path / "scans", tmp_path / "scans" / "2.bin"):
        detect([scans], out=tmp_path / "out", threads=1, pictures=False)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"1.json", "2.json", "detections.jsonl"}
    assert len((tmp_path / "out" / "detections.jsonl").read_text().splitlines()) == 1


def test_a_run_that_was_broken_off_can_be_given_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("1.bin", "2.bin"):
        write_scan(tmp_path / "scans" / name, POINTS)
    write = ResultWriter.__call__

    def stop_at_the_second(self: ResultWriter, path: Path, *rest: Any) -> None:
        if path.name == "2.bin":
            raise KeyboardInterrupt
        write(self, path, *rest)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ResultWriter, "__call__", stop_at_the_second)
        detect([tmp_path / "scans"], out=tmp_path / "out", threads=1, pictures=False)
    assert (tmp_path / "out" / "1.json").is_file()
    detect([tmp_path / "scans"], out=tmp_path / "out", threads=1, pictures=False)
    assert len((tmp_path / "out" / "detections.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize("name", ["1.json", "1.txt", "1_bev.png", "1_image.png", "recording.json", "tracks.txt"])
def test_a_file_of_somebody_else_in_an_earlier_run_s_folder_is_kept(tmp_path: Path, name: str) -> None:
    for scan in ("0.bin", "1.bin"):
        write_scan(tmp_path / "scans" / scan, POINTS)
    out = tmp_path / "out"
    detect([tmp_path / "scans" / "0.bin"], out=out, threads=1, pictures=False)
    (out / name).write_text('{"scan": "1.bin", "boxes": []}')
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(OutputError, match=f"{name}: `asca detect` did not write it and would replace it"):
        detect([tmp_path / "scans"], out=out, threads=1)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before, "refused before anything is written"


@pytest.mark.parametrize("name", ["detections.jsonl", "below/1.json", "below/1_bev.png", "below"])
def test_results_are_not_written_through_links(tmp_path: Path, name: str) -> None:
    write_scan(tmp_path / "scans" / "below" / "1.bin", POINTS)
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    detect([tmp_path / "scans"], out=out, threads=1)
    (out / name).rename(elsewhere)
    (out / name).symlink_to(elsewhere)
    before = [path.read_bytes() for path in (elsewhere, *elsewhere.rglob("*")) if path.is_file()]
    with pytest.raises(OutputError, match=f"{name}: is a link"):
        detect([tmp_path / "scans"], out=out, threads=1)
    assert [path.read_bytes() for path in (elsewhere, *elsewhere.rglob("*")) if path.is_file()] == before


def test_a_folder_may_be_given_as_a_link(tmp_path: Path) -> None:
    write_scan(tmp_path / "1.bin", POINTS)
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    for _ in range(2):
        detect([tmp_path / "1.bin"], out=tmp_path / "out", threads=1, pictures=False)
    assert {path.name for path in (tmp_path / "disk").iterdir()} == {"1.json", "detections.jsonl"}


def test_pictures_of_other_boxes_do_not_stay(tmp_path: Path) -> None:
    split = KittiSplit(write_dataset(tmp_path / "kitti", 2))
    for frame_id in split.frame_ids:
        write_scan(split.scan_path(frame_id), read_scan(sample_scan_path()).points[::4])
    scans, out = split.scan_path("000000").parent, tmp_path / "out"
    detect([scans], out=out, threads=1)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert before.keys() >= {"000000.txt", "000000_bev.png", "000001_bev.png"}
    detect([scans], out=out, threads=1, pictures=False)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before, "they are of the same boxes"
    detect([split.scan_path("000001")], out=out, threads=1, pictures=False, score=["0.99"])
    left = {path.name for path in out.iterdir()}
    assert left == before.keys() - {"000001_bev.png", "index.html"}, "other scans' stay"
    split.calib_path("000001").unlink()
    detect([split.scan_path("000001")], out=out, threads=1, pictures=False)
    assert {path.name for path in out.iterdir()} == left - {"000001.txt"}


def test_scans_may_have_the_names_of_other_results(tmp_path: Path) -> None:
    for name in ("recording.bin", "tracks.bin", "unreadable.bin"):
        write_scan(tmp_path / "scans" / name, POINTS)
    for _ in range(2):
        detect([tmp_path / "scans"], out=tmp_path / "out", threads=1, pictures=False)
    assert json.loads((tmp_path / "out" / "recording.json").read_text())["scan"].endswith("recording.bin")


def test_what_lies_beside_a_scan_is_used_or_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A calibration becomes KITTI text, and with an image a picture of the boxes in it."""
    split, out = KittiSplit(write_dataset(tmp_path / "kitti", 4)), tmp_path / "out"
    split.image_path("000000").parent.mkdir()
    cv2.imwrite(str(split.image_path("000000")), np.full((375, 1242, 3), 90, np.uint8))
    split.image_path("000001").write_bytes(b"no picture")
    split.calib_path("000002").write_text("P2: 1 2\n")
    split.calib_path("000003").unlink()
    detect([split.scan_path("000000").parent], out=out, threads=1, score=["0.02"])
    output, names = " ".join(capfd.readouterr().out.split()), {path.name for path in out.iterdir()}
    assert "000001.png: cannot be read as an image" in output
    assert names >= {"000000.txt", "000000_image.png", "000001.txt", "000002.json", "000002_bev.png", "000003.json"}
    assert not names & {"000001_image.png", "000002.txt", "000003.txt"}
    for item in read_labels(out / "000000.txt"):
        assert item.score is not None and 0 <= item.bbox[0] < item.bbox[2] <= 1242
    lines = (out / "detections.jsonl").read_text().splitlines()
    assert [Path(json.loads(line)["scan"]).stem for line in lines] == list(split.frame_ids)
    detect([split.scan_path("000002")], out=out, threads=1)  # of several remarks the first is said
    output = " ".join(capfd.readouterr().out.split())
    assert "no KITTI text is written: " in output and "000002.txt: " in output
