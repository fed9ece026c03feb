"""`asca detect` of recordings: what is written, that a kill changes nothing, and how it refuses."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from scipy.spatial.transform import Rotation

from asca_deploy import find_bundle, sample_scan_path
from asca_deploy.manifest import load_bundle
from asca_deploy.recordings import detect_recording as steps
from asca_deploy.recordings.journal import JOURNAL_FILE, Journal, ScanResult
from asca_pillars.base import extras
from asca_pillars.base.errors import AscaError, ConfigError, OutputError, ScanError
from asca_pillars.base.installation import install_command
from asca_pillars.cli.detect import detect
from asca_pillars.data.boxes.box_records import read_frames
from asca_pillars.data.kitti import KittiSplit
from benchmarks.made_recordings import write_recording
from tests.cli.short_drive import POINTS, SCANS, run
from tests.helpers.in_process import run_here
from tests.helpers.scenes import write_dataset
from tests.scans.recordings.cloud_recordings import laid_out, stamps, transform_message, write_mcap


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    times = stamps(3)
    messages = [(times[0], laid_out(POINTS)), (times[1], b"torn"), (times[2], laid_out(POINTS))]
    return write_mcap(tmp_path_factory.mktemp("torn") / "torn.mcap", {"/lidar": messages})


def test_a_line_for_each_scan_with_its_time(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(drive, tmp_path)
    assert [line["time_ns"] for line in lines] == stamps(SCANS)
    assert lines[0]["frame_id"] == "lidar" and "track_id" not in lines[0]["boxes"][0]
    spec = load_bundle(find_bundle(None)).spec
    assert [line["detector"] for line in lines] == [{"classes": list(spec.class_names), "ranges_m": None}] * SCANS
    assert {path.name for path in tmp_path.iterdir()} == {"detections.jsonl", "recording.json"}
    output = capsys.readouterr().out
    assert "/lidar: 5 scans" in output and "looking all around" in output and "ms of CPU per scan" in output
    # The same boxes as of the scan alone.
    np.save(tmp_path / "scan.npy", POINTS)
    detect([tmp_path / "scan.npy"], out=tmp_path / "alone", threads=1, pictures=False)
    alone = json.loads((tmp_path / "alone" / "scan.json").read_text())
    assert (alone["boxes"], alone["detector"]) == (lines[0]["boxes"], lines[0]["detector"])
    (line, *_) = run(drive, tmp_path / "ahead", around=False)
    assert line["detector"]["ranges_m"] == [list(spec.ranges.x_m), list(spec.ranges.y_m)]


def test_times_that_no_clock_shows_end_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = (5, 2**63, 2**64 - 1)
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": [(time_ns, laid_out(POINTS, time_ns=0)) for time_ns in times]})
    lines = run(path, tmp_path / "out", track=True, foxglove=tmp_path / "boxes.mcap")
    assert [line["time_ns"] for line in lines] == [5, 0, 0]
    assert "neither the header nor the recording has a usable time stamp" in capsys.readouterr().out


def test_tracks_last_and_move(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(drive, tmp_path, track=True)
    first, last = ({box["track_id"]: box for box in line["boxes"]} for line in (lines[0], lines[-1]))
    both = [(first[number], last[number]) for number in first.keys() & last.keys()]
    assert len(both) >= 3
    for before, after in both:
        assert after["class"] == before["class"]
        assert after["x_m"] - before["x_m"] == pytest.approx(-0.5 * (SCANS - 1), abs=0.4)
    assert np.median([after["vx_mps"] for _, after in both]) == pytest.approx(-5, abs=1)
    assert len(list(read_frames(tmp_path / "detections.jsonl"))) == SCANS, "other tools read the lines"
    counts = Counter(box["class"] for line in lines for box in line["boxes"])
    assert f"{SCANS} scans, in all {counts['Car']} Car, " in capsys.readouterr().out, "of what is written"


def test_boxes_are_in_the_vehicles_frame(drive: Path, tmp_path: Path) -> None:
    """Of a sensor that is tilted, which no box could be in the frame of."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    pose[:3, 3] = 0.5, 0, 1.0
    tilted = POINTS.copy()
    tilted[:, :3] = (POINTS[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    path = write_mcap(
        tmp_path / "tilted.mcap",
        {"/lidar": [(stamps(1)[0], laid_out(tilted))]},
        transforms=[transform_message("base_link", "lidar", pose)],
    )
    (line,) = run(path, tmp_path / "tilted", frame="base_link")
    straight = run(drive, tmp_path / "straight")[0]
    assert line["frame_id"] == "base_link" and len(line["boxes"]) == len(straight["boxes"])
    assert line["boxes"][0] == pytest.approx(straight["boxes"][0], abs=0.05)
    with pytest.raises(ConfigError, match="--frame base_link: says how the scans lie already"):
        run(path, tmp_path / "tilted", frame="base_link", axes="y-forward")


def test_foxglove_file_is_read_back(drive: Path, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    lines = run(drive, tmp_path / "out", track=True, foxglove=tmp_path / "boxes.mcap")
    with (tmp_path / "boxes.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None and summary.statistics.message_count == SCANS
    for line, (schema, channel, message) in zip(lines, messages, strict=True):
        assert schema is not None and (schema.name, schema.encoding) == ("foxglove.SceneUpdate", "jsonschema")
        assert channel.message_encoding == "json" and message.log_time == line["time_ns"]
        update = json.loads(message.data)
        _conforms(update, json.loads(schema.data))
        assert update["deletions"][0]["type"] == 1
        assert [entity["id"] for entity in update["entities"]] == [f"track-{box['track_id']}" for box in line["boxes"]]
        cube, box = update["entities"][0]["cubes"][0], line["boxes"][0]
        assert cube["pose"]["position"]["x"] == pytest.approx(box["x_m"], abs=1e-4)
        assert cube["size"]["x"] == pytest.approx(box["length_m"], abs=1e-4)
        turn = 2 * np.arctan2(cube["pose"]["orientation"]["z"], cube["pose"]["orientation"]["w"])
        assert np.cos(turn - box["yaw_rad"]) == pytest.approx(1, abs=1e-6)


def _conforms(value: Any, schema: dict[str, Any]) -> None:
    """The value has the schema's types and required fields."""
    kinds: dict[str, Any] = {"object": dict, "array": list, "string": str, "number": (int, float)}
    kinds |= {"integer": int, "boolean": bool}
    assert isinstance(value, kinds[schema["type"]])
    for name in schema.get("required", ()):
        assert name in value
    for name, part in schema.get("properties", {}).items():
        _conforms(value[name], part)
    for item in value if schema["type"] == "array" else ():
        _conforms(item, schema["items"])


def test_kitti_tracking_text(drive: Path, tmp_path: Path) -> None:
    calib = KittiSplit(write_dataset(tmp_path / "kitti", 1)).calib_path("000000")
    lines = run(drive, tmp_path / "out", track=True, calib=calib)
    rows = [row.split() for row in (tmp_path / "out" / "tracks.txt").read_text().splitlines()]
    assert {len(row) for row in rows} == {18}, "frame, identity, 15 fields of a label, score"
    known = {(index, box["track_id"], box["class"]) for index, line in enumerate(lines) for box in line["boxes"]}
    assert len(rows) > SCANS and {(int(row[0]), int(row[1]), row[2]) for row in rows} <= known


@pytest.fixture(scope="module")
def undisturbed(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    run(drive, out, track=True, foxglove=out / "boxes.mcap")
    return out


def outputs(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir() if path.suffix in (".jsonl", ".mcap")}


@pytest.mark.parametrize(("after", "torn_line"), [(0, b""), (1, b'{"number": '), (4, b"\x00\xff")])
def test_a_killed_run_goes_on_and_ends_the_same(
    drive: Path, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int, torn_line: bytes
) -> None:
    killed = tmp_path / "killed"
    add = Journal.add
    done: list[None] = []

    def dies(self: Journal, result: Any) -> None:
        if len(done) == after:
            raise KeyboardInterrupt
        done.append(add(self, result))

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Journal, "add", dies)
        run(drive, killed, track=True, foxglove=killed / "boxes.mcap")
    assert [path.name for path in killed.iterdir()] == [JOURNAL_FILE], "nothing that looks like a result"
    with (killed / JOURNAL_FILE).open("ab") as file:
        file.write(torn_line)
    detected: list[int] = []
    monkeypatch.setattr(Journal, "add", lambda self, result: detected.append(result.number) or add(self, result))
    run(drive, killed, track=True, foxglove=killed / "boxes.mcap")
    assert detected == list(range(after, SCANS)), "what was done is not done again"
    assert outputs(killed) == outputs(undisturbed)


def _dies(*_: object) -> Iterator[None]:
    raise KeyboardInterrupt


@pytest.fixture
def journal(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A journal of all scans, in tmp_path/killed."""
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(steps, "track_results", _dies)
        run(drive, tmp_path / "killed", track=True, foxglove=tmp_path / "killed" / "boxes.mcap")
    return tmp_path / "killed" / JOURNAL_FILE


@pytest.mark.parametrize(
    "change",
    [
        lambda line: line.replace(b'"boxes": [[', b'"boxes": [[1', 1),  # still JSON, of 7 numbers
        lambda line: line.replace(b'"labels": [', b'"labels": [9, ', 1),
        lambda line: line.replace(b'"number": 2', b'"number": 3', 1),
        lambda line: b'["0123456789abcdef", {"number": 2}]\n',
        lambda line: b'{"number": 2, "time_ns": 0, "frame_id": "", "trouble": "made up"}\n',
        lambda line: b"\x00" * 20 + b"\n",
        lambda line: line[:-1],  # two lines in one
        lambda line: b"",
    ],
)
def test_damaged_lines_of_a_journal_are_done_again(
    drive: Path,
    undisturbed: Path,
    journal: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[bytes], bytes],
) -> None:
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[3] = change(lines[3])
    journal.write_bytes(b"".join(lines))
    detected: list[int] = []
    add = Journal.add
    monkeypatch.setattr(Journal, "add", lambda self, result: detected.append(result.number) or add(self, result))
    run(drive, journal.parent, track=True, foxglove=journal.parent / "boxes.mcap")
    assert detected in ([2], [2, 3]), "and no others"
    assert outputs(journal.parent) == outputs(undisturbed)


def test_a_journal_of_other_scans_is_not_mixed_in(drive: Path, undisturbed: Path, journal: Path) -> None:
    """Whole lines, of a run with another score."""
    other = Journal(journal.parent / "other", {"score": 0.9}, ("Car",))
    with other:
        for number in range(SCANS):
            other.add(ScanResult(number, number, "other", None, "made up"))
    theirs = other.path.read_bytes().splitlines(keepends=True)
    ours = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join([*ours[:3], *theirs[3:]]))
    shutil.rmtree(journal.parent / "other")
    run(drive, journal.parent, track=True, foxglove=journal.parent / "boxes.mcap")
    assert outputs(journal.parent) == outputs(undisturbed)


@pytest.mark.parametrize(
    "content",
    [b"", b"my notes\n", b'{"recording": "mine"}\n{"number": 0}\n', b'["0123456789abcdef", {}]\n', b"\x00" * 99],
)
@pytest.mark.parametrize("beside", ["thesis.txt", "detections.jsonl"])
def test_what_is_no_journal_is_neither_cut_nor_removed(
    drive: Path, tmp_path: Path, undisturbed: Path, content: bytes, beside: str
) -> None:
    """Beside an earlier run, too; and it makes nobody's folder ours."""
    out = tmp_path / "out"
    out.mkdir()
    (out / JOURNAL_FILE).write_bytes(content)
    (out / beside).write_bytes((undisturbed / "detections.jsonl").read_bytes())
    with pytest.raises(OutputError):
        run(drive, out)
    assert (out / JOURNAL_FILE).read_bytes() == content and len(list(out.iterdir())) == 2


def test_a_journal_is_not_written_through_a_link(drive: Path, journal: Path) -> None:
    elsewhere = journal.rename(journal.parent.parent / "elsewhere")
    journal.symlink_to(elsewhere)
    before = elsewhere.read_bytes()
    with pytest.raises(OutputError, match=f"{JOURNAL_FILE}: is a link"):
        run(drive, journal.parent)
    assert elsewhere.read_bytes() == before and journal.is_symlink()


@pytest.mark.parametrize("name", ["recording.json", "detections.jsonl", "tracks.txt"])
def test_results_are_not_written_through_links(drive: Path, tmp_path: Path, name: str) -> None:
    calib = KittiSplit(write_dataset(tmp_path / "kitti", 1)).calib_path("000000")
    run(drive, tmp_path / "out", calib=calib)
    elsewhere = (tmp_path / "out" / name).rename(tmp_path / "elsewhere")
    (tmp_path / "out" / name).symlink_to(elsewhere)
    before = elsewhere.read_bytes()
    with pytest.raises(OutputError, match=f"{name}: is a link"):
        run(drive, tmp_path / "out", calib=calib)
    assert elsewhere.read_bytes() == before


def test_what_tells_of_a_recording_does_not_stay_beside_other_scans(drive: Path, tmp_path: Path) -> None:
    calib = KittiSplit(write_dataset(tmp_path / "kitti", 1)).calib_path("000000")
    out = tmp_path / "out"
    for scans in (drive, sample_scan_path()):
        run(drive, out, calib=calib)
        (out / "notes.txt").write_text("mine")
        assert (out / "tracks.txt").is_file() and (out / "recording.json").is_file()
        detect([scans], out=out, threads=1)
        assert not (out / "tracks.txt").exists(), "nobody asked for it again"
        assert (out / "recording.json").exists() == (scans == drive)
        assert (out / "notes.txt").is_file()


HELD_UP = """
import time
from asca_pillars.cli.main import main
from asca_deploy.recordings.journal import Journal
add = Journal.add
def add_and_wait(self, result):
    add(self, result)
    time.sleep(600 if result.number == 2 else 0)
Journal.add = add_and_wait
main()
"""


def test_after_sigkill(drive: Path, undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    command = ["detect", drive, "--track", "-o", out, "--foxglove", out / "boxes.mcap", "--threads", 1]
    # Held up after the third scan, so that it cannot end before it is killed.
    process = subprocess.Popen([sys.executable, "-c", HELD_UP, *map(str, command)], stdout=subprocess.DEVNULL)
    while process.poll() is None:
        if (out / JOURNAL_FILE).exists() and (out / JOURNAL_FILE).read_bytes().count(b"\n") == 1 + 3:
            process.kill()
            break
        time.sleep(0.01)
    assert process.wait() == -signal.SIGKILL
    assert not (out / "detections.jsonl").exists()
    resumed = run_here(*command)
    assert resumed.returncode == 0 and "going on after the" in resumed.stdout
    assert outputs(out) == outputs(undisturbed)


def test_a_journal_of_other_settings_is_not_gone_on_with(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(steps, "track_results", _dies)
        run(drive, tmp_path, score=["0.9"])
    assert (tmp_path / JOURNAL_FILE).exists() and "beginning anew" not in capsys.readouterr().out
    assert min(box["score"] for line in run(drive, tmp_path, score=["0.5"]) for box in line["boxes"]) < 0.9
    assert "beginning anew: another run was killed here, with another score" in capsys.readouterr().out


@pytest.mark.parametrize("track", [False, True])
def test_scores_of_classes(drive: Path, tmp_path: Path, track: bool) -> None:
    lines = run(drive, tmp_path / "few", track=track, score=["Car=0.99", "Cyclist=0.99"])
    few = {box["class"] for line in lines for box in line["boxes"]}
    every = {box["class"] for line in run(drive, tmp_path / "all", track=track) for box in line["boxes"]}
    assert "Car" in every and few == every & {"Pedestrian"}


def test_a_journal_of_another_pose_is_not_gone_on_with(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose = tmp_path / "pose.txt"
    pose.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(steps, "track_results", _dies)
        run(drive, tmp_path / "out", pose=pose)
    pose.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0.5\n0 0 0 1\n")
    detected: list[int] = []
    add = Journal.add
    monkeypatch.setattr(Journal, "add", lambda self, result: detected.append(result.number) or add(self, result))
    run(drive, tmp_path / "out", pose=pose)
    assert len(detected) == SCANS


def test_results_in_the_folder_of_a_bag_are_no_part_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_recording(tmp_path / "bag", iter([(time_ns, POINTS) for time_ns in stamps(2)]))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(steps, "track_results", _dies)
        run(tmp_path / "bag", tmp_path / "bag" / "results")
    monkeypatch.setattr(Journal, "add", lambda *_: pytest.fail("begun anew"))
    assert len(run(tmp_path / "bag", tmp_path / "bag" / "results")) == 2


def test_two_runs_at_once_do_not_share_a_folder(drive: Path, tmp_path: Path) -> None:
    with Journal(tmp_path, {}, ("Car",)), pytest.raises(OutputError, match="another `asca detect` is at work there"):
        run(drive, tmp_path)


def test_damaged_messages_are_skipped_and_counted(torn: Path, tmp_path: Path) -> None:
    with pytest.raises(ScanError, match=r"^1 scans were skipped: .*torn.mcap, /lidar, message 1: no readable"):
        run(torn, tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "detections.jsonl").read_text().splitlines()]
    assert [line["scan"] for line in lines] == ["torn.mcap/000000", "torn.mcap/000002"]
    assert not (tmp_path / JOURNAL_FILE).exists()


def test_a_recording_without_its_end_gives_what_it_has(drive: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(drive.read_bytes()[: int(drive.stat().st_size * 0.7)])
    with pytest.raises(ScanError, match="ends early, after"):
        run(cut, tmp_path / "out")
    assert 1 <= len((tmp_path / "out" / "detections.jsonl").read_text().splitlines()) < SCANS


def test_nothing_readable_is_an_error_and_writes_nothing(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": [(stamps(1)[0], b"torn")]})
    with pytest.raises(ScanError, match=r"none of the 1 scans of /lidar can be read: .*message 0"):
        run(path, tmp_path / "out")
    assert not (tmp_path / "out" / "detections.jsonl").exists()


def test_options_that_do_not_fit(drive: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="need a recording"):
        detect([sample_scan_path()], out=tmp_path, topic="/lidar")
    with pytest.raises(ConfigError, match="give one alone"):
        detect([drive, sample_scan_path()], out=tmp_path)
    with pytest.raises(ConfigError, match="--pictures: scans of a recording are not drawn"):
        run(drive, tmp_path, pictures=True)
    with pytest.raises(ConfigError, match="--columns 7: is for"):
        run(drive, tmp_path, columns=7)
    before = drive.read_bytes()
    with pytest.raises(OutputError, match=r"drive\.mcap: would replace .*drive\.mcap, which is read"):
        run(drive, tmp_path, foxglove=drive)
    assert drive.read_bytes() == before
    other = tmp_path / "other" / "other.mcap"
    other.parent.mkdir()
    other.write_bytes(before)
    with pytest.raises(OutputError, match=r"other\.mcap: `asca detect` did not write it"):
        run(drive, tmp_path / "none", foxglove=other)
    assert other.read_bytes() == before
    with pytest.raises(ConfigError, match=r"choose such a name"):
        run(drive, tmp_path, foxglove=tmp_path / "boxes.json")
    with pytest.raises(ConfigError, match=r"score_threshold 1\.2 of class Car must lie"):  # before anything is detected
        run(drive, tmp_path / "none", track=True, score=["1.2"])
    assert not (tmp_path / "none" / JOURNAL_FILE).exists()
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"mine\.txt"):
        run(drive, tmp_path)


def test_missing_libraries_are_named(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(extras.EXTRAS, "recordings", ("no_such_library",))
    with pytest.raises(AscaError, match=re.escape(install_command("recordings"))):
        run(drive, tmp_path)
