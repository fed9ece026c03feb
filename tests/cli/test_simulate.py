"""`asca simulate --report` as a user meets it: when it simulates, what it compares, what it leaves alone."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from asca_pillars.base import installation
from asca_pillars.base.errors import AscaError, ConfigError, DatasetError, OutputError
from asca_pillars.cli import simulate as command
from tests.sim.report.made_up import write_set


def simulate(out: Path, frames: int | None, *, view: str | None = "camera", report: bool = True) -> None:
    command.simulate(out, frames=frames, workers=1, view=view, val_share=0.5, report=report)


def written(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_frames_are_simulated_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate(tmp_path, 2)
    told = capsys.readouterr().out
    assert "2 frames below" in told and "points in camera view" in told and "bars kept" in told
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert names == {"report.md", "report.json", "cars.png", "labels.png", "reflectance.png"}
    before = written(tmp_path)
    simulate(tmp_path, None, view=None)
    assert "frames below" not in capsys.readouterr().out, "what is there is compared as it is"
    assert written(tmp_path) == before


def test_scans_that_were_not_simulated_are_compared_and_never_added_to(tmp_path: Path) -> None:
    """And a report of somebody else is not replaced."""

    def scans() -> dict[str, bytes]:
        return {name: data for name, data in written(tmp_path).items() if not name.startswith("report/")}

    before, report = written(write_set(tmp_path)), tmp_path / "report"
    report.mkdir()
    (report / "report.json").write_text('{"rows": "of mine"}')
    with pytest.raises(OutputError, match="nothing that `asca simulate` wrote"):
        simulate(tmp_path, None)
    (report / "report.json").unlink()
    for _ in range(2):
        simulate(tmp_path, None)
        assert scans() == before
    (report / "cars.png").write_bytes(b"a photograph")
    with pytest.raises(OutputError, match=r"cars\.png: `asca simulate` did not write it"):
        simulate(tmp_path, None)
    for given in (True, False):
        with pytest.raises(AscaError, match="nothing that `asca simulate` wrote; choose another folder"):
            simulate(tmp_path, 8, report=given)
    assert scans() == before


@pytest.mark.usefixtures("drawn_plots")
def test_objects_are_compared_with_those_of_a_real_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    real = write_set(tmp_path / "real")
    simulate(tmp_path / "sim", 8, report=False)
    before = written(real)
    command.simulate(tmp_path / "sim", workers=1, val_share=0.5, like=real)
    told = capsys.readouterr().out
    assert "Percentile: of the real object among them" in told
    report = json.loads((tmp_path / "sim/report/like_for_like.json").read_text())
    assert report["real"]["frames"] == 6 and report["detector"] is None and report["firing"] is None
    assert {row["class_name"] for row in report["rows"]} <= {"Car", "Pedestrian", "Cyclist", "All"}
    assert (tmp_path / "sim/report/like_for_like.png").stat().st_size > 10_000
    assert written(real) == before


def test_what_cannot_be_is_told_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, real = tmp_path / "sim", write_set(tmp_path / "real")
    cases: list[tuple[dict[str, Any], type[AscaError], str]] = [
        ({"frames": 2, "like": tmp_path / "nothing"}, DatasetError, r"no \*\.bin scans"),
        ({"frames": 2, "like": real, "bundle": Path("asca_smal_sim")}, AscaError, "asca_smal_sim: no such folder"),
        ({"frames": 2, "bundle": Path("fast")}, AscaError, "give --like"),
        ({"length": 20}, ConfigError, "--length 20 is for drives: give --sequences N"),
        ({"sequences": 1, "frames": 3}, ConfigError, "leave --frames"),
    ]
    for options, kind, message in cases:
        with pytest.raises(kind, match=message):
            command.simulate(out, workers=1, **options)
    monkeypatch.setitem(installation.EXTRAS, "eval", ("no_such_plotter",))
    with pytest.raises(AscaError, match=r"no_such_plotter not installed: pip install .*\[eval\]"):
        simulate(out, 2)
    assert not out.exists()


def test_lists_that_were_edited_are_not_written_anew(tmp_path: Path) -> None:
    simulate(tmp_path, 4, report=False)
    simulate(tmp_path, 5, report=False)
    train = tmp_path / "ImageSets" / "train.txt"
    assert len(train.with_name("val.txt").read_text().split()) >= 2, "half of the frames"
    for edited in ("000000\n000002\n", "000001\n000000\n", "my own split\n", train.read_text() + "\n"):
        train.write_text(edited)
        with pytest.raises(OutputError, match=r"train\.txt: `asca simulate` did not write it"):
            simulate(tmp_path, 6, report=False)
        assert train.read_text() == edited and len(list(tmp_path.rglob("*.bin"))) == 5


def test_a_file_of_somebody_else_under_a_frame_s_name_is_kept(tmp_path: Path) -> None:
    simulate(tmp_path, 3, report=False)
    complete = written(tmp_path)
    for scan in (tmp_path / "training" / "velodyne").glob("00000[12].bin"):
        scan.unlink()  # as a killed run leaves a frame
    simulate(tmp_path, 3, report=False)
    assert written(tmp_path) == complete
    for name in ("label_2", "calib"):
        theirs = tmp_path / "training" / name / "000003.txt"
        theirs.write_text("mine")
        with pytest.raises(OutputError, match=r"000003\.txt: `asca simulate` did not write it"):
            simulate(tmp_path, 4, report=False)
        assert theirs.read_text() == "mine"
        theirs.unlink()


def test_nothing_is_simulated_through_links(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    simulate(out, 2)
    for name in ("training/velodyne", "training", "ImageSets", "ImageSets/val.txt", "simulation.json", "report"):
        (out / name).rename(elsewhere)
        (out / name).symlink_to(elsewhere)
        before = written(tmp_path)
        with pytest.raises(OutputError, match=f"{name}: is a link"):
            simulate(out, 3)
        if name != "report":  # the frames are written before the report is asked for
            assert written(tmp_path) == before
        (out / name).unlink()
        elsewhere.rename(out / name)


def test_sequences_go_on_beside_their_lists_and_not_beside_single_scans(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    drives = partial(command.simulate, out, length=2, workers=1, config="vlp_16")
    for sequences in (1, 2, 3):
        drives(sequences=sequences, val_share=0.4)
    assert "1 sequences of 2 scans below" in capsys.readouterr().out
    assert {path.name for path in (out / "scans" / "0000").iterdir()} == {"000000.bin", "000001.bin"}
    train = out / "ImageSets" / "train.txt"
    train.write_text("0000/000000\n0002/000001\n")
    with pytest.raises(OutputError, match=r"train\.txt: `asca simulate` did not write it"):
        drives(sequences=4)
    train.unlink()
    (out / "dataset.yaml").write_text("axes: y-forward\n")
    with pytest.raises(OutputError, match=r"dataset\.yaml: `asca simulate` did not write it"):
        drives(sequences=4)
    with pytest.raises(AscaError, match="another folder"):
        simulate(out, 1)
    simulate(tmp_path / "single", 1, report=False)
    with pytest.raises(AscaError, match="another folder"):
        command.simulate(tmp_path / "single", sequences=1, length=2)
