"""`asca detect` of recordings: what is written, that a kill changes nothing, and how it refuses."""

import json
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from scipy.spatial.transform import Rotation

from asca_deploy import find_bundle, sample_scan_path
from asca_deploy.manifest import load_bundle
from asca_deploy.recordings.results import JOURNAL_FILE, Journal, ScanResult
from asca_deploy.result_files import RUN_FILE
from asca_pillars.base import installation
from asca_pillars.base.errors import AscaError, ConfigError, OutputError, ScanError
from asca_pillars.cli.detect import detect
from asca_pillars.data.boxes.box_records import read_frames
from asca_pillars.data.kitti import KittiSplit
from benchmarks.made_recordings import write_recording
from tests.cli.short_drive import BUNDLE, POINTS, SAMPLE, SCANS, read_lines, run, scan, write_drive
from tests.helpers.in_process import run_here
from tests.helpers.scenes import write_dataset
from tests.scans.recordings.cloud_recordings import laid_out, odometry_message, stamps, transform_message, write_mcap


@pytest.fixture(scope="module")
def calib(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return KittiSplit(write_dataset(tmp_path_factory.mktemp("kitti"), 1)).calib_path("000000")


def command(drive: Path, out: Path, calib: Path) -> list[object]:
    files = ("--foxglove", out / "boxes.mcap", "--calib", calib)
    return ["detect", drive, "-b", BUNDLE, "--threads", 1, "--track", "-o", out, *files]


@pytest.fixture(scope="module")
def undisturbed(drive: Path, calib: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with tracks and all their files; what it printed lies beside it."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    done = run_here(*command(drive, out, calib))
    assert done.returncode == 0, done.stderr
    out.with_name("told.txt").write_text(done.stdout)
    return out


def outputs(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir()}


class Work:
    """Numbers of the scans that are detected, not read from a journal; the run ends before one more than `most`."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.done: list[int] = []
        self.most: int | None = None
        add = Journal.add

        def note(journal: Journal, result: ScanResult) -> None:
            if len(self.done) == self.most:
                raise KeyboardInterrupt
            add(journal, result)
            self.done.append(result.number)

        patch.setattr(Journal, "add", note)

    def killed_after(self, most: int, path: Path, out: Path, **options: Any) -> Path:
        """Run until as many scans are done; the journal that is left, alone."""
        self.most = most
        with pytest.raises(KeyboardInterrupt):
            run(path, out, **options)
        self.done, self.most = [], None
        (left,) = out.iterdir()
        assert left.name == JOURNAL_FILE, "nothing that looks like a result"
        return left


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    return Work(monkeypatch)


@pytest.fixture(scope="module")
def journal(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """The lines of a journal of all scans but the last."""
    with pytest.MonkeyPatch.context() as patch:
        left = Work(patch).killed_after(SCANS - 1, drive, tmp_path_factory.mktemp("killed") / "out", track=True)
    return left.read_bytes().splitlines(keepends=True)


def test_a_line_for_each_scan_with_its_time(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run(drive, tmp_path)
    assert [line["time_ns"] for line in lines] == stamps(SCANS)
    assert lines[0]["frame_id"] == "lidar" and "track_id" not in lines[0]["boxes"][0]
    assert {path.name for path in tmp_path.iterdir()} == {"detections.jsonl", "recording.json"}
    output = capsys.readouterr().out
    assert "/lidar: 5 scans" in output and "ms of CPU per scan" in output and "looking all around" not in output
    spec = load_bundle(find_bundle(BUNDLE)).spec
    ranges = [list(spec.ranges.x_m), list(spec.ranges.y_m)]
    assert [line["detector"] for line in lines] == [{"classes": list(spec.class_names), "ranges_m": ranges}] * SCANS
    np.save(tmp_path / "scan.npy", POINTS)
    detect([tmp_path / "scan.npy"], out=tmp_path / "alone", bundle=BUNDLE, threads=1, pictures=False)
    alone = json.loads((tmp_path / "alone" / "scan.json").read_text())
    assert (alone["boxes"], alone["detector"]) == (lines[0]["boxes"], lines[0]["detector"]), "as of the scan alone"


def test_what_lies_all_around_is_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside times that no clock shows, which end no run."""
    times = (5, 2**63, 2**64 - 1)
    messages = [(time_ns, laid_out(SAMPLE[::10], time_ns=0)) for time_ns in times]
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": messages})
    lines = run(path, tmp_path / "out", track=True, foxglove=tmp_path / "boxes.mcap")
    assert [(line["time_ns"], line["detector"]["ranges_m"]) for line in lines] == [(5, None), (0, None), (0, None)]
    output = capsys.readouterr().out
    assert "looking all around" in output and "neither the header nor the recording has a usable time stamp" in output
    (line, *_) = run(path, tmp_path / "ahead", around=False)
    assert line["detector"]["ranges_m"] is not None


def test_tracks_last_and_move(undisturbed: Path) -> None:
    lines = read_lines(undisturbed)
    first, last = ({box["track_id"]: box for box in line["boxes"]} for line in (lines[0], lines[-1]))
    both = [(first[number], last[number]) for number in first.keys() & last.keys()]
    assert len(both) >= 3
    for before, after in both:
        assert after["class"] == before["class"]
        assert after["x_m"] - before["x_m"] == pytest.approx(-0.5 * (SCANS - 1), abs=0.4)
    assert np.median([after["vx_mps"] for _, after in both]) == pytest.approx(-5, abs=1)
    assert len(list(read_frames(undisturbed / "detections.jsonl"))) == SCANS, "other tools read the lines"
    counts = Counter(box["class"] for line in lines for box in line["boxes"])
    assert f"{SCANS} scans, in all {counts['Car']} Car, " in undisturbed.with_name("told.txt").read_text()
    rows = [row.split() for row in (undisturbed / "tracks.txt").read_text().splitlines()]
    assert {len(row) for row in rows} == {18}, "frame, identity, 15 fields of a label, score"
    known = {(index, box["track_id"], box["class"]) for index, line in enumerate(lines) for box in line["boxes"]}
    assert len(rows) > SCANS and {(int(row[0]), int(row[1]), row[2]) for row in rows} <= known


def test_boxes_are_in_the_vehicles_frame(drive: Path, tmp_path: Path) -> None:
    """Of a sensor that is tilted, which no box could be in the frame of."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    pose[:3, 3] = 0.5, 0, 1.0
    tilted = POINTS.copy()
    tilted[:, :3] = (POINTS[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    transforms = [transform_message("base_link", "lidar", pose)]
    messages = [(stamps(1)[0], laid_out(tilted))]
    path = write_mcap(tmp_path / "tilted.mcap", {"/lidar": messages}, transforms=transforms)
    (line,) = run(path, tmp_path / "tilted", frame="base_link")
    (straight, *_) = run(drive, tmp_path / "straight")
    assert line["frame_id"] == "base_link" and len(line["boxes"]) == len(straight["boxes"])
    assert line["boxes"][0] == pytest.approx(straight["boxes"][0], abs=0.05)
    with pytest.raises(ConfigError, match="--frame base_link: says how the scans lie already"):
        run(path, tmp_path / "tilted", frame="base_link", axes="y-forward")


def test_foxglove_file_is_read_back(undisturbed: Path) -> None:
    from mcap.reader import make_reader

    with (undisturbed / "boxes.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None and summary.statistics.message_count == SCANS
    for line, (schema, channel, message) in zip(read_lines(undisturbed), messages, strict=True):
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
    assert schema["type"] != "object" or value.keys() >= set(schema.get("required", ()))
    for name, part in schema.get("properties", {}).items():
        _conforms(value[name], part)
    for item in value if schema["type"] == "array" else ():
        _conforms(item, schema["items"])


def _line_2(change: Callable[[bytes], bytes]) -> Callable[[list[bytes]], list[bytes]]:
    """A change of the line of scan 2, behind the heading and those of scans 0 and 1."""
    return lambda lines: [*lines[:3], change(lines[3]), *lines[4:]]


@pytest.mark.parametrize(
    ("change", "detected"),
    [
        (lambda lines: lines[:1], [0, 1, 2, 3, 4]),
        (lambda lines: [*lines[:2], b'{"number": '], [1, 2, 3, 4]),
        (lambda lines: [*lines, b"\x00\xff"], [4]),
        (_line_2(lambda line: line.replace(b'"boxes": [[', b'"boxes": [[1', 1)), [2, 4]),  # still JSON, of 7 numbers
        (_line_2(lambda line: b'{"number": 2, "time_ns": 0, "frame_id": "", "trouble": "made up"}\n'), [2, 4]),
        (_line_2(lambda line: line[:-1]), [2, 3, 4]),  # two lines in one
        (_line_2(lambda line: b""), [2, 4]),
        (None, [2, 3, 4]),  # whole lines, of a run with another score
    ],
)
def test_a_killed_run_goes_on_and_ends_the_same(
    drive: Path,
    calib: Path,
    undisturbed: Path,
    journal: list[bytes],
    work: Work,
    tmp_path: Path,
    change: Callable[[list[bytes]], list[bytes]] | None,
    detected: list[int],
) -> None:
    if change is None:
        with Journal(tmp_path / "other", {"score": 0.9}, ("Car",)) as other:
            for number in range(SCANS - 1):
                other.add(ScanResult(number, number, "other", None, "made up"))
        work.done.clear()
        lines = [*journal[:3], *other.path.read_bytes().splitlines(keepends=True)[3:]]
    else:
        lines = change(journal)
    out = tmp_path / "out"
    out.mkdir()
    (out / JOURNAL_FILE).write_bytes(b"".join(lines))
    run(drive, out, track=True, foxglove=out / "boxes.mcap", calib=calib)
    assert work.done == detected, "what was done is not done again"
    assert outputs(out) == outputs(undisturbed)


def test_what_is_no_journal_is_neither_cut_nor_removed(drive: Path, tmp_path: Path, undisturbed: Path) -> None:
    """And it makes nobody's folder ours; nor is it replaced beside an earlier run."""
    contents = b"", b"my notes\n", b'{"recording": "mine"}\n{"number": 0}\n', b'["0123456789abcdef", {}]\n'
    for number, content in enumerate(contents):
        (out := tmp_path / f"{number}").mkdir()
        (out / JOURNAL_FILE).write_bytes(content)
        (out / (RUN_FILE if number % 2 else "thesis.txt")).write_bytes((undisturbed / RUN_FILE).read_bytes())
        before = outputs(out)
        with pytest.raises(OutputError):
            run(drive, out)
        assert outputs(out) == before


def test_nothing_is_written_through_a_link(drive: Path, calib: Path, tmp_path: Path, work: Work) -> None:
    work.killed_after(1, drive, tmp_path / "killed", calib=calib)
    run(drive, tmp_path / "out", calib=calib)
    for name in (JOURNAL_FILE, "recording.json", "detections.jsonl", "tracks.txt"):
        out = tmp_path / ("killed" if name == JOURNAL_FILE else "out")
        elsewhere = (out / name).rename(tmp_path / "elsewhere")
        (out / name).symlink_to(elsewhere)
        before = elsewhere.read_bytes()
        with pytest.raises(OutputError, match=f"{name}: is a link"):
            run(drive, out, calib=calib)
        assert elsewhere.read_bytes() == before and (out / name).is_symlink()
        elsewhere.rename(out / name)


def test_what_tells_of_a_recording_does_not_stay_beside_other_scans(drive: Path, calib: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for scans in (drive, sample_scan_path()):
        run(drive, out, calib=calib)
        (out / "notes.txt").write_text("mine")
        assert (out / "tracks.txt").is_file() and (out / "recording.json").is_file()
        run(scans, out, **({} if scans == drive else {"pictures": False}))
        assert not (out / "tracks.txt").exists(), "nobody asked for it again"
        assert (out / "recording.json").exists() == (scans == drive)
        assert (out / "notes.txt").is_file()


KILLS_ITSELF = """
import os, signal
from asca_pillars.cli.main import main
from asca_deploy.recordings.results import Journal
add = Journal.add
def add_and_die(self, result):
    add(self, result)
    if result.number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.add = add_and_die
main()
"""


def test_after_sigkill(drive: Path, calib: Path, undisturbed: Path, tmp_path: Path) -> None:
    given = command(drive, tmp_path, calib)
    killed = subprocess.run([sys.executable, "-c", KILLS_ITSELF, *map(str, given)], stdout=subprocess.DEVNULL)
    assert killed.returncode == -signal.SIGKILL and not (tmp_path / "detections.jsonl").exists()
    resumed = run_here(*given)
    assert resumed.returncode == 0 and "resuming after the" in resumed.stdout
    assert outputs(tmp_path) == outputs(undisturbed)


@pytest.mark.parametrize("setting", ["score", "pose"])
def test_a_journal_of_other_settings_is_not_gone_on_with(
    drive: Path, tmp_path: Path, work: Work, setting: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = tmp_path / "pose.txt"
    for number, height in enumerate((0, 0.5)):
        pose.write_text(f"1 0 0 0\n0 1 0 0\n0 0 1 {height if setting == 'pose' else 0}\n0 0 0 1\n")
        options: dict[str, Any] = {"pose": pose, "score": ["0.9" if setting == "score" and number == 0 else "0.5"]}
        if number == 0:
            work.killed_after(SCANS - 1, drive, tmp_path / "out", **options)
    assert "beginning anew" not in capsys.readouterr().out
    lines = run(drive, tmp_path / "out", **options)
    assert len(work.done) == SCANS and min(box["score"] for line in lines for box in line["boxes"]) < 0.9
    assert "beginning anew: another run was killed here, with another " in capsys.readouterr().out


@pytest.mark.parametrize("track", [False, True])
def test_scores_of_classes(drive: Path, tmp_path: Path, track: bool) -> None:
    def classes(name: str, *scores: str) -> set[str]:
        lines = run(drive, tmp_path / name, track=track, score=list(scores))
        return {box["class"] for line in lines for box in line["boxes"]}

    assert classes("all") == {"Car", "Cyclist"}
    assert classes("few", "Car=0.99") == {"Cyclist"}
    assert classes("none", "Car=0.99", "Cyclist=0.99") == set()


def test_results_in_the_folder_of_a_bag_are_no_part_of_it(tmp_path: Path, work: Work) -> None:
    bag = tmp_path / "bag"
    write_recording(bag, iter([(time_ns, POINTS) for time_ns in stamps(2)]))
    work.killed_after(1, bag, bag / "results")
    assert len(run(bag, bag / "results")) == 2 and work.done == [1], "not begun anew"


def test_damaged_messages_are_skipped_and_counted(drive: Path, tmp_path: Path) -> None:
    messages = zip(stamps(3), (laid_out(POINTS), b"torn", laid_out(POINTS)), strict=True)
    torn = write_mcap(tmp_path / "torn.mcap", {"/lidar": list(messages)})
    with pytest.raises(ScanError, match=r"^1 scans were skipped: .*torn.mcap, /lidar, message 1: not a readable"):
        run(torn, tmp_path / "out")
    assert [line["scan"] for line in read_lines(tmp_path / "out")] == ["torn.mcap/000000", "torn.mcap/000002"]
    assert not (tmp_path / "out" / JOURNAL_FILE).exists()
    nothing = write_mcap(tmp_path / "a.mcap", {"/lidar": [(stamps(1)[0], b"torn")]})
    with pytest.raises(ScanError, match=r"none of the 1 scans of /lidar can be read: .*message 0"):
        run(nothing, tmp_path / "none")
    assert not (tmp_path / "none" / "detections.jsonl").exists()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(drive.read_bytes()[: int(drive.stat().st_size * 0.7)])
    with pytest.raises(ScanError, match="ends early, after"):
        run(cut, tmp_path / "cut")
    assert 1 <= len(read_lines(tmp_path / "cut")) < SCANS


def test_what_does_not_fit_is_refused_before_anything_is_detected(drive: Path, tmp_path: Path) -> None:
    other, before = tmp_path / "other.mcap", drive.read_bytes()
    other.write_bytes(before)
    cases: list[tuple[dict[str, Any], type[AscaError], str]] = [
        ({"pictures": True}, ConfigError, "--pictures: scans of a recording are not drawn"),
        ({"columns": 7}, ConfigError, "--columns 7: is for"),
        ({"foxglove": Path("boxes.json")}, ConfigError, "choose such a name"),
        ({"track": True, "score": ["1.2"]}, ConfigError, r"score_threshold 1\.2 of class Car must lie"),
        ({"foxglove": drive}, OutputError, r"would replace the input .*drive\.mcap"),
        ({"foxglove": other}, OutputError, r"other\.mcap: .*did not write it"),
        ({"out": tmp_path}, OutputError, r"other\.mcap"),
    ]
    for options, kind, message in cases:
        with pytest.raises(kind, match=message):
            run(drive, options.pop("out", tmp_path / "out"), **options)
    with pytest.raises(ConfigError, match="must be the only input"):
        detect([drive, sample_scan_path()], out=tmp_path / "out")
    with pytest.raises(ConfigError, match="need a recording"):
        run(sample_scan_path(), tmp_path / "out", topic="/lidar")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(AscaError, match=r"pip install .*\[.*recordings"):
        patch.setitem(installation.EXTRAS, "recordings", ("no_such_library",))
        run(drive, tmp_path / "out")
    assert list(tmp_path.iterdir()) == [other] and other.read_bytes() == drive.read_bytes() == before
    with Journal(tmp_path / "out", {}, ("Car",)), pytest.raises(OutputError, match="another `asca detect` is at work"):
        run(drive, tmp_path / "out")


def test_with_odometry_what_stands_still_has_no_speed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scans are those of a car that drives 5 m/s past things that stand still."""
    options: dict[str, Any] = {"track": True, "odometry": "/odom"}
    poses = [
        (time_ns - 10**7, odometry_message(time_ns - 10**7, 100 + 0.5 * i - 0.05))
        for i, time_ns in enumerate(stamps(SCANS + 1))
    ]
    path = write_drive(tmp_path / "drive.mcap", odometry=poses)
    lines = run(path, tmp_path / "out", **options)
    speeds = [np.hypot(box["vx_mps"], box["vy_mps"]) for box in lines[-1]["boxes"] if box["class"] == "Car"]
    assert len(speeds) >= 3 and np.median(speeds) < 1
    mirror = np.array([1, -1, 1, 1], np.float32)
    mirrored = [(time_ns, laid_out(scan(i) * mirror, time_ns=time_ns)) for i, time_ns in enumerate(stamps(SCANS))]
    path_mirrored = write_mcap(tmp_path / "mirrored.mcap", {"/lidar": mirrored}, odometry=poses)
    seen = run(path_mirrored, tmp_path / "mirrored", axes="x,-y,z", **options)
    for key, sign in (("x_m", 1), ("y_m", -1), ("vx_mps", 1), ("vy_mps", -1), ("track_id", 1)):
        expected = [sign * box[key] for box in lines[-1]["boxes"]]
        assert [box[key] for box in seen[-1]["boxes"]] == pytest.approx(expected, abs=1e-3)
    late = [(time_ns + 37 * 10**9, odometry_message(time_ns + 37 * 10**9, 0.0)) for time_ns in stamps(SCANS)]
    with pytest.raises(ScanError, match=r"from \+37.0 to \+37.4 s of the first scan; 5 of 5 scans are at other times"):
        run(write_drive(tmp_path / "other.mcap", odometry=late), tmp_path / "other", **options)
    run(write_drive(tmp_path / "short.mcap", odometry=poses[:2]), tmp_path / "short", **options)
    assert "2 of 5 scans lie outside" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(ConfigError, match="give --track"):
        run(path, tmp_path / "out", odometry="/odom")
    with pytest.raises(ScanError, match="/lidar holds no nav_msgs/msg/Odometry; there is /odom"):
        run(path, tmp_path / "out", track=True, odometry="/lidar")
