"""ROS 1 bags, read with the library rosbags; damaged chunks and messages are skipped."""

import heapq
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import repeat
from pathlib import Path
from typing import Any

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.decompression import decompress_bz2, decompress_lz4
from asca_pillars.scans.recordings.recording import SEVERAL_TYPES, Message, Recording, Topic, reason


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
            connections = {one.id: one for one in reader.connections if one.topic == topic}
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
        declared = sum(one.messages for one in self.topics if one.name == topic)
        if count < declared:
            self.damage = f"{self.path}: {count} of the {declared} messages of {topic} can be read{trouble}"

    def _opened(self) -> Any:
        from rosbags.rosbag1 import Reader

        try:
            reader = Reader(self._file)
            reader.open()
        except Exception as error:
            raise ScanError(
                f"{self.path}: no readable ROS 1 bag ({reason(error)}); copy it again, or mend its index "
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
