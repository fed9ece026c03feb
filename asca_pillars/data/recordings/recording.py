"""What all kinds of recordings have in common: topics, and the messages of one of them."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from asca_pillars.errors import ScanError

Encoding = Literal["cdr", "ros1"]
"""How a message's fields are written: ROS 2's CDR or ROS 1's own."""


class Topic(NamedTuple):
    """A topic, the type of its messages as ROS writes it, and how many there are."""

    name: str
    type: str
    messages: int

    @property
    def is_point_cloud(self) -> bool:
        """Whether it holds scans: `sensor_msgs/msg/PointCloud2`, or as ROS 1 writes it."""
        return self.type in ("sensor_msgs/msg/PointCloud2", "sensor_msgs/PointCloud2")


class Message(NamedTuple):
    """A message as it is stored, and when it was recorded, nanoseconds."""

    recorded_ns: int
    data: bytes
    encoding: Encoding


class Recording(ABC):
    """One recording. It is read from the start each time.

    Attributes:
        path: the file or folder.
        topics: all of them, by name.
        damage: what the last call of `messages` lacked, and where; None: nothing.
    """

    path: Path
    topics: Sequence[Topic]
    damage: str | None = None

    @abstractmethod
    def messages(self, topic: str) -> Iterator[Message]:
        """The messages of a topic in the order of their times; a damaged recording ends early (`damage`)."""

    def point_cloud_topic(self, wanted: str | None = None) -> Topic:
        """The topic of that name, or the only one that holds scans.

        Raises:
            ScanError: there is none, it holds something else, or there are several; names all that are there.
        """
        clouds = [topic for topic in self.topics if topic.is_point_cloud]
        if wanted is not None:
            named = [topic for topic in self.topics if topic.name == wanted]
            if not named:
                raise ScanError(f"{self.path}: no topic {wanted[:80]}; there are {listed(self.topics)}")
            if not named[0].is_point_cloud:
                raise ScanError(
                    f"{self.path}: {wanted} holds {named[0].type}, not scans (sensor_msgs/msg/PointCloud2); "
                    f"choose one of {listed(clouds)}"
                )
            return named[0]
        filled = [topic for topic in clouds if topic.messages] or clouds
        if not filled:
            raise ScanError(
                f"{self.path}: no topic of type sensor_msgs/msg/PointCloud2; there are {listed(self.topics)}: "
                "record the scans, too"
            )
        if len(filled) > 1:
            raise ScanError(f"{self.path}: several topics hold scans, give --topic: {listed(filled)}")
        return filled[0]


def listed(topics: Sequence[Topic]) -> str:
    """The topics with their types and counts, in one line."""
    return ", ".join(f"{topic.name} ({topic.type}, {topic.messages})" for topic in topics) or "none"
