"""ROS bags: of ROS 1, and rosbag2's folders and SQLite files; a damaged message, row or chunk is skipped.

ROS 1 bags are read with the library rosbags.
"""

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from asca_pillars.base.errors import ScanError
from asca_pillars.base.settings import MAX_CHARACTERS, parse_yaml
from asca_pillars.scans.recordings.messages import decompress_bz2, decompress_lz4
from asca_pillars.scans.recordings.recording import (
    LAST_NS,
    SEVERAL_TYPES,
    UNKNOWN_TYPE,
    Message,
    Recording,
    Topic,
    merge_topics,
    reason,
)

if TYPE_CHECKING:
    import sqlite3  # not included in every Python


_INSTRUCTIONS = 10_000
"""Limit of SQLite's work: a hundred times 10,000 instructions, and a hundred for each byte of the file; files of the
messages need less than one for each."""


class SqliteRecording(Recording):
    """`.db3` file of any version of rosbag2.

    Args:
        path: path of the recording in error messages.
        file: file to read; None: `path`.

    Raises:
        ScanError: not such a file, or it cannot be read.
    """

    def __init__(self, path: Path, file: Path | None = None) -> None:
        self.path, self._file = path, file or path
        try:
            with closing(self._connected()) as database:
                self._read_topics(database)
        except Exception as error:  # SQLite's own, and UnicodeDecodeError of its messages about damage
            raise ScanError(
                f"{path}: not a readable rosbag2 ({reason(error)}); copy it again, or repair it "
                "(sqlite3 broken.db3 .recover | sqlite3 repaired.db3)"
            ) from None

    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic by time; a row without intact data is a message without data."""
        self.damage, count = None, 0
        declared = sum(listed.messages for listed in self.topics if listed.name == topic)
        numbers = self._numbers[topic]
        if formats := self._formats[topic] - {"cdr"}:
            raise ScanError(f"{self.path}: {topic} is encoded as {', '.join(sorted(formats))[:40]}; cdr is read")
        # An error in one query of a connection affects its others: data are read through a separate connection.
        with closing(self._connected()) as database, closing(self._connected()) as data:
            try:
                rows = database.execute(
                    f"SELECT rowid, timestamp FROM messages WHERE topic_id IN ({', '.join('?' * len(numbers))}) "
                    "ORDER BY timestamp",
                    numbers,
                )
                for row, recorded_ns in rows:
                    if count == declared:  # damaged pages that refer to each other give endless rows
                        raise ValueError("its index of times is damaged")
                    is_usable = isinstance(recorded_ns, int) and 0 <= recorded_ns <= LAST_NS
                    yield Message(recorded_ns if is_usable else None, self._data(data, row), "cdr")
                    count += 1
            except Exception as error:
                self.damage = f"{self.path}: ends early, after {count} messages of {topic} ({reason(error)})"

    def _connected(self) -> "sqlite3.Connection":
        import sqlite3

        # A detector's stream may read in another thread than the opening one, but never in two at once.
        connection = sqlite3.connect(f"{self._file.resolve().as_uri()}?immutable=1", uri=True, check_same_thread=False)
        connection.text_factory = _text
        left = iter(range(100 + self._file.stat().st_size // 100))
        connection.set_progress_handler(lambda: next(left, None) is None, _INSTRUCTIONS)
        return connection

    def _read_topics(self, database: "sqlite3.Connection") -> None:
        tables = database.execute(
            "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('messages', 'topics')"
        )
        if tables.fetchone()[0] != 2:
            raise ValueError("it has no tables messages and topics")
        counts = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall())
        topics: list[Topic] = []
        self._numbers: dict[str, list[Any]] = {}
        self._formats: dict[str, set[str]] = {}
        for number, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            if not isinstance(name, str) or not name:
                continue
            kind = kind if isinstance(kind, str) and kind else UNKNOWN_TYPE
            topics.append(Topic(name, kind, counts.pop(number, 0)))
            self._numbers.setdefault(name, []).append(number)
            self._formats.setdefault(name, set()).add(encoding if isinstance(encoding, str) and encoding else "cdr")
        self.topics = merge_topics(topics)
        if lost := sum(counts.values()):
            self.damage = f"{self.path}: {lost} messages belong to no topic with a name"

    @staticmethod
    def _data(database: "sqlite3.Connection", row: int) -> bytes:
        try:
            row_data = database.execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
        except Exception:  # damaged pages
            return b""
        return row_data[0] if row_data is not None and isinstance(row_data[0], bytes) else b""


def _text(content: bytes) -> str:
    return content.decode("utf-8", errors="replace")


METADATA_FILE = "metadata.yaml"
_KEY = "rosbag2_bagfile_information"


@dataclass(frozen=True)
class BagMetadata:
    """Names of files and the number of messages of each topic, as far as a metadata.yaml states them."""

    files: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)


def read_metadata(folder: Path) -> BagMetadata | None:
    """Read the folder's metadata.yaml; return None if it is missing, or not one of rosbag2."""
    path = folder / METADATA_FILE
    if not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(4 * MAX_CHARACTERS).decode("utf-8-sig", errors="replace")
    if _KEY not in text:
        return None
    try:
        content = parse_yaml(text)[_KEY]
        names = tuple(Path(str(name)).name for name in content.get("relative_file_paths") or ())
        counts = {
            str(entry["topic_metadata"]["name"]): int(entry["message_count"])
            for entry in content.get("topics_with_message_count") or ()
        }
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return BagMetadata()
    return BagMetadata(names, counts)


