"""MCAP files, by the format's own library; one whose end is missing is read as far as it goes."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from asca_pillars.data.recordings.messages import reason
from asca_pillars.data.recordings.recording import Encoding, Message, Recording, Topic
from asca_pillars.errors import ScanError

_ENCODINGS: dict[str, Encoding] = {"cdr": "cdr", "ros1": "ros1"}


class McapRecording(Recording):
    """One MCAP file, or several that follow each other.

    Raises:
        ScanError: no MCAP, or nothing of it can be read.
    """

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self.path, self._files = path, files
        self._counts: dict[Path, Counter[str]] = {}  # of files with an index, by topic
        topics: dict[str, Topic] = {}
        for file in files:
            for topic in self._topics(file):
                before = topics.get(topic.name, topic._replace(messages=0))
                topics[topic.name] = topic._replace(messages=before.messages + topic.messages)
        self.topics = [topics[name] for name in sorted(topics)]

    def messages(self, topic: str) -> Iterator[Message]:
        """The messages of a topic; the first file that lacks some is named in `damage`, and the next one goes on."""
        self.damage = None
        for file in self._files:
            count = 0
            with file.open("rb") as stream:
                try:
                    for channel, message in self._stored(file, stream, topic):
                        encoding = _ENCODINGS.get(channel.message_encoding)
                        if encoding is None:
                            raise ScanError(
                                f"{file}: {topic} is encoded as {channel.message_encoding[:40] or 'nothing'}; "
                                "cdr and ros1 are read"
                            )
                        count += 1
                        yield Message(message.log_time, message.data, encoding)
                    # The library passes over chunks whose header is overwritten.
                    declared = self._counts[file][topic] if file in self._counts else 0
                    if count < declared:
                        self._damaged(f"{file}: {count} of the {declared} messages of {topic} can be read")
                except (ScanError, GeneratorExit):
                    raise
                except Exception as error:  # decompressors and struct have errors of their own
                    self._damaged(f"{file}: ends early, after {count} messages of {topic} ({reason(error)})")

    def _damaged(self, said: str) -> None:
        self.damage = self.damage or said

    def _stored(self, file: Path, stream: IO[bytes], topic: str) -> Iterator[tuple[Any, Any]]:
        from mcap.reader import SeekingReader
        from mcap.records import Channel
        from mcap.records import Message as McapMessage
        from mcap.stream_reader import StreamReader

        if file in self._counts:
            for _, channel, message in SeekingReader(stream, validate_crcs=True).iter_messages(topics=[topic]):
                yield channel, message
            return
        channels: dict[int, Any] = {}
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage) and channels[record.channel_id].topic == topic:
                yield channels[record.channel_id], record

    def _topics(self, file: Path) -> list[Topic]:
        from mcap.reader import SeekingReader

        with file.open("rb") as stream:
            try:
                summary = SeekingReader(stream).get_summary()
            except Exception:  # no end, no index, or no MCAP: the records themselves tell
                summary = None
            if summary is not None and summary.statistics is not None and summary.chunk_indexes:
                counts = summary.statistics.channel_message_counts
                topics = [
                    Topic(channel.topic, _type(summary.schemas, channel), counts.get(channel.id, 0))
                    for channel in summary.channels.values()
                ]
                self._counts[file] = Counter()
                for topic in topics:
                    self._counts[file][topic.name] += topic.messages
                return topics
            stream.seek(0)
            return _counted(file, stream)


def _counted(file: Path, stream: IO[bytes]) -> list[Topic]:
    """The topics of a file without an index: counts its messages, up to where it can be read."""
    from mcap.records import Channel, Schema
    from mcap.records import Message as McapMessage
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    counts: dict[int, int] = {}
    try:
        for record in StreamReader(stream).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
    except Exception as error:
        if not channels:
            raise ScanError(f"{file}: no readable MCAP ({reason(error)}); copy or record it again") from None
    return [Topic(one.topic, _type(schemas, one), counts.get(one.id, 0)) for one in channels.values()]


def _type(schemas: dict[int, Any], channel: Any) -> str:
    schema = schemas.get(channel.schema_id)
    return str(schema.name) if schema is not None else "unknown"
