"""MCAP files, read with the records of the format's own library; damaged records are skipped."""

import heapq
import struct
import zlib
from array import array
from collections import Counter, deque
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.messages import decompress_lz4, decompress_zstd
from asca_pillars.scans.recordings.recording import (
    LAST_NS,
    UNKNOWN_TYPE,
    Encoding,
    Message,
    Recording,
    Topic,
    merge_topics,
    reason,
)

_ENCODINGS: dict[str, Encoding] = {"cdr": "cdr", "ros1": "ros1", "json": "json", "protobuf": "protobuf"}
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 3, 4, 5, 6  # opcodes
_FIRST_PRIVATE = 0x80  # opcode
_RECORD, _MESSAGE_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_FOOTER_BYTES = 9 + 20 + 8  # with the magic bytes at the end of the file
_MAX_OTHER_RECORDS = 2**18
"""Largest number of records of a chunk that are not messages; twice the number of possible channels and schemas."""
_MAX_OPEN_BYTES = 2**28
"""Largest size of the chunks merged by time, bytes; beyond it, messages may be out of order."""


class _Stored(NamedTuple):
    """Message as stored in the file."""

    log_time: int
    channel_id: int
    data: bytes


class _Known(NamedTuple):
    """Schemas and channels read so far, by their numbers."""

    schemas: dict[int, Any]
    channels: dict[int, Any]

    def learn(self, record: Any) -> None:
        from mcap.records import Channel, Schema

        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record

    def channels_of(self, topic: str) -> set[int]:
        return {number for number, channel in self.channels.items() if channel.topic == topic}

    def topics(self, counts: dict[int, int]) -> list[Topic]:
        return merge_topics(
            Topic(channel.topic, self._type(channel), counts.get(number, 0))
            for number, channel in self.channels.items()
        )

    def _type(self, channel: Any) -> str:
        schema = self.schemas.get(channel.schema_id)
        return str(schema.name) if schema is not None else UNKNOWN_TYPE


