"""Base class of recordings: topics, their message types, and the messages of one of them."""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from asca_pillars.base.errors import ScanError

_REPLAY = "play the recording through the sensor's driver and record the PointCloud2 that it publishes"
_CONVERSIONS = (
    # None: no scans of a 3D LiDAR
    (r"sensor_msgs/(msg/)?(Multi\w*)?LaserScan|radar_\w*/.*", None),
    (r"foxglove_msgs/(msg/)?PointCloud", "record the PointCloud2 that it was made of"),
    (r".*(Scans?|Packets?|PacketMsg|UdpFrame|PointCloud\d?|CustomMsg)", _REPLAY),
)

ScanKind = Literal["PointCloud2", "PointCloud", "Livox", "Foxglove", "Packets", "Velodyne", "Ouster"]
_READ: tuple[tuple[str, ScanKind], ...] = (
    (r"sensor_msgs/(msg/)?PointCloud2", "PointCloud2"),
    (r"sensor_msgs/(msg/)?PointCloud", "PointCloud"),
    (r"livox_\w+/(msg/)?CustomMsg", "Livox"),
    (r"foxglove\.PointCloud", "Foxglove"),
    (r"(velodyne|ouster)/Packets", "Packets"),
    (r"velodyne_msgs/(msg/)?VelodyneScan", "Velodyne"),
    (r"ouster_\w+/(msg/)?PacketMsg", "Ouster"),
)


def kind_of_scans(type_name: str) -> ScanKind | None:
    """Return the kind of scans in messages of a type; None if they are not read as scans."""
    return next((kind for pattern, kind in _READ if re.fullmatch(pattern, type_name)), None)


def conversion_of(type_name: str) -> str | None:
    """Return advice on converting scans of a type to PointCloud2; None if it is not known to hold scans."""
    return next((remedy for pattern, remedy in _CONVERSIONS if re.fullmatch(pattern, type_name)), None)


Encoding = Literal["cdr", "ros1", "json", "protobuf", "points"]
"""Encoding of a message's fields: ROS 2's CDR, ROS 1's own, one of Foxglove's types, or points alone."""


UNKNOWN_TYPE = "unknown"
"""Type of a topic without a schema."""
SEVERAL_TYPES = "several types"
LAST_NS = 2**63 - 1
"""Latest usable time: in 2262."""


class Topic(NamedTuple):
    """Topic with the type of its messages in ROS notation, and their number."""

    name: str
    type: str
    messages: int

    @property
    def is_point_cloud(self) -> bool:
        """True if it holds scans of a type that is read."""
        return kind_of_scans(self.type) is not None


class Message(NamedTuple):
    """Message as stored, and when it was recorded, nanoseconds; None where no usable time is stored."""

    recorded_ns: int | None
    data: bytes
    encoding: Encoding


class Recording(ABC):
    """A recording, read from the start each time.

    Attributes:
        path: the file or folder.
        topics: all topics, by name.
        damage: what the last call of `messages` lacked, or before the first call the list of topics, and where; None:
            nothing.
        notes: sentences for the user about how it is read.
    """

    path: Path
    topics: Sequence[Topic]
    damage: str | None = None
    notes: tuple[str, ...] = ()

    @abstractmethod
    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the messages of a topic by time; a damaged recording ends early (`damage`)."""

    def point_cloud_topic(self, topic_name: str | None = None) -> Topic:
        """Return the topic of that name, or the only one with scans.

        Raises:
            ScanError: there is none, it holds something else, or there are several; names all available ones.
        """
        clouds = [topic for topic in self.topics if topic.is_point_cloud]
        if topic_name is not None:
            named = [topic for topic in self.topics if topic.name == topic_name]
            if not named:
                lost = f"; {self.damage}" if self.damage else ""
                raise ScanError(f"{self.path}: no topic {topic_name[:80]}; there are {topics_text(self.topics)}{lost}")
            if not named[0].is_point_cloud and named[0].type != UNKNOWN_TYPE:
                held = f"{self.path}: {topic_name} holds {named[0].type}"
                if conversion := conversion_of(named[0].type):
                    raise ScanError(f"{held}, a type of scans that is not read: {conversion}")
                remedy = f"choose one of {topics_text(clouds)}" if clouds else self._remedy(self.topics)
                raise ScanError(f"{held}, not scans (sensor_msgs/msg/PointCloud2); {remedy}")
            return named[0]
        filled = [topic for topic in clouds if topic.messages] or clouds
        if not filled:
            none = f"no topic of type sensor_msgs/msg/PointCloud2; there are {topics_text(self.topics)}"
            if self.damage:
                raise ScanError(f"{self.damage}; in what can be read {none}: copy or record it again")
            raise ScanError(f"{self.path}: {none}: {self._remedy(self.topics)}")
        if len(filled) > 1:
            raise ScanError(f"{self.path}: several topics hold scans, give --topic: {topics_text(filled)}")
        return filled[0]

    def _remedy(self, topics: Sequence[Topic]) -> str:
        """Return the advice if none of these topics can be read."""
        for topic in topics:
            if conversion := conversion_of(topic.type):
                return f"the scans are recorded as {topic.type}, which is not read: {conversion}"
        if unknown := [topic for topic in topics if topic.type == UNKNOWN_TYPE]:
            return f"if one of unknown type holds PointCloud2, name it (--topic {unknown[0].name})"
        return "record the scans, too"


def topics_text(topics: Sequence[Topic]) -> str:
    """Return the topics with their types and counts, in one line."""
    return ", ".join(f"{topic.name} ({topic.type}, {topic.messages})" for topic in topics) or "none"


def merge_topics(topics: Iterable[Topic]) -> list[Topic]:
    """Return the topics by name, with those of one name merged and their messages added."""
    by_name: dict[str, list[Topic]] = {}
    for topic in topics:
        by_name.setdefault(topic.name, []).append(topic)
    return [
        Topic(name, _common_type(same), sum(topic.messages for topic in same)) for name, same in sorted(by_name.items())
    ]


def _common_type(topics: Sequence[Topic]) -> str:
    types = {topic.type for topic in topics} - {UNKNOWN_TYPE}
    return SEVERAL_TYPES if len(types) > 1 else next(iter(types), UNKNOWN_TYPE)


def reason(error: Exception) -> str:
    """Return a library's error as one short line."""
    name = "" if type(error) is ValueError else type(error).__name__
    return " ".join(f"{name} {error}".split())[:100]
