"""SQLite files of rosbag2 with rows that cannot be used."""

import sqlite3
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.recorded_scans import RecordedScans, open_recording
from asca_pillars.scans.transforms import read_poses
from tests.scans.recordings.cloud_recordings import (
    CLOUD,
    ODOMETRY,
    clouds,
    odometry_message,
    read_scans,
    serialized,
    stamps,
)

# As version 1 of rosbag2 has them; later ones have more columns and tables.
TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp, data);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO topics VALUES (1, '/lidar', 'sensor_msgs/msg/PointCloud2', 'cdr');
"""

FLIPS = [
    [(1868, 64), (2003, 16), (1185, 4)],
    [(2037, 4), (1470, 16), (2023, 32)],
    [(1330, 64), (2021, 16), (2009, 32)],
]
"""Bits, each by its byte's place, in the rows and their index, found at random."""


def database(path: Path, *statements: tuple[str, tuple[Any, ...]], stamped: bool = True, points: int = 50) -> Path:
    """Five scans, changed by statements; without `stamped` the times are in the rows alone."""
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(TABLES)
        for time_ns, message in clouds(5, points):
            if not stamped:
                message.header.stamp.sec = message.header.stamp.nanosec = 0
            data = serialized(message, CLOUD)
            connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (time_ns, data))
        for statement, values in statements:
            connection.execute(statement, values)
        connection.commit()
    return path


@pytest.mark.parametrize("data", [None, 7, 1.5, "text", b"", b"torn"], ids=str)
def test_a_row_without_usable_data_costs_its_scan_alone(tmp_path: Path, data: Any) -> None:
    found = read_scans(database(tmp_path / "a.db3", ("UPDATE messages SET data = ? WHERE id = 3", (data,))))
    assert [one.scan is not None for one in found] == [True, True, False, True, True]
    assert [one.time_ns for one in found] == stamps(5)
    assert "a.db3, /lidar, message 2" in str(found[2].error_text)


@pytest.mark.parametrize("time_ns", [None, 1e300, 1.5, -1, -(2**63), "soon", b"\xff"], ids=str)
def test_times_that_are_none_are_taken_as_zero_and_said(tmp_path: Path, time_ns: Any) -> None:
    changed = ("UPDATE messages SET timestamp = ? WHERE id = 3", (time_ns,))
    found = read_scans(database(tmp_path / "a.db3", changed, stamped=False))
    assert sorted(one.time_ns for one in found) == [0, *stamps(5)[:2], *stamps(5)[3:]]
    for one in found:
        assert one.scan is not None and isinstance(one.time_ns, int)
        assert bool(one.scan.notes.remarks) == (one.time_ns == 0)
    # Where the header has a stamp, nothing is wrong.
    found = read_scans(database(tmp_path / "b.db3", changed))
    assert sorted(one.time_ns for one in found) == stamps(5)
    assert all(one.scan is not None and one.scan.notes.remarks == () for one in found)


UNUSABLE = (None, b"\xff", "")


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        *(("name", value, "5 messages belong to no topic with a name; .* /odom .*again") for value in UNUSABLE),
        ("name", 7, None),  # SQLite keeps it as text
        *(("type", value, r"name it \(--topic /lidar\)") for value in UNUSABLE),
        ("type", 7, "/lidar"),
        *(("serialization_format", value, None) for value in UNUSABLE),
        ("serialization_format", 7, "is encoded as 7; cdr is read"),
    ],
)
def test_topics_that_are_not_described(tmp_path: Path, column: str, value: Any, message: str | None) -> None:
    odometry = "INSERT INTO topics VALUES (2, '/odom', 'nav_msgs/msg/Odometry', 'cdr')"
    path = database(tmp_path / "a.db3", (f"UPDATE topics SET {column} = ?", (value,)), (odometry, ()))
    if message is None:
        assert len(read_scans(path)) == 5
        return
    with pytest.raises(ScanError, match=message):
        read_scans(path)
    assert column != "type" or value == 7 or len(read_scans(path, "/lidar")) == 5


def test_messages_of_no_topic(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="5 messages belong to no topic"):
        read_scans(database(tmp_path / "a.db3", ("DELETE FROM topics", ())))


def test_a_view_is_no_table(tmp_path: Path) -> None:
    """It may have rows without end."""
    endless = "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n"
    path = database(tmp_path / "a.db3", ("DROP TABLE messages", ()), (endless, ()))
    with pytest.raises(ScanError, match="no tables messages and topics"):
        open_recording(path)


def test_damaged_pages_cost_the_scans_on_them(tmp_path: Path) -> None:
    whole = database(tmp_path / "a.db3", points=2000).read_bytes()  # each on pages of its own
    counts = set()
    for start in range(4096, len(whole), 4096):
        damaged = whole[:start] + b"\xff" * 4096 + whole[start + 4096 :]
        (tmp_path / "b.db3").write_bytes(damaged)
        with suppress(ScanError):
            recording = open_recording(tmp_path / "b.db3")
            found = list(RecordedScans(recording, recording.point_cloud_topic(), 1.0).read())
            assert [one.time_ns for one in found] == stamps(5)[: len(found)]
            assert recording.damage is not None or len(found) == 5
            counts.add(sum(one.scan is not None for one in found))
    assert max(counts) <= 5 and 4 in counts


@pytest.mark.parametrize("bits", FLIPS)
def test_damaged_rows_do_not_lead_back_to_earlier_ones(tmp_path: Path, bits: list[tuple[int, int]]) -> None:
    """SQLite moves all cursors of a connection after an error: with one connection these files had rows without end."""
    path = tmp_path / "a.db3"
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(f"PRAGMA page_size = 512; {TABLES}")
        for number in range(6):
            row = number * 10**8, bytes([number]) * 60
            connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", row)
        connection.commit()
    content = bytearray(path.read_bytes())
    for place, bit in bits:
        content[place] ^= bit
    path.write_bytes(content)
    assert len(list(islice(open_recording(path).messages("/lidar"), 50))) <= 6


def test_poses_without_a_time_are_left_out(tmp_path: Path) -> None:
    data = serialized(odometry_message(0, 1.0), ODOMETRY)
    add = "INSERT INTO messages(topic_id, timestamp, data) VALUES (2, ?, ?)"
    topic: tuple[str, tuple[Any, ...]] = ("INSERT INTO topics VALUES (2, '/odom', 'nav_msgs/msg/Odometry', 'cdr')", ())
    path = database(tmp_path / "a.db3", topic, *((add, (time_ns, data)) for time_ns in (None, 1e300, 5)))
    assert read_poses(open_recording(path), "/odom").times_ns.tolist() == [5]
