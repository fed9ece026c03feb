"""Camera images of a recording: the one of a topic that is nearest in time to a scan."""

import re
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.messages import decode_message, time_of
from asca_pillars.scans.recordings.point_clouds import foxglove_image
from asca_pillars.scans.recordings.recording import Message, Recording, Topic, reason, topics_text

ImageKind = Literal["Image", "CompressedImage", "Foxglove"]
IMAGE_REACH_NS = 500_000_000
"""Largest difference in time between an image and its scan, nanoseconds."""

_READ: tuple[tuple[str, ImageKind], ...] = (
    (r"sensor_msgs/(msg/)?Image", "Image"),
    (r"sensor_msgs/(msg/)?CompressedImage", "CompressedImage"),
    (r"foxglove\.CompressedImage", "Foxglove"),
)
_FILES = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG\r\n\x1a\n": "image/png"}
_PIXELS = {"mono8": "L", "rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBA", "bgra8": "BGRA"}


class CameraImage(NamedTuple):
    """Image with its time stamp, nanoseconds."""

    time_ns: int
    content: bytes | NDArray[np.uint8]
    """Encoded file, or pixels (height, width, channels)."""
    kind: str
    """`image/jpeg` or `image/png`; for pixels the order of the channels: L, RGB, BGR, RGBA or BGRA."""


def image_topics(recording: Recording) -> list[Topic]:
    """Return the topics with images of supported types, by name."""
    return [topic for topic in recording.topics if topic.messages and _kind_of(topic) is not None]


def _kind_of(topic: Topic) -> ImageKind | None:
    return next((kind for pattern, kind in _READ if re.fullmatch(pattern, topic.type)), None)


class NearestImages:
    """Images of one topic, read once from start to end; at most two of them are held.

    Args:
        recording: to read from.
        topic_name: the topic's name; None: the first one with images.

    Attributes:
        topic: the topic read; None: the recording has no images.
        others: all topics with images, where the first of several was chosen.
        images_given: number of images returned.
        unreadable: number of images that could not be read.
        error_text: error of the first of these.

    Raises:
        ScanError: there are no images on a topic of that name.
    """

    def __init__(self, recording: Recording, topic_name: str | None = None) -> None:
        topics = image_topics(recording)
        named = topics if topic_name is None else [topic for topic in topics if topic.name == topic_name]
        if topic_name is not None and not named:
            raise ScanError(
                f"{recording.path}: no images on a topic {topic_name[:80]}; there are {topics_text(topics)}"
            )
        self.topic = named[0] if named else None
        self.others = topics if topic_name is None and len(topics) > 1 else []
        self.images_given = self.unreadable = 0
        self.error_text: str | None = None
        self._recording = recording
        self._coming: Iterator[CameraImage] | None = None
        self._before: CameraImage | None = None
        self._after: CameraImage | None = None

    def at(self, time_ns: int) -> CameraImage | None:
        """Return the image nearest to a time, nanoseconds; None if there is none within IMAGE_REACH_NS.

        Times must ascend: images before the last returned one are not read again.
        """
        if self._coming is None:
            self._coming = self._read()
            self._after = next(self._coming, None)
        while self._after is not None and (
            self._before is None or abs(self._after.time_ns - time_ns) <= abs(self._before.time_ns - time_ns)
        ):
            self._before, self._after = self._after, next(self._coming, None)
        if self._before is None or abs(self._before.time_ns - time_ns) > IMAGE_REACH_NS:
            return None
        self.images_given += 1
        return self._before

    def remarks(self) -> list[str]:
        """Return sentences about what was left out; call it at the end."""
        if self.topic is None:
            return []
        notes = []
        if self.unreadable:
            notes.append(f"{self.topic.name}: {self.unreadable} images were left out: {self.error_text}")
        if not self.images_given:
            notes.append(f"{self.topic.name}: no image is within {IMAGE_REACH_NS / 1e9:g} s of a scan")
        return notes

    def _read(self) -> Iterator[CameraImage]:
        if self.topic is None:
            return
        kind = _kind_of(self.topic)
        assert kind is not None, "it is one of image_topics"
        messages = self._recording.messages(self.topic.name)
        try:
            for message in messages:
                try:
                    image = read_image(message, kind)
                except Exception as error:  # the library does not catch struct's and NumPy's errors
                    self.unreadable += 1
                    self.error_text = self.error_text or reason(error)
                else:
                    yield image
        except ScanError as error:  # of its encoding
            self.unreadable += 1
            self.error_text = self.error_text or str(error)


def read_image(message: Message, kind: ImageKind) -> CameraImage:
    """Decode the image of a stored message.

    Raises:
        Exception: it is damaged, or neither JPEG, PNG nor pixels of 8 bits.
    """
    image = foxglove_image(message) if kind == "Foxglove" else decode_message(message, f"sensor_msgs/msg/{kind}")
    time_ns = time_of(image.header, message)
    if time_ns is None:
        raise ValueError("no usable time stamp")
    if kind == "Image":
        return CameraImage(time_ns, *_pixels(image))
    content = bytes(image.data)
    media_type = next((name for magic, name in _FILES.items() if content.startswith(magic)), None)
    if media_type is None:
        raise ValueError(f"it is neither JPEG nor PNG but {image.format[:40]!r}")
    return CameraImage(time_ns, content, media_type)


def _pixels(image: Any) -> tuple[NDArray[np.uint8], str]:
    """Return the pixels of a sensor_msgs/Image without row padding, and the order of the channels."""
    if image.encoding not in _PIXELS:
        raise ValueError(f"its pixels are {image.encoding[:40]!r}; {', '.join(_PIXELS)} are read")
    order = _PIXELS[image.encoding]
    height, width, step = int(image.height), int(image.width), int(image.step)
    row = width * len(order)
    data = np.asarray(image.data, np.uint8)
    if not height or not width or step < row or len(data) < (height - 1) * step + row:
        raise ValueError(f"{len(data)} bytes where {height} rows of {step} hold {width} pixels of {len(order)}")
    view = np.ndarray((height, width, len(order)), np.uint8, data, strides=(step, len(order), 1))
    return np.ascontiguousarray(view), order
