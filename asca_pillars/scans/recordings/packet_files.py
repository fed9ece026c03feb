"""Packet captures of a sensor (`.pcap`), split into scans of one revolution by the vendors' libraries.

Ouster: `ouster-sdk`, with the sensor's metadata in a `.json` in the same folder, whose name is the capture's or its
beginning; Velodyne: `velodyne-decoder`.
"""

import math
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.base.installation import require
from asca_pillars.scans.find_scans import visible_files
from asca_pillars.scans.recordings.messages import decode_message
from asca_pillars.scans.recordings.recording import Message, Recording, Topic, reason
from asca_pillars.scans.records import StoredPoints

VELODYNE, OUSTER = "velodyne/Packets", "ouster/Packets"
PACKET_MSG = "ouster_sensor_msgs/msg/PacketMsg"
_TOPIC = "/packets"
_VELODYNE_BYTES = 1206  # of a packet of points
_LOOKED_AT = 1000
"""Packets searched for those of a Velodyne: others, such as positions, may lie between them."""


class PacketCapture(Recording):
    """`.pcap` file of one sensor. Its messages hold (N, 4) float32 x, y, z in metres and reflectance 0..1.

    Their time stamps are those of the first packet of each revolution at the capturing computer.

    Args:
        path: path of the capture in error messages.
        file: file to read; None: `path`.

    Raises:
        ScanError: not a capture of a supported sensor, or its metadata are missing.
    """

    def __init__(self, path: Path, file: Path | None = None) -> None:
        require("packets")
        self.path, self._file = path, file or path
        is_velodyne = self._has_velodyne_packets()
        self._metadata = None if is_velodyne else _find_metadata(path)
        self._type = VELODYNE if is_velodyne else OUSTER
        self.topics = [Topic(_TOPIC, self._type, sum(1 for _ in self.messages(_TOPIC)))]

    def messages(self, topic: str) -> Iterator[Message]:
        """Yield the revolutions, up to where the capture is cut off."""
        self.damage, count = None, 0
        revolutions = self._velodyne() if self._type == VELODYNE else self._ouster()
        try:
            for time_ns, points in revolutions:
                yield _packed(time_ns, points)
                count += 1
        except (ScanError, GeneratorExit):
            raise
        except Exception as error:  # the libraries have errors of their own
            self.damage = f"{self.path}: ends early, after {count} scans ({reason(error)})"

    def _payloads(self) -> Iterator[tuple[float, bytes]]:
        """Yield time and content of each UDP packet."""
        import dpkt

        with self._file.open("rb") as stream:
            try:
                reader: Any = dpkt.pcap.UniversalReader(stream)
            except (ValueError, dpkt.UnpackError) as error:
                raise ScanError(f"{self.path}: not a readable pcap ({reason(error)}); capture it again") from None
            link = dpkt.sll.SLL if reader.datalink() == dpkt.pcap.DLT_LINUX_SLL else dpkt.ethernet.Ethernet
            for time_s, content in reader:
                try:
                    packet = link(content).data.data
                except (dpkt.UnpackError, AttributeError):
                    continue
                if isinstance(packet, dpkt.udp.UDP):
                    yield float(time_s), bytes(packet.data)

    def _has_velodyne_packets(self) -> bool:
        try:
            return any(len(payload) == _VELODYNE_BYTES for _, payload in islice(self._payloads(), _LOOKED_AT))
        except ScanError:
            raise
        except Exception as error:
            raise ScanError(f"{self.path}: not a readable pcap ({reason(error)}); capture it again") from None

    def _velodyne(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        import velodyne_decoder

        config = velodyne_decoder.Config()
        config.timestamp_first_packet = True
        decoder = velodyne_decoder.StreamDecoder(config)
        try:
            for time_s, payload in self._payloads():
                if len(payload) == _VELODYNE_BYTES and (scan := decoder.decode(time_s, payload)) is not None:
                    yield _of_velodyne(scan)
        finally:
            last = decoder.finish()  # also what precedes a damaged packet
        if last is not None:
            yield _of_velodyne(last)

    def _ouster(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        from ouster.sdk import core, open_source

        source = open_source(str(self._file), meta=[str(self._metadata)])
        table = core.XYZLut(source.sensor_info[0], use_extrinsics=False)
        for scans in source:
            for scan in scans:
                if scan is not None:
                    yield _of_ouster(scan, table)


class OusterPackets:
    """Revolutions of a recording's topic of PacketMsg, decoded with the metadata topic next to it.

    Args:
        recording: to read from.
        topic: topic of the packets, such as /ouster/lidar_packets.

    Attributes:
        revolutions: their approximate number.

    Raises:
        ScanError: the metadata are missing, or cannot be read.
    """

    frame_id = "os_sensor"
    """Frame of the points in the sensor's driver; the packets name none."""

    def __init__(self, recording: Recording, topic: Topic) -> None:
        require("packets")
        from ouster.sdk import core

        self._recording, self._topic = recording, topic.name
        name = f"{topic.name.rpartition('/')[0]}/metadata"
        place = f"{recording.path}, {name}"
        message = (
            next(iter(recording.messages(name)), None) if name in {listed.name for listed in recording.topics} else None
        )
        if message is None:
            raise ScanError(f"{place}: no metadata of the Ouster, which {topic.name} needs; record that topic, too")
        try:
            self._info: Any = core.SensorInfo(decode_message(message, "std_msgs/msg/String").data)
            self._format: Any = core.PacketFormat(self._info)
        except Exception as error:  # the libraries have errors of their own
            raise ScanError(f"{place}: unreadable metadata of the Ouster ({reason(error)}); record it again") from None
        packets = self._info.format.columns_per_frame / self._info.format.columns_per_packet
        self.revolutions = math.ceil(topic.messages / packets)

    def messages(self) -> Iterator[Message]:
        """Yield revolutions as `PacketCapture.messages`; unreadable packets are left out, like lost ones."""
        from ouster.sdk import core

        table = core.XYZLut(self._info, use_extrinsics=False)
        batcher, frame, packets = core.FrameBatcher(self._info), core.LidarFrame(self._info), 0
        for message in self._recording.messages(self._topic):
            try:
                payload = np.asarray(decode_message(message, PACKET_MSG).buf, np.uint8)
            except Exception:  # the library does not catch struct's and NumPy's errors
                continue
            if len(payload) < self._format.lidar_packet_size:
                continue
            packet = core.LidarPacket(self._format)
            packet.buf[:] = payload[: len(packet.buf)]  # drivers append a byte
            packet.host_timestamp = message.recorded_ns or 0
            is_whole, packets = batcher.batch(packet, frame), packets + 1
            if is_whole:
                yield _packed(*_of_ouster(frame, table))
                frame, packets = core.LidarFrame(self._info), 0
        if packets:
            yield _packed(*_of_ouster(frame, table))


def velodyne_scan(message: Message) -> tuple[Any, StoredPoints]:
    """Return header and points of a stored velodyne_msgs/VelodyneScan, which holds the packets of a revolution.

    Raises:
        Exception: it is damaged, or its packets are.
    """
    import velodyne_decoder

    scan = decode_message(message, "velodyne_msgs/msg/VelodyneScan")
    packets = velodyne_decoder.PacketVector()
    for packet in scan.packets:
        stamp_s = packet.stamp.sec + packet.stamp.nanosec / 1e9
        packets.append(velodyne_decoder.VelodynePacket(stamp_s, bytes(packet.data)))
    if not packets:
        return scan.header, StoredPoints(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.dtype("<f4"))
    _, points = _of_velodyne(velodyne_decoder.ScanDecoder(velodyne_decoder.Config()).decode(packets))
    return scan.header, StoredPoints(points[:, :3], points[:, 3], np.dtype("<f4"))


def _find_metadata(path: Path) -> Path:
    """Return the `.json` with the longest name that equals or begins the capture's name."""
    name = path.name.partition(".pcap")[0]
    candidates = [file for file in visible_files(path.parent, "*.json") if name.startswith(file.stem)]
    if not candidates:
        raise ScanError(
            f"{path}: holds no packets of a Velodyne, and for those of an Ouster the sensor's metadata must lie "
            f"beside it as {name}.json"
        )
    return max(candidates, key=lambda file: len(file.stem))


def _packed(time_ns: int, points: NDArray[np.float32]) -> Message:
    return Message(time_ns or None, points.astype("<f4").tobytes(), "points")


def _of_ouster(frame: Any, table: Any) -> tuple[int, NDArray[np.float32]]:
    ranges, times = frame.field("RANGE"), frame.packet_timestamp
    points = np.column_stack([table(ranges).reshape(-1, 3), frame.field("REFLECTIVITY").reshape(-1) / 255.0])
    known = times[times > 0]
    return int(known.min()) if len(known) else 0, points[ranges.reshape(-1) > 0].astype(np.float32)


def _of_velodyne(scan: Any) -> tuple[int, NDArray[np.float32]]:
    stamp, points = scan
    scaled = np.array(points[:, :4], np.float32)
    scaled[:, 3] /= 255.0
    return round(stamp.host * 1e9), scaled
