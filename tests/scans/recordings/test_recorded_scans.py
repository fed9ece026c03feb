"""Recordings of every kind: topics, order, damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings import recorded_scans
from asca_pillars.scans.recordings.recorded_scans import SEARCHED_MESSAGES, RecordedScans, is_recording, open_recording
from benchmarks.made_recordings import TOPIC, write_recording
from tests.scans.recordings.cloud_recordings import cloud_points, clouds, laid_out, read_scans, stamps, write_mcap


@pytest.mark.parametrize("name", ["drive.mcap", "drive_bag", "drive.bag"])
def test_scans_and_times_come_back(tmp_path: Path, name: str) -> None:
    path, times = tmp_path / name, stamps(5)
    assert write_recording(path, iter([(time_ns, cloud_points(i)) for i, time_ns in enumerate(times)])) == 5
    assert is_recording(path)
    recording = open_recording(path)
    topic = recording.point_cloud_topic()
    assert (topic.name, topic.messages) == (TOPIC, 5)
    scans = list(RecordedScans(recording, topic, "auto").read())
    assert [one.time_ns for one in scans] == times and recording.damage is None
    for index, one in enumerate(scans):
        assert one.scan is not None and np.array_equal(one.scan.points, cloud_points(index))
    assert [one.number for one in read_scans(path, start=3)] == [3, 4]


def test_folders_of_scans_are_no_recordings_and_those_of_both_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="no such file"):
        open_recording(tmp_path / "drive.mcap")
    np.save(tmp_path / "a.npy", cloud_points(0))
    (tmp_path / "metadata.yaml").write_text("weather: rain\n")
    assert not is_recording(tmp_path)
    write_recording(tmp_path / "drive.mcap", iter([(stamps(1)[0], cloud_points(0))]))
    assert is_recording(tmp_path)
    with pytest.raises(ScanError, match=r"holds drive\.mcap and scans such as a\.npy; give one or the other"):
        open_recording(tmp_path)


def test_several_topics_have_to_be_named(tmp_path: Path) -> None:
    topics = {"/front": clouds(2), "/rear": clouds(3)}
    recording = open_recording(write_mcap(tmp_path / "a.mcap", topics, others={"/note": "std_msgs/msg/String"}))
    assert recording.point_cloud_topic("/rear").messages == 3
    for name, message in (
        (None, r"give --topic: /front \(sensor_msgs/msg/PointCloud2, 2\), /rear \(.*, 3\)$"),
        ("/left", r"no topic /left; there are /front .*, /note \(std_msgs/msg/String, 1\)"),
        ("/note", "/note holds std_msgs/msg/String, not scans"),
    ):
        with pytest.raises(ScanError, match=message):
            recording.point_cloud_topic(name)


def test_an_mcap_without_its_end_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "cut.mcap", {"/lidar": clouds(8)})
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    recording = open_recording(path)
    topic = recording.point_cloud_topic()
    scans = list(RecordedScans(recording, topic, 1.0).read())
    assert 2 <= len(scans) < 8 and topic.messages == len(scans)
    assert f"ends early, after {len(scans)} messages of /lidar" in str(recording.damage)
    assert [one.time_ns for one in scans] == stamps(8)[: len(scans)]


@pytest.mark.parametrize("summary", [True, False])
def test_a_damaged_chunk_costs_its_messages_alone(tmp_path: Path, summary: bool) -> None:
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(8)}, use_statistics=summary)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    recording = open_recording(path)
    read = [one.recorded_ns for one in recording.messages("/lidar")]
    assert 4 < len(read) < 8 and read[0] == stamps(8)[0] and read[-1] == stamps(8)[-1]
    assert "1 of its chunks are damaged" in str(recording.damage)


def test_chunks_that_an_index_counts_and_that_are_gone_are_damage(tmp_path: Path) -> None:
    """Zeros over the header of one chunk: it is empty to the library."""
    from mcap.reader import make_reader

    path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(8), "/rear": clouds(1)})
    with path.open("r+b") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        file.seek(summary.chunk_indexes[1].chunk_start_offset)
        file.write(bytes(200))
    recording = open_recording(path)
    read = list(recording.messages("/lidar"))
    assert 0 < len(read) < 8
    assert str(recording.damage).startswith(f"{path}: {len(read)} of the 8 messages of /lidar can be read")
    assert len(list(recording.messages("/rear"))) == 1 and recording.damage is None


def test_messages_that_a_rosbag2_counts_and_that_are_gone_are_damage(tmp_path: Path) -> None:
    import apsw

    write_recording(tmp_path / "bag", iter([(time_ns, cloud_points(0)) for time_ns in stamps(3)]))
    with apsw.Connection(str(tmp_path / "bag" / "bag.db3")) as connection:
        connection.execute(f"DELETE FROM messages WHERE timestamp = {stamps(3)[1]}")
    recording = open_recording(tmp_path / "bag")
    assert len(list(recording.messages(TOPIC))) == 2
    assert f"2 of the 3 messages of {TOPIC} can be read" in str(recording.damage)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.mcap", b"", "empty"),
        ("a.mcap", b"no recording at all" * 9, "not a readable MCAP"),
        ("a.db3", b"SQLite or not" * 99, "not a readable rosbag2"),
        ("a.bag", b"#ROSBAG V9.9\n" * 99, "not a readable ROS 1 bag"),
    ],
)
def test_what_is_no_recording_is_named(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ScanError, match=said) as refusal:
        list(open_recording(path).messages("/lidar"))
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_scans_that_cannot_be_read_are_told_one_by_one(tmp_path: Path) -> None:
    flat = laid_out(cloud_points(0), layout=[("x", "f4", 0), ("y", "f4", 4)], step=8)
    messages = list(zip(stamps(3), (clouds(1)[0][1], b"torn", flat), strict=True))
    scans = read_scans(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    assert [one.scan is None for one in scans] == [False, True, True]
    assert "a.mcap, /lidar, message 1: not a readable PointCloud2" in str(scans[1].error_text)
    assert "message 2: no field z" in str(scans[2].error_text)


def test_messages_that_cannot_be_read_are_not_tried_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_scans, "MAX_UNREADABLE", 5)
    good = clouds(1)[0][1]
    messages = [(time, good if number in (0, 5, 11) else b"torn") for number, time in enumerate(stamps(12))]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    scans = list(RecordedScans(recording, recording.point_cloud_topic(), 1.0).read())
    assert len(scans) == 11 and [one.number for one in scans if one.scan is not None] == [0, 5]
    assert "message 11: 5 before it cannot be read" in str(recording.damage)


def scans_of(path: Path, points: list[np.ndarray], **options: Any) -> RecordedScans:
    """Of a recording with these clouds, one reflectance scale for all of them."""
    messages = [(time, laid_out(one, time_ns=time)) for time, one in zip(stamps(len(points)), points, strict=True)]
    recording = open_recording(write_mcap(path, {"/lidar": messages}, **options))
    return RecordedScans(recording, recording.point_cloud_topic(), "auto")


BRIGHT = cloud_points(0)
BRIGHT[:, 3] = np.linspace(0, 255, len(BRIGHT))


def test_the_reflectance_scale_is_decided_once_for_the_recording(tmp_path: Path) -> None:
    dark = cloud_points(1)
    dark[:, 3] = 1.5
    scans = scans_of(tmp_path / "a.mcap", [dark, BRIGHT])
    assert scans.scale.scale == 255.0
    first = next(scans.read()).scan
    assert first is not None and first.points[0, 3] == pytest.approx(1.5 / 255)


@pytest.mark.parametrize("nothing", [BRIGHT[:0], BRIGHT * np.float32(np.nan)], ids=["no points", "not finite"])
def test_scans_without_points_have_no_say_in_the_reflectance_scale(tmp_path: Path, nothing: np.ndarray) -> None:
    """As while the sensor starts."""
    scans = scans_of(tmp_path / "a.mcap", [*[nothing] * 20, BRIGHT, BRIGHT])
    assert scans.scale.scale == 255.0
    assert [len(scan.points) for scan in scans.first(8)] == [len(BRIGHT)] * 2, "nor in the sensor's height"


def test_scans_with_points_are_not_looked_for_without_end(tmp_path: Path) -> None:
    scans = scans_of(tmp_path / "a.mcap", [*[BRIGHT[:0]] * SEARCHED_MESSAGES, BRIGHT[:1]], chunk_size=100_000)
    assert scans.scale.scale == "auto" and not list(scans.first(8))
