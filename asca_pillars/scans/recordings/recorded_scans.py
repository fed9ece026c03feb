"""The scans of a recording's topic, one after the other, with time stamps; those that cannot be read are counted."""

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.point_cloud2 import PointCloud, read_point_cloud
from asca_pillars.scans.recordings.recording import Recording, Topic
from asca_pillars.scans.recordings.scan_types import kind_of_scans
from asca_pillars.scans.scan_reader import ReflectanceScale, Scan, finite_scan
from asca_pillars.scans.stored_scans import FolderScale, common_reflectance_scale, has_finite_point

SEARCHED_MESSAGES = 300
"""How far scans with points are looked for: half a minute at 10 Hz, in which a sensor starts."""
MAX_UNREADABLE = 10_000
"""Messages in a row that cannot be read, after which no more are tried: a quarter of an hour at 10 Hz."""


class RecordedScan(NamedTuple):
    """One message of the topic: its number, its time, and its scan or why there is none."""

    number: int
    time_ns: int
    frame_id: str
    scan: Scan | None
    trouble: str | None = None


class RecordedScans:
    """The scans of one topic.

    Args:
        recording: to read from.
        topic: of point clouds.
        reflectance_scale: the stored value that is a reflectance of 1; auto: by the first scans with points, once.

    Attributes:
        scale: what was decided.
    """

    def __init__(self, recording: Recording, topic: Topic, reflectance_scale: ReflectanceScale) -> None:
        self.recording, self.topic = recording, topic
        self._kind = kind_of_scans(topic.type) or "PointCloud2"  # of an unknown type
        if reflectance_scale == "auto":
            self.scale = common_reflectance_scale([cloud.points for cloud in self._first(16)])
        else:
            self.scale = FolderScale(reflectance_scale, None)

    def first(self, count: int) -> Iterator[Scan]:
        """The first scans with points, at most `count`; none is looked for beyond SEARCHED_MESSAGES."""
        return (finite_scan(cloud.points, self.scale.scale) for cloud in self._first(count))

    def read(self, start: int = 0) -> Iterator[RecordedScan]:
        """All scans from message `start` on; what damage ends the recording early, `recording.damage` tells."""
        unreadable = 0
        for number, message in enumerate(self.recording.messages(self.topic.name)):
            if number < start:
                continue
            if unreadable == MAX_UNREADABLE:
                self.recording.damage = (
                    f"{self._place(number)}: {unreadable} before it cannot be read, none is tried after"
                )
                return
            try:
                cloud = read_point_cloud(message, self._place(number), self._kind)
                unreadable = 0
            except ScanError as error:
                unreadable += 1
                yield RecordedScan(number, message.recorded_ns or 0, "", None, str(error))
                continue
            yield RecordedScan(number, cloud.time_ns, cloud.frame_id, finite_scan(cloud.points, self.scale.scale))

    def _first(self, count: int) -> Iterator[PointCloud]:
        return islice(self._clouds_with_points(), count)

    def _clouds_with_points(self) -> Iterator[PointCloud]:
        for number, message in enumerate(islice(self.recording.messages(self.topic.name), SEARCHED_MESSAGES)):
            try:
                cloud = read_point_cloud(message, self._place(number), self._kind)
            except ScanError:
                continue  # named when its turn comes
            if has_finite_point(cloud.points):
                yield cloud

    def _place(self, number: int) -> str:
        return f"{self.recording.path}, {self.topic.name}, message {number}"
