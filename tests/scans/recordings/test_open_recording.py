"""Recordings of every kind: topics, order, damage."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings import recorded_scans
from asca_pillars.scans.recordings.open_recording import is_recording, open_recording
from asca_pillars.scans.recordings.recorded_scans import SEARCHED_MESSAGES, RecordedScans
from benchmarks.made_recordings import TOPIC, write_recording
from tests.scans.recordings.cloud_recordings import CLOUD, cloud_points, clouds, laid_out, stamps, store, write_mcap


@pytest.mark.parametrize("name", ["drive.mcap", "drive_bag", "drive.bag"])
def test_scans_and_times_come_back(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    times = stamps(5)
    assert write_recording(path, iter([(time_ns, cloud_points(i)) for i, time_ns in enumerate(times)])) == 5
    assert is_recording(path)
    recording = open_recording(path)
    topic = recording.point_cloud_topic()
    assert (topic.name, topic.messages) == (TOPIC, 5)
    scans = list(RecordedScans(recording, topic, "auto").read())
    assert [one.time_ns for one in scans] == times and recording.damage is None
    for index, one in enumerate(scans):
        assert one.scan is not None and np.array_equal(one.scan.points, cloud_points(index))
    assert [one.number for one in RecordedScans(recording, topic, 1.0).read(3)] == [3, 4]


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("mode", ["MESSAGE", "FILE"])
def test_compressed_rosbag2(tmp_path: Path, storage: str, mode: str) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    one, times = store(), stamps(3)
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/lidar", CLOUD, typestore=one)
        for index, (time_ns, message) in enumerate(clouds(3)):
            assert time_ns == times[index]
            writer.write(connection, time_ns, one.serialize_cdr(message, CLOUD))
    assert is_recording(tmp_path / "bag")
    recording = open_recording(tmp_path / "bag")
    scans = list(RecordedScans(recording, recording.point_cloud_topic(), 1.0).read())
    assert [one.time_ns for one in scans] == times and all(one.scan is not None for one in scans)


def test_a_recording_among_scans_is_refused(tmp_path: Path) -> None:
    write_recording(tmp_path / "drive.mcap", iter([(stamps(1)[0], cloud_points(0))]))
    np.save(tmp_path / "a.npy", cloud_points(0))
    assert is_recording(tmp_path)
    with pytest.raises(ScanError, match=r"holds drive\.mcap and scans such as a\.npy; give one or the other"):
        open_recording(tmp_path)


def test_a_metadata_yaml_of_others_makes_no_recording(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", cloud_points(0))
    (tmp_path / "metadata.yaml").write_text("weather: rain\n")
    assert not is_recording(tmp_path)


def test_a_suffix_in_capitals(tmp_path: Path) -> None:
    write_recording(tmp_path / "drive.bag", iter([(stamps(1)[0], cloud_points(0))]))
    write_recording(tmp_path / "drive", iter([(stamps(1)[0], cloud_points(0))]))
    (tmp_path / "drive" / "drive.db3").rename(tmp_path / "DRIVE #1?%20.DB3")  # no address, a name
    (tmp_path / "drive.bag").rename(tmp_path / "DRIVE.BAG")
    for path in (tmp_path / "DRIVE.BAG", tmp_path / "DRIVE #1?%20.DB3"):
        recording = open_recording(path)
        (one,) = RecordedScans(recording, recording.point_cloud_topic(), 1.0).read()
        assert is_recording(path) and one.scan is not None and np.array_equal(one.scan.points, cloud_points(0))


def test_a_database_alone_and_one_with_its_metadata(tmp_path: Path) -> None:
    write_recording(tmp_path / "bag", iter([(stamps(1)[0], cloud_points(0))]))
    (database,) = (tmp_path / "bag").glob("*.db3")
    assert open_recording(database).point_cloud_topic().messages == 1
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert open_recording(tmp_path / "bag").point_cloud_topic().messages == 1


def test_a_folder_of_mcap_files_is_one_recording(tmp_path: Path) -> None:
    everything = clouds(12)
    for part in range(12):
        write_mcap(tmp_path / "bag" / f"bag_{part}.mcap", {"/lidar": everything[part : part + 1]})
    with pytest.raises(ScanError, match="12 recordings, and no metadata"):
        open_recording(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: {storage_identifier: mcap}")
    recording = open_recording(tmp_path / "bag")
    assert [one.recorded_ns for one in recording.messages("/lidar")] == stamps(12), "10 comes after 9"
    assert recording.point_cloud_topic().messages == 12


def test_several_topics_have_to_be_named(tmp_path: Path) -> None:
    path = write_mcap(
        tmp_path / "a.mcap", {"/front": clouds(2), "/rear": clouds(3)}, others={"/note": "std_msgs/msg/String"}
    )
    recording = open_recording(path)
    with pytest.raises(ScanError, match=r"give --topic: /front \(sensor_msgs/msg/PointCloud2, 2\), /rear \(.*, 3\)$"):
        recording.point_cloud_topic()
    assert recording.point_cloud_topic("/rear").messages == 3
    with pytest.raises(ScanError, match=r"no topic /left; there are /front .*, /note \(std_msgs/msg/String, 1\)"):
        recording.point_cloud_topic("/left")
    with pytest.raises(ScanError, match="/note holds std_msgs/msg/String, not scans"):
        recording.point_cloud_topic("/note")


def test_no_scans_at_all(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", {}, others={"/note": "std_msgs/msg/String"})
    with pytest.raises(ScanError, match=r"no topic of type sensor_msgs/msg/PointCloud2; there are /note"):
        open_recording(path).point_cloud_topic()


def test_an_mcap_without_its_end_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "whole.mcap", {"/lidar": clouds(8)})
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: int(len(data) * 0.6)])
    recording = open_recording(cut)
    topic = recording.point_cloud_topic()
    scans = list(RecordedScans(recording, topic, 1.0).read())
    assert 2 <= len(scans) < 8 and topic.messages == len(scans)
    assert recording.damage is not None and f"ends early, after {len(scans)} messages of /lidar" in recording.damage
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
    assert recording.damage is not None and "1 of its chunks are damaged" in recording.damage


def test_chunks_that_an_index_counts_and_that_are_gone_are_damage(tmp_path: Path) -> None:
    """Zeros over the header of one chunk: it is empty to the library."""
    from mcap.reader import make_reader

    path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(8), "/rear": clouds(1)})
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    data, start = bytearray(path.read_bytes()), summary.chunk_indexes[1].chunk_start_offset
    data[start : start + 200] = bytes(200)
    path.write_bytes(data)
    recording = open_recording(path)
    read = list(recording.messages("/lidar"))
    assert 0 < len(read) < 8
    assert recording.damage is not None
    assert recording.damage.startswith(f"{path}: {len(read)} of the 8 messages of /lidar can be read")
    assert len(list(recording.messages("/rear"))) == 1 and recording.damage is None


def test_messages_that_a_rosbag2_counts_and_that_are_gone_are_damage(tmp_path: Path) -> None:
    import apsw

    write_recording(tmp_path / "bag", iter([(time_ns, cloud_points(0)) for time_ns in stamps(3)]))
    (database,) = (tmp_path / "bag").glob("*.db3")
    with apsw.Connection(str(database)) as connection:
        connection.execute(f"DELETE FROM messages WHERE timestamp = {stamps(3)[1]}")
    recording = open_recording(tmp_path / "bag")
    assert len(list(recording.messages(TOPIC))) == 2
    assert recording.damage is not None and f"2 of the 3 messages of {TOPIC} can be read" in recording.damage


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.mcap", b"", "empty"),
        ("a.mcap", b"no recording at all" * 9, "no readable MCAP"),
        ("a.db3", b"SQLite or not" * 99, "no readable rosbag2"),
        ("a.bag", b"#ROSBAG V9.9\n" * 99, "no readable ROS 1 bag"),
    ],
)
def test_what_is_no_recording_is_named(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ScanError, match=said) as refusal:
        list(open_recording(path).messages("/lidar"))
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_missing_paths_and_folders_of_scans(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="no such file"):
        open_recording(tmp_path / "drive.mcap")
    assert not is_recording(tmp_path)


def test_scans_that_cannot_be_read_are_told_one_by_one(tmp_path: Path) -> None:
    good = clouds(3)
    flat = laid_out(cloud_points(0), layout=[("x", "f4", 0), ("y", "f4", 4)], step=8)
    messages = [good[0], (good[1][0], b"torn"), (good[2][0], flat)]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    scans = list(RecordedScans(recording, recording.point_cloud_topic(), "auto").read())
    assert [one.scan is None for one in scans] == [False, True, True]
    assert "a.mcap, /lidar, message 1: no readable PointCloud2" in str(scans[1].error_text)
    assert "message 2: no field z" in str(scans[2].error_text)


def test_messages_that_cannot_be_read_are_not_tried_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_scans, "MAX_UNREADABLE", 5)
    good, times = clouds(3), stamps(16)
    messages = [(times[0], good[0][1]), *((time, b"torn") for time in times[1:5]), (times[5], good[1][1])]
    messages += [*((time, b"torn") for time in times[6:11]), (times[11], good[2][1])]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    scans = list(RecordedScans(recording, recording.point_cloud_topic(), 1.0).read())
    assert len(scans) == 11 and [one.number for one in scans if one.scan is not None] == [0, 5]
    assert recording.damage is not None and "message 11: 5 before it cannot be read" in recording.damage


def test_the_reflectance_scale_is_decided_once_for_the_recording(tmp_path: Path) -> None:
    dark, bright = cloud_points(0), cloud_points(1)
    dark[:, 3], bright[:, 3] = 1.5, np.linspace(0, 255, len(bright))
    messages = [(time, laid_out(points, time_ns=time)) for time, points in zip(stamps(2), (dark, bright), strict=True)]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    scans = RecordedScans(recording, recording.point_cloud_topic(), "auto")
    assert scans.scale.scale == 255.0
    first = next(scans.read()).scan
    assert first is not None and first.points[0, 3] == pytest.approx(1.5 / 255)


@pytest.mark.parametrize("nothing", [0, np.nan])
def test_scans_without_points_have_no_say_in_the_reflectance_scale(tmp_path: Path, nothing: float) -> None:
    """Twenty scans of no points, or of points that are not finite, while the sensor starts."""
    bright, times = cloud_points(0), stamps(22)
    bright[:, 3] = np.linspace(0, 255, len(bright))
    none = bright[:0] if nothing == 0 else bright * np.float32(nothing)
    messages = [(time, laid_out(none if time < times[20] else bright, time_ns=time)) for time in times]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    scans = RecordedScans(recording, recording.point_cloud_topic(), "auto")
    assert scans.scale.scale == 255.0
    assert [len(scan.points) for scan in scans.first(8)] == [len(bright)] * 2, "nor in the sensor's height"


def test_scans_with_points_are_not_looked_for_without_end(tmp_path: Path) -> None:
    late = [
        (time, laid_out(cloud_points(0)[: number // SEARCHED_MESSAGES]))
        for number, time in enumerate(stamps(SEARCHED_MESSAGES + 1))
    ]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": late}, chunk_size=100_000))
    scans = RecordedScans(recording, recording.point_cloud_topic(), "auto")
    assert scans.scale.scale == "auto" and not list(scans.first(8))