class SplitRecording(Recording):
    """Files of a folder as one recording.

    Args:
        path: the folder.
        files: files in their order.
        counts: stated number of messages of each topic.
        trouble: error of files that are not among these; None: none.
    """

    def __init__(
        self, path: Path, files: Sequence[Recording], counts: Mapping[str, int], trouble: str | None = None
    ) -> None:
        self.path, self._files, self._counts, self._trouble = path, files, counts, trouble
        self.topics = merge_topics(topic for file in files for topic in file.topics)
        self.notes = tuple(note for file in files for note in file.notes)
        self.damage = trouble or next((file.damage for file in files if file.damage), None)

    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic, file by file; damage in one does not end the recording."""
        self.damage, count = self._trouble, 0
        for file in self._files:
            if all(listed.name != topic for listed in file.topics):
                continue
            for message in file.messages(topic):
                count += 1
                yield message
            self.damage = self.damage or file.damage
        if self.damage is None and count < (declared := self._counts.get(topic, 0)):
            self.damage = f"{self.path}: {count} of the {declared} messages of {topic} can be read"


class RosBag(Recording):
    """ROS 1 `.bag` file.

    Args:
        path: path of the recording in error messages.
        file: file to read; None: `path`.

    Raises:
        ScanError: not such a recording, or it cannot be read.
    """

    def __init__(self, path: Path, file: Path | None = None) -> None:
        self.path, self._file = path, file or path
        with self._opened() as reader:
            self.topics = sorted(
                Topic(name, info.msgtype or SEVERAL_TYPES, info.msgcount) for name, info in reader.topics.items()
            )

    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic by time; those that cannot be read are left out."""
        self.damage, count, trouble = None, 0, ""
        damaged_chunks: set[int] = set()
        with self._opened() as reader:
            connections = {connection.id: connection for connection in reader.connections if connection.topic == topic}
            entries = [zip(reader.indexes[number], repeat(number)) for number in connections]
            for entry, number in heapq.merge(*entries, key=lambda pair: pair[0].time):
                if entry.chunk_pos in damaged_chunks:
                    continue
                # The library's generator ends at the first error, so a new one is created for each message.
                reader.indexes[number] = [entry]
                try:
                    _, time_ns, data = next(reader.messages([connections[number]]))
                except Exception as error:  # of the decompressors, the library
                    trouble = trouble or f" ({reason(error)})"
                    if reader.current_chunk[0] != entry.chunk_pos:
                        damaged_chunks.add(entry.chunk_pos)
                        reader.current_chunk = (-1, BytesIO())  # the previous one was closed
                    continue
                count += 1
                yield Message(time_ns, bytes(data), "ros1")
        declared = sum(listed.messages for listed in self.topics if listed.name == topic)
        if count < declared:
            self.damage = f"{self.path}: {count} of the {declared} messages of {topic} can be read{trouble}"

    def _opened(self) -> Any:
        from rosbags.rosbag1 import Reader

        try:
            reader = Reader(self._file)
            reader.open()
        except Exception as error:
            raise ScanError(
                f"{self.path}: not a readable ROS 1 bag ({reason(error)}); copy it again, or repair its index "
                "(rosbag reindex)"
            ) from None
        reader.chunks = {place: chunk._replace(decompressor=_bounded(chunk)) for place, chunk in reader.chunks.items()}
        return _Closing(reader)


def _bounded(chunk: Any) -> Callable[[bytes], bytes]:
    """Return a function that decompresses a chunk up to a limit, in place of the library's."""
    from rosbags.rosbag1.reader import Compression, decompressors

    bounded: dict[str, Callable[[bytes], bytes]] = {
        Compression.BZ2.value: decompress_bz2,
        Compression.LZ4.value: decompress_lz4,
    }
    return next((bounded[name] for name in bounded if decompressors[name] is chunk.decompressor), chunk.decompressor)


class _Closing:
    """Context manager for a reader that is already open."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> Any:
        return self._reader

    def __exit__(self, *_: object) -> None:
        self._reader.close()
