"""rosbag2 in SQLite and ROS 1 bags, by the library rosbags."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from asca_pillars.data.recordings.messages import reason
from asca_pillars.data.recordings.recording import Message, Recording, Topic
from asca_pillars.errors import ScanError


class RosBag(Recording):
    """A `.db3` file, a folder with metadata.yaml and such files, or a ROS 1 `.bag`.

    Raises:
        ScanError: no such recording, or it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _opened(path) as reader:
            topics = [
                Topic(name, info.msgtype or "several types", info.msgcount) for name, info in reader.topics.items()
            ]
        self.topics = sorted(topics)

    def messages(self, topic: str) -> Iterator[Message]:
        """The messages of a topic."""
        self.damage, count = None, 0
        with _opened(self.path) as reader:
            try:
                chosen = [one for one in reader.connections if one.topic == topic]
                for _, time_ns, data in reader.messages(connections=chosen):
                    count += 1
                    yield Message(time_ns, bytes(data), "ros1" if _is_ros1(self.path) else "cdr")
                if count < (declared := sum(one.messages for one in self.topics if one.name == topic)):
                    self.damage = f"{self.path}: {count} of the {declared} messages of {topic} can be read"
            except (ScanError, GeneratorExit):
                raise
            except Exception as error:  # of SQLite, the decompressors, the library
                self.damage = f"{self.path}: ends early, after {count} messages of {topic} ({reason(error)})"


def _is_ros1(path: Path) -> bool:
    return path.suffix.lower() == ".bag"


def _opened(path: Path) -> Any:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    try:
        reader = (Reader1 if _is_ros1(path) else Reader2)(path)
        reader.open()
    except Exception as error:
        what, remedy = "rosbag2", "copy it again, or mend it (sqlite3 broken.db3 .recover | sqlite3 mended.db3)"
        if path.suffix != path.suffix.lower():  # the library goes by the suffix as it stands
            remedy = f"rename it to {path.stem}{path.suffix.lower()}"
        if _is_ros1(path):
            what, remedy = "ROS 1 bag", "copy it again, or mend its index (rosbag reindex)"
        raise ScanError(f"{path}: no readable {what} ({reason(error)}); {remedy}") from None
    return _Closing(reader)


class _Closing:
    """`with` for a reader that is open already."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> Any:
        return self._reader

    def __exit__(self, *_: object) -> None:
        self._reader.close()
