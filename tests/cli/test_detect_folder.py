"""`asca detect` of a folder of scans over time: tracks and files as of a recording, videos, the page of pictures."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_deploy import result_files
from asca_deploy.detect_scans import detect_scans
from asca_deploy.open_model import RuntimeOptions
from asca_deploy.recordings import sequence_files as recording_video
from asca_deploy.recordings.sequence_files import recording_rate_hz
from asca_pillars.base.errors import AscaError, ConfigError, OutputError, ScanError
from asca_pillars.cli.detect import detect
from asca_pillars.pictures.video import BoxVideo, is_own_video
from asca_pillars.scans.scan_reader import write_scan
from tests.cli.short_drive import BUNDLE, POINTS, SCANS, read_lines, run, scan
from tests.deploy.conftest import make_scan
from tests.helpers.gallery_cards import cards, sources, title
from tests.helpers.video_encoder import needs_encoder
from tests.scans.recordings.cloud_recordings import stamps


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The scans of the recording `drive`."""
    for number in range(SCANS):
        write_scan(tmp_path / "scans" / f"{number}.bin", scan(number))
    return tmp_path / "scans"


detected = partial(detect_scans, options=RuntimeOptions(bundle=BUNDLE, threads=1))


def frames(path: Path) -> list[np.ndarray]:
    read = cv2.VideoCapture(str(path))
    return [read.read()[1] for _ in range(int(read.get(cv2.CAP_PROP_FRAME_COUNT)))]


def write_times(path: Path) -> Path:
    path.write_text("".join(f"{time_ns / 1e9:.9f}\n" for time_ns in stamps(SCANS)))
    return path