class McapRecording(Recording):
    """MCAP file.

    Args:
        path: path of the recording in error messages.
        file: file to read; None: `path`.

    Raises:
        ScanError: not an MCAP file, or nothing in it can be read.
    """

    def __init__(self, path: Path, file: Path | None = None) -> None:
        self.path, self._file = path, file or path
        self._known = _Known({}, {})
        self._chunks: list[Any] = []
        """Indexes of chunks; empty where the records are read sequentially."""
        self._unread = 0  # chunks
        self._trouble: str | None = None
        with self._file.open("rb") as stream:
            if (counts := self._read_summary(stream)) is None:
                counts = self._count(stream)
        if self._unread and self.damage is None:
            self.damage = f"{self.path}: {self._unread_chunks()}"
        self.topics = self._known.topics(counts)

    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic by time; without an index by chunk, and by time within each."""
        self.damage, self._trouble, self._unread, count = None, None, 0, 0
        declared = sum(listed.messages for listed in self.topics if listed.name == topic)
        with self._file.open("rb") as stream:
            try:
                for stored in self._indexed(stream, topic) if self._chunks else self._scanned(stream, topic):
                    encoding = _ENCODINGS.get(name := self._known.channels[stored.channel_id].message_encoding)
                    if encoding is None:
                        known = ", ".join(_ENCODINGS)
                        raise ScanError(
                            f"{self.path}: {topic} is encoded as {name[:40] or 'nothing'}; {known} are read"
                        )
                    count += 1
                    yield Message(stored.log_time if stored.log_time <= LAST_NS else None, stored.data, encoding)
            except (ScanError, GeneratorExit):
                raise
            except Exception as error:  # decompressors and struct have errors of their own
                self.damage = f"{self.path}: ends early, after {count} messages of {topic} ({reason(error)})"
                return
        of_them = f"{count} of the {declared}" if count < declared else f"{count}"
        if self._unread:
            self.damage = f"{self.path}: {of_them} messages of {topic} can be read; {self._unread_chunks()}"
        elif count < declared:
            self.damage = f"{self.path}: {of_them} messages of {topic} can be read"

    def _read_summary(self, stream: IO[bytes]) -> dict[int, int] | None:
        """Read the index, topics included; return the number of messages of each channel.

        None without a complete summary: none at all, or one that lacks channels, schemas or chunks, for their
        repetition at the end is optional.
        """
        from mcap.records import ChunkIndex, Footer, Statistics
        from mcap.stream_reader import StreamReader

        known, chunks, statistics = _Known({}, {}), list[Any](), None
        try:
            stream.seek(-_FOOTER_BYTES, 2)
            footer = next(StreamReader(stream, skip_magic=True).records)
            if not isinstance(footer, Footer) or not footer.summary_start:
                return None
            stream.seek(footer.summary_start)
            for record in StreamReader(stream, skip_magic=True, emit_chunks=True).records:
                known.learn(record)
                if isinstance(record, Statistics):
                    statistics = record
                elif isinstance(record, ChunkIndex):
                    chunks.append(record)
        except Exception:  # no end, or not MCAP: decided by the records
            return None
        if statistics is None or not chunks:
            return None
        counts: dict[int, int] = statistics.channel_message_counts
        channels = counts.keys() | {number for chunk in chunks for number in chunk.message_index_offsets}
        schemas = {channel.schema_id for channel in known.channels.values()} - {0}
        is_whole = channels <= known.channels.keys() and schemas <= known.schemas.keys()
        if not is_whole or len(chunks) != statistics.chunk_count or sum(counts.values()) != statistics.message_count:
            return None
        self._known, self._chunks = known, sorted(chunks, key=lambda chunk: chunk.message_start_time)
        return counts

    def _count(self, stream: IO[bytes]) -> dict[int, int]:
        """Return the number of messages of each channel of a file without an index, up to where it can be read."""
        counts: Counter[int] = Counter()
        try:
            for record in self._records(stream):
                if isinstance(record, bytes):
                    counts.update(number for number, _, _ in self._messages_in(record))
                else:
                    counts[record.channel_id] += 1
        except Exception as error:
            if not self._known.channels and not self._unread:
                raise ScanError(
                    f"{self.path}: not a readable MCAP ({reason(error)}); copy or record it again"
                ) from None
            self.damage = f"{self.path}: ends early ({reason(error)})"
        return counts

    def _scanned(self, stream: IO[bytes], topic: str) -> Iterator[_Stored]:
        for record in self._records(stream):
            if isinstance(record, bytes):
                yield from self._sorted(record, topic)
            elif (channel := self._known.channels.get(record.channel_id)) is not None and channel.topic == topic:
                yield _Stored(record.log_time, record.channel_id, record.data)

    def _records(self, stream: IO[bytes]) -> Iterator[Any]:
        """Yield messages outside of chunks and decompressed records of each chunk; store channels and schemas."""
        from mcap.records import Chunk
        from mcap.records import Message as McapMessage
        from mcap.stream_reader import StreamReader

        stream.seek(0)
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            self._known.learn(record)
            if isinstance(record, McapMessage):
                yield record
            elif isinstance(record, Chunk) and (data := self._unpacked(record)) is not None:
                yield data

    def _indexed(self, stream: IO[bytes], topic: str) -> Iterator[_Stored]:
        """Merge the messages of chunks by time: those of several may be mixed."""
        channels = self._known.channels_of(topic)
        waiting = deque(
            chunk
            for chunk in self._chunks
            if not chunk.message_index_offsets or channels & chunk.message_index_offsets.keys()
        )
        opened: list[tuple[int, int, _Stored, Iterator[_Stored], int]] = []
        held = 0
        while waiting or opened:
            if waiting and (not opened or (waiting[0].message_start_time <= opened[0][0] and held < _MAX_OPEN_BYTES)):
                if (data := self._chunk_at(stream, waiting.popleft())) is None:
                    continue
                # Messages of equal times are returned in the order of their chunks in the file.
                number, messages, size = -len(waiting), self._sorted(data, topic), len(data)
                held += size
            else:
                _, number, stored, messages, size = heapq.heappop(opened)
                yield stored
            following = next(messages, None)
            if following is None:
                held -= size
            else:
                heapq.heappush(opened, (following.log_time, number, following, messages, size))

    def _chunk_at(self, stream: IO[bytes], index: Any) -> bytes | None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Chunk

        try:
            stream.seek(index.chunk_start_offset)
            opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
            if opcode != _CHUNK or length + _RECORD.size != index.chunk_length:
                raise ValueError("it is not where the index says")
            chunk = Chunk.read(ReadDataStream(BytesIO(stream.read(length))))
        except Exception as error:
            self._lose_chunk(error)
            return None
        return self._unpacked(chunk)

    def _unpacked(self, chunk: Any) -> bytes | None:
        """Return the records of a chunk; None, and count it as unread, if it is damaged."""
        try:
            if chunk.compression == "zstd":
                data = decompress_zstd(chunk.data, chunk.uncompressed_size)
            elif chunk.compression == "lz4":
                data = decompress_lz4(chunk.data, chunk.uncompressed_size)
            elif chunk.compression == "":
                data = chunk.data
            else:
                raise ValueError(f"compression {chunk.compression[:40]!r} is not read; zstd, lz4 and none are")
            if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
                raise ValueError("its checksum is another one")
        except Exception as error:
            self._lose_chunk(error)
            return None
        return bytes(data)

    def _unread_chunks(self) -> str:
        return f"{self._unread} of its chunks are damaged ({self._trouble})"

    def _lose_chunk(self, error: Exception) -> None:
        self._unread += 1
        self._trouble = self._trouble or reason(error)

    def _sorted(self, data: bytes, topic: str) -> Iterator[_Stored]:
        """Yield the messages of a topic in a chunk, by time; only their offsets are held."""
        times, starts, ends, numbers = array("Q"), array("Q"), array("Q"), array("H")
        for number, start, end in self._messages_in(data, topic):
            times.append(_MESSAGE_HEAD.unpack_from(data, start)[2])
            starts.append(start + _MESSAGE_HEAD.size)
            ends.append(end)
            numbers.append(number)
        for place in np.argsort(np.array(times, np.uint64), kind="stable"):
            yield _Stored(times[place], numbers[place], data[starts[place] : ends[place]])

    def _messages_in(self, data: bytes, topic: str | None = None) -> Iterator[tuple[int, int, int]]:
        """Yield channel, start and end of messages in a chunk, up to damage; store channels and schemas."""
        channels = None if topic is None else self._known.channels_of(topic)
        position, others = 0, 0
        try:
            while position < len(data):
                opcode, length = _RECORD.unpack_from(data, position)
                start, position = position + _RECORD.size, position + _RECORD.size + length
                if position > len(data):
                    raise ValueError("a record breaks off")
                if opcode == _MESSAGE and length >= _MESSAGE_HEAD.size:
                    number = data[start] | data[start + 1] << 8
                    if channels is None or number in channels:
                        yield number, start, position
                    continue
                others += 1
                if others > _MAX_OTHER_RECORDS:
                    raise ValueError(f"more than {_MAX_OTHER_RECORDS} records that are not messages")
                if opcode in (_SCHEMA, _CHANNEL):
                    number = data[start] | data[start + 1] << 8
                    if number not in (self._known.schemas if opcode == _SCHEMA else self._known.channels):
                        self._known.learn(record := _schema_or_channel(opcode, data[start:position]))
                        if channels is not None and opcode == _CHANNEL and record.topic == topic:
                            channels.add(number)
                elif opcode < _FIRST_PRIVATE:
                    raise ValueError(f"a record of type {opcode} within a chunk")
        except Exception as error:
            self._lose_chunk(error)


def _schema_or_channel(opcode: int, content: bytes) -> Any:
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Schema

    return (Schema if opcode == _SCHEMA else Channel).read(ReadDataStream(BytesIO(content)))
