"""Opening of recordings, and the scans of a topic with time stamps, in order; unreadable ones are counted."""

import shutil
import weakref
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from asca_pillars.base.errors import ScanError
from asca_pillars.base.files import require_content
from asca_pillars.base.installation import require
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.geometry.frame_change import transform_points
from asca_pillars.scans.find_scans import is_scan, natural_order, visible_files
from asca_pillars.scans.ground_height import NamedPoints
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.recordings.mcap_files import McapRecording
from asca_pillars.scans.recordings.messages import UNPACKERS, decompress_file
from asca_pillars.scans.recordings.packet_files import OusterPackets, PacketCapture
from asca_pillars.scans.recordings.point_clouds import PointCloud, read_point_cloud
from asca_pillars.scans.recordings.recording import Message, Recording, Topic, kind_of_scans
from asca_pillars.scans.recordings.ros_bags import (
    METADATA_FILE,
    BagMetadata,
    RosBag,
    SplitRecording,
    SqliteRecording,
    read_metadata,
)
from asca_pillars.scans.scan_reader import ReflectanceScale, Scan, finite_scan
from asca_pillars.scans.scan_settings import (
    SEARCHED_SCANS,
    FolderScale,
    ScanSettings,
    common_reflectance_scale,
    has_finite_point,
    scale_notes,
)
from asca_pillars.scans.transforms import Transforms, read_static_transforms

_READERS: dict[str, Callable[[Path, Path | None], Recording]] = {
    ".mcap": McapRecording,
    ".db3": SqliteRecording,
    ".bag": RosBag,
    ".pcap": PacketCapture,
}
RECORDING_SUFFIXES = tuple(_READERS)
_ROSBAG2_SUFFIXES = (".mcap", ".db3")


def is_recording(path: Path) -> bool:
    """Return whether a path is a recording: by a file's name, or a folder's metadata.yaml or rosbag2 files."""
    if path.is_dir():
        return read_metadata(path) is not None or bool(_files(path))
    return _recorded_suffix(path) in RECORDING_SUFFIXES


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording, sorted; a folder may contain others, such as results."""
    if not path.is_dir():
        return [path]
    names = METADATA_FILE, *(f"*{suffix}*" for suffix in _ROSBAG2_SUFFIXES)  # compressed ones have two suffixes
    return sorted(file for name in names for file in visible_files(path, name) if file.is_file())


def open_recording(path: Path, reporter: Reporter = SILENT) -> Recording:
    """Open a recording; a large compressed file is unpacked, of which the reporter is told the progress.

    Raises:
        ScanError: it does not exist, cannot be read, or lies among scans.
    """
    if not path.exists():
        raise ScanError(f"{path}: no such file or folder; check the path")
    if not path.is_dir():
        return _open_file(path, reporter)
    files, metadata = _files(path), read_metadata(path)
    if metadata is not None:
        return _open_rosbag2(path, files, metadata, reporter)
    if scan := next((file for file in sorted(path.iterdir()) if is_scan(Path(file.name))), None):
        raise ScanError(f"{path}: holds {files[0].name} and scans such as {scan.name}; give one or the other")
    if len(files) > 1:
        raise ScanError(
            f"{path}: {len(files)} recordings, and no {METADATA_FILE} that would make one of them; give one of them"
        )
    return _open_file(files[0], reporter)


def _open_rosbag2(folder: Path, files: list[Path], metadata: BagMetadata, reporter: Reporter) -> Recording:
    """Open the listed files, or all if none of them is there; errors in some do not lose the others."""
    by_name = {_unpacked_name(path.name): path for path in files}
    listed = {name: by_name.get(_unpacked_name(name)) for name in metadata.files}
    if packed := [name for name, file in listed.items() if file is None and (folder / name).is_file()]:
        raise ScanError(f"{folder}: {packed[0]} is packed, and {', '.join(UNPACKERS)} are read; unpack it there")
    troubles = [f"{folder}: {name} is missing" for name, file in listed.items() if file is None]
    if len(troubles) == len(listed):
        troubles, listed = [], {file.name: file for file in files}
    recordings = []
    for file in filter(None, listed.values()):
        try:
            recordings.append(_open_file(file, reporter))
        except ScanError as error:
            troubles.append(str(error))
    if not recordings:
        missing = f"{folder}: none of its recording's files is there ({', '.join(metadata.files)[:80]})"
        raise ScanError(troubles[0] if troubles else f"{missing}; copy the whole folder")
    return SplitRecording(folder, recordings, metadata.counts, troubles[0] if troubles else None)


def _open_file(path: Path, reporter: Reporter) -> Recording:
    require_content(path, ScanError)
    try:
        if path.stat().st_size == 0:
            raise ScanError(f"{path}: the file is empty (0 bytes); copy or record it again")
        reader = _READERS[_recorded_suffix(path)]
        if path.suffix.lower() not in UNPACKERS:
            return reader(path, None)
        copy = decompress_file(path, reporter)
        try:
            recording = reader(path, copy)
        except BaseException:
            shutil.rmtree(copy.parent, ignore_errors=True)
            raise
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None
    recording.notes = (f"{path}: unpacked to {copy.parent} for this run ({copy.stat().st_size / 2**20:.1f} MiB)",)
    weakref.finalize(recording, shutil.rmtree, copy.parent, ignore_errors=True)
    return recording


def _recorded_suffix(path: Path) -> str:
    """Return the suffix of a file, without that of its compression."""
    return Path(_unpacked_name(path.name)).suffix.lower()


def _unpacked_name(name: str) -> str:
    """Return the name of a file without the suffix of its compression."""
    return Path(name).stem if Path(name).suffix.lower() in UNPACKERS else name


def _files(folder: Path) -> list[Path]:
    """Return the rosbag2 files of a folder, in natural order; a decompressed copy replaces its compressed file."""
    files = [file for suffix in _ROSBAG2_SUFFIXES for file in visible_files(folder, f"*{suffix}*")]
    files = [file for file in files if _recorded_suffix(file) in _ROSBAG2_SUFFIXES and not file.is_dir()]
    plain = {file.name for file in files if file.name == _unpacked_name(file.name)}
    chosen = {file for file in files if file.name in plain or _unpacked_name(file.name) not in plain}
    return sorted(chosen, key=lambda file: natural_order(Path(file.name)))


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