def test_tracks_and_files_are_those_of_a_recording(folder: Path, drive: Path, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    lines, messages = [], []
    for path, times in ((folder, write_times(tmp_path / "times.txt")), (drive, None)):
        foxglove = tmp_path / f"{path.stem}_boxes.mcap"
        out = tmp_path / f"of_{path.stem}"
        lines.append(run(path, out, track=True, times=times, foxglove=foxglove, pictures=False))
        with foxglove.open("rb") as file:
            messages.append([(one.log_time, one.data) for *_, one in make_reader(file).iter_messages()])
    of_folder, of_drive = lines
    assert len(of_folder) == SCANS and of_folder[0]["boxes"]
    for one, other in zip(of_folder, of_drive, strict=True):
        assert one["time_s"] == pytest.approx(other["time_s"], abs=1e-6)
        for box, same in zip(one["boxes"], other["boxes"], strict=True):
            assert box == pytest.approx(same, abs=1e-3)
    assert json.loads((tmp_path / "of_scans" / "4.json").read_text())["boxes"] == of_folder[4]["boxes"]
    times_ns = [[time for time, _ in one] for one in messages]
    assert times_ns[0] == pytest.approx(times_ns[1], abs=1000)
    for (_, message), line in zip(messages[0], of_folder, strict=True):
        ids = [one["id"] for one in json.loads(message)["entities"]]
        assert ids == [f"track-{box['track_id']}" for box in line["boxes"]]


def test_velocities_follow_the_rate_which_writes_no_time(folder: Path, tmp_path: Path) -> None:
    def speed(rate_hz: float | None) -> float:
        found = detected(folder, track=True, rate_hz=rate_hz)
        tracks = found[-1].tracks
        assert tracks is not None and found[-1].detections is tracks.detections
        return float(np.median(tracks.velocities_mps[:, 0]))

    assert speed(None) == pytest.approx(-5, abs=1)
    assert speed(5) == pytest.approx(-2.5, abs=0.7)
    found = detected(folder, tmp_path / "plain", pictures=False)
    detected(folder, tmp_path / "rated", pictures=False, rate_hz=5)
    assert found[0].tracks is None
    lines = read_lines(tmp_path / "rated")
    assert read_lines(tmp_path / "plain") == lines and "time_s" not in lines[0]


def test_a_scan_that_cannot_be_read_keeps_its_time(folder: Path, tmp_path: Path) -> None:
    (folder / "2.bin").write_bytes(b"torn")
    times = write_times(tmp_path / "times.txt")
    found = detected(folder, tmp_path / "out", track=True, times=times, pictures=False)
    assert found.unreadable == 1 and len(found) == SCANS - 1
    assert [line["time_ns"] for line in read_lines(tmp_path / "out")] == pytest.approx(
        [time_ns for number, time_ns in enumerate(stamps(SCANS)) if number != 2], abs=1000
    )


@needs_encoder
@pytest.mark.parametrize("view", ["above", "chase"])
def test_the_video_shows_identities(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, view: Any) -> None:
    shown = []
    draw = BoxVideo.draw

    def drawn(self: BoxVideo, points: Any, detections: Any, time_s: float, ids: Any = None, pose: Any = None) -> Any:
        shown.append((time_s, None if ids is None else ids.tolist()))
        return draw(self, points, detections, time_s, ids, pose)

    monkeypatch.setattr(BoxVideo, "draw", drawn)
    for _ in range(2):  # the second replaces the first
        shown.clear()
        found = detected(folder, track=True, rate_hz=20, video=tmp_path / "a.mp4", video_view=view)
    assert [time_s for time_s, _ in shown] == pytest.approx([0.05 * number for number in range(SCANS)])
    assert [ids for _, ids in shown] == [one.tracks.track_ids.tolist() for one in found if one.tracks is not None]
    images = frames(tmp_path / "a.mp4")
    assert is_own_video(tmp_path / "a.mp4") and len(images) == SCANS
    assert np.abs(images[0].astype(int) - images[-1]).mean() > 0.5


def test_the_file_for_rerun_is_one(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs pip install -e '.[view]'")
    from asca_deploy.recordings.rerun_file import is_own_rrd

    run(folder, tmp_path / "out", track=True, rerun=tmp_path / "a.rrd", pictures=False)
    assert is_own_rrd(tmp_path / "a.rrd")


def test_what_does_not_fit_is_refused_before_the_work(
    folder: Path, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scan(tmp_path / "more" / "1.bin", POINTS)
    times = write_times(tmp_path / "times.txt")
    (tmp_path / "short.txt").write_text("0\n")
    (tmp_path / "mine.mp4").write_bytes(b"\0\0\0\x20ftypisom of mine")
    monkeypatch.setattr(recording_video, "find_encoder", lambda: "ffmpeg")
    mp4 = tmp_path / "a.mp4"
    cases: list[tuple[list[Path], dict[str, Any], type[AscaError], str]] = [
        ([folder, tmp_path / "more"], {"track": True}, ConfigError, "scans lie in one folder"),
        ([folder], {"rate": 0.0}, ConfigError, "--rate 0: give scans per second"),
        ([folder], {"rate": 5.0, "times": times}, ConfigError, "give one of them"),
        ([folder], {"times": tmp_path / "short.txt"}, ScanError, "1 times for 5 scans"),
        ([folder], {"track": True, "cluster": "local"}, ConfigError, "cannot be combined with --cluster"),
        ([folder], {"foxglove": tmp_path / "a.bag"}, ConfigError, "viewers open .mcap files"),
        ([folder], {"foxglove": drive}, OutputError, "did not write it"),
        ([folder], {"video": tmp_path / "mine.mp4"}, OutputError, "mine.mp4: `asca detect` did not write it"),
        ([folder], {"video": tmp_path / "a.avi"}, ConfigError, "viewers open .mp4 files"),
        ([folder], {"video_view": "chase"}, ConfigError, "--video-view chase: is of a video; give --video"),
        ([folder], {"video": mp4, "video_view": "side"}, ConfigError, "--video-view side: give above or chase"),
        ([folder], {"video": mp4, "cluster": "local"}, ConfigError, "cannot be combined with --cluster"),
        ([drive], {"rate": 5.0}, ConfigError, "--rate 5: is for folders of scans"),
        ([drive], {"times": times}, ConfigError, "--times .*: is for folders of scans"),
    ]
    for paths, options, kind, message in cases:
        with pytest.raises(kind, match=message):
            detect(paths, out=tmp_path / "out", threads=1, **options)
    assert not (tmp_path / "out").exists()


@needs_encoder
def test_a_recording_becomes_a_video_of_tracks(drive: Path, tmp_path: Path) -> None:
    run(drive, tmp_path / "out", track=True, video=tmp_path / "a.mp4")
    assert len(frames(tmp_path / "a.mp4")) == SCANS
    assert not (tmp_path / "out" / "index.html").exists()


def test_a_video_runs_as_fast_as_its_recording() -> None:
    regular = np.arange(10) * 50_000_000
    assert recording_rate_hz(regular.tolist()) == pytest.approx(20)
    assert recording_rate_hz([*regular.tolist(), 10**18]) == pytest.approx(20)
    assert recording_rate_hz([5, 5]) == recording_rate_hz([]) == 10


def test_a_page_shows_the_pictures_of_a_run(bundle: Path, tmp_path: Path) -> None:
    out, scans = tmp_path / "out", tmp_path / "scans"
    for number in range(3):
        write_scan(scans / f"{number}.bin", make_scan(number, 300))
    run(scans, out, bundle=bundle)
    page = (out / "index.html").read_text()
    assert title(out / "index.html") == "asca detect: 3 scans"
    assert list(cards(page)) == ["0", "1", "2"]
    assert all(one.keys() == {"boxes", "best score", "lowest score"} for one in cards(page).values())
    assert all((out / source).is_file() for source in sources(page))
    run(scans, out, bundle=bundle, pictures=False)
    assert (out / "index.html").read_text() == page, "its pictures are of the same boxes"
    run(scans, out, bundle=bundle, pictures=False, score=["0.99"])
    assert not (out / "index.html").exists(), "its pictures are gone"
    (out / "index.html").write_text("<h1>mine</h1>")
    with pytest.raises(OutputError, match=r"index\.html: `asca detect` did not write it"):
        run(scans, out, bundle=bundle)


def test_misses_are_counted_where_there_are_labels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One label on a car that is found, one where nothing is, one behind the sensor."""
    write_scan(tmp_path / "scans" / "0.bin", POINTS)
    (line,) = run(tmp_path / "scans", tmp_path / "out", pictures=False)
    keys = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    labels = np.array([[line["boxes"][0][key] for key in keys]] * 3, np.float32)
    labels[1:, :2] = (40, 25), (-20, 0)
    monkeypatch.setattr(result_files, "labels_of_scan", lambda path: labels)
    run(tmp_path / "scans", tmp_path / "out")
    (values,) = cards((tmp_path / "out" / "index.html").read_text()).values()
    assert values["missed"] == 1
