"""Scans of a recording's topic with time stamps, in order; unreadable ones are counted."""

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

from asca_pillars.base.errors import ScanError
from asca_pillars.base.installation import require
from asca_pillars.geometry.frame_change import transform_points
from asca_pillars.scans.ground_height import NamedPoints
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.recordings.packet_files import OusterPackets
from asca_pillars.scans.recordings.point_cloud2 import PointCloud, read_point_cloud
from asca_pillars.scans.recordings.recording import Message, Recording, Topic, kind_of_scans
from asca_pillars.scans.scan_input import FolderScale, common_reflectance_scale, has_finite_point, scale_notes
from asca_pillars.scans.scan_reader import ReflectanceScale, Scan, finite_scan
from asca_pillars.scans.scan_settings import SEARCHED_SCANS, ScanSettings
from asca_pillars.scans.transforms import Transforms, read_static_transforms

SEARCHED_MESSAGES = 300
"""Messages searched for scans with points: half a minute at 10 Hz, in which a sensor starts."""
MAX_UNREADABLE = 10_000
"""Consecutive unreadable messages after which reading stops: a quarter of an hour at 10 Hz."""


class RecordedScan(NamedTuple):
    """Message of the topic: its number, its time, and its scan or the reason why there is none.

    `fields` are the names of a point's fields, where the message lists them.
    """

    number: int
    time_ns: int
    frame_id: str
    scan: Scan | None
    error_text: str | None = None
    fields: tuple[str, ...] = ()


class RecordedScans:
    """Scans of one topic.

    Args:
        recording: to read from.
        topic: topic of point clouds, or of an Ouster's packets.
        reflectance_scale: the stored value that is a reflectance of 1; auto: decided once, by the first scans with
            points.
        frame: target frame of the points, by the recording's static transforms; None: their own.

    Attributes:
        scale: the decided scale.

    Raises:
        ScanError: there are no static transforms, or they do not name `frame`.
    """

    def __init__(
        self, recording: Recording, topic: Topic, reflectance_scale: ReflectanceScale, frame: str | None = None
    ) -> None:
        self.recording, self.topic = recording, topic
        self._frame = frame
        self._transforms = Transforms() if frame is None else read_static_transforms(recording, frame)
        self._kind = kind_of_scans(topic.type) or "PointCloud2"  # of an unknown type
        self._packets: OusterPackets | None = None
        if self._kind == "Velodyne":
            require("packets")
        if self._kind == "Ouster":
            self._packets, self._kind = OusterPackets(recording, topic), "Packets"
            self.topic = topic._replace(messages=self._packets.revolutions)
        if reflectance_scale == "auto":
            self.scale = common_reflectance_scale([cloud.points for cloud in self._first(16)])
        else:
            self.scale = FolderScale(reflectance_scale, None)

    def first(self, count: int) -> Iterator[Scan]:
        """Return an iterator over at most `count` first scans with points, among SEARCHED_MESSAGES messages."""
        return (finite_scan(cloud.points, self.scale.scale) for cloud in self._first(count))

    def samples(self) -> Iterator[NamedPoints]:
        """Yield up to SEARCHED_SCANS of the first scans with points, for estimating the sensor's height."""
        for number, scan in enumerate(self.first(SEARCHED_SCANS), start=1):
            yield NamedPoints(f"scan {number} with points of {self.topic.name}", scan.points)

    def mounting(self, reading: ScanSettings) -> tuple[Mounting, list[str]]:
        """Return the sensor's mounting, with a height of "auto" from the first scans, and messages for the user.

        Raises:
            ConfigError, ScanError: as `ScanSettings.mounting`.
        """
        notes = [*self.recording.notes, f"{self.topic.name}: {self.topic.messages} scans", *scale_notes(self.scale)]
        mounting, estimate = reading.mounting(self.samples())
        if estimate is not None:
            notes.append(f"sensor height: {estimate}")
        return mounting, notes

    def read(self, start: int = 0) -> Iterator[RecordedScan]:
        """Yield all scans from message `start` on; see `recording.damage` if damage ends the recording early."""
        unreadable = 0
        for number, message in enumerate(self._messages()):
            if number < start:
                continue
            if unreadable == MAX_UNREADABLE:
                self.recording.damage = (
                    f"{self._place(number)}: {unreadable} before it cannot be read, none is tried after"
                )
                return
            try:
                cloud = self._cloud(number, message)
                unreadable = 0
            except ScanError as error:
                unreadable += 1
                yield RecordedScan(number, message.recorded_ns or 0, "", None, str(error))
                continue
            scan = finite_scan(cloud.points, self.scale.scale)
            yield RecordedScan(number, cloud.time_ns, cloud.frame_id, scan, fields=cloud.fields)

    def _first(self, count: int) -> Iterator[PointCloud]:
        return islice(self._clouds_with_points(), count)

    def _clouds_with_points(self) -> Iterator[PointCloud]:
        for number, message in enumerate(islice(self._messages(), SEARCHED_MESSAGES)):
            try:
                cloud = self._cloud(number, message)
            except ScanError:
                continue  # reported when it is read
            if has_finite_point(cloud.points):
                yield cloud

    def _messages(self) -> Iterator[Message]:
        return self.recording.messages(self.topic.name) if self._packets is None else self._packets.messages()

    def _cloud(self, number: int, message: Message) -> PointCloud:
        cloud = read_point_cloud(message, self._place(number), self._kind)
        if self._packets is not None:
            cloud = cloud._replace(frame_id=self._packets.frame_id)
        if self._frame is None:
            return cloud
        matrix = self._transforms.between(cloud.frame_id, self._frame)
        if matrix is None:
            where = (
                f"{self._place(number)}: no static transform leads from {cloud.frame_id[:80] or 'a frame without name'}"
            )
            raise ScanError(f"{where} to {self._frame}; there are {', '.join(self._transforms.frames)[:200]}")
        points = cloud.points._replace(xyz=transform_points(cloud.points.xyz, matrix[:3, :3], matrix[:3, 3]))
        return cloud._replace(points=points, frame_id=self._frame)

    def _place(self, number: int) -> str:
        return f"{self.recording.path}, {self.topic.name}, message {number}"
