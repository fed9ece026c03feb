"""Images of a recording's camera: of every type that is read, and the nearest one to each time."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.images import CameraImage, ImageKind, NearestImages, read_image
from asca_pillars.scans.recordings.recorded_scans import open_recording
from asca_pillars.scans.recordings.recording import Message
from tests.scans.recordings.cloud_recordings import (
    START_NS,
    clouds,
    compressed_image,
    image_message,
    serialized,
    write_mcap,
)

PIXELS = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
JPEG, PNG = (cv2.imencode(suffix, PIXELS)[1].tobytes() for suffix in (".jpg", ".png"))
COMPRESSED, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
STEP_NS = 100_000_000


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize(("encoding", "order"), [("mono8", "L"), ("rgb8", "RGB"), ("bgr8", "BGR"), ("bgra8", "BGRA")])
def test_pixels_come_without_the_padding_of_their_rows(encoding: str, order: str, ros1: bool) -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (5, 7, len(order)), np.uint8)
    data = serialized(image_message(START_NS, pixels, encoding, padding=3, ros1=ros1), IMAGE, ros1=ros1)
    image = read_image(Message(5, data, "ros1" if ros1 else "cdr"), "Image")
    assert (image.time_ns, image.kind) == (START_NS, order)
    np.testing.assert_array_equal(image.content, pixels)


@pytest.mark.parametrize(("content", "kind"), [(JPEG, "image/jpeg"), (PNG, "image/png")])
def test_files_pass_as_they_are(content: bytes, kind: str) -> None:
    expected = CameraImage(START_NS + 7, content, kind)
    assert read_image(Message(5, compressed_image(START_NS + 7, content), "cdr"), "CompressedImage") == expected
    stamp = {"sec": START_NS // 10**9, "nsec": 7}
    text = json.dumps({"timestamp": stamp, "format": "jpeg", "data": base64.b64encode(content).decode()})
    assert read_image(Message(5, text.encode(), "json"), "Foxglove") == expected
    assert read_image(Message(5, protobuf(START_NS // 10**9, 7, content), "protobuf"), "Foxglove") == expected
    assert read_image(Message(5, protobuf(0, 0, content), "protobuf"), "Foxglove").time_ns == 5


def protobuf(sec: int, nanosec: int, content: bytes) -> bytes:
    """A foxglove.CompressedImage: timestamp 1, data 2, format 3, frame_id 4."""

    def varint(value: int) -> bytes:
        return bytes([value]) if value < 128 else bytes([value & 127 | 128]) + varint(value >> 7)

    def field(number: int, value: bytes) -> bytes:
        return varint(number << 3 | 2) + varint(len(value)) + value

    time = (b"\x08" + varint(sec) if sec else b"") + (b"\x10" + varint(nanosec) if nanosec else b"")
    return field(1, time) + field(4, b"camera") + field(2, content) + field(3, b"jpeg")


def test_what_cannot_be_shown_is_refused() -> None:
    depth, short = image_message(START_NS, PIXELS, "16UC1"), image_message(START_NS, PIXELS, "rgb8")
    short.height = 5
    packed = compressed_image(START_NS, bytes(12) + PNG, "compressedDepth png")
    kinds: tuple[tuple[bytes, ImageKind, str], ...] = (
        (serialized(depth, IMAGE), "Image", "'16UC1'; mono8, rgb8"),
        (serialized(short, IMAGE), "Image", "72 bytes where 5 rows of 18 hold 6 pixels of 3"),
        (packed, "CompressedImage", "neither JPEG nor PNG but 'compressedDepth png'"),
    )
    for data, kind, said in kinds:
        with pytest.raises(ValueError, match=said):
            read_image(Message(5, data, "cdr"), kind)


def recording(path: Path, images: list[tuple[int, bytes]], **topics: tuple[str, str, list[tuple[int, bytes]]]) -> Path:
    return write_mcap(path, {"/lidar": clouds(3)}, images={"/camera": (COMPRESSED, "cdr", images), **topics})


def images_at(*times: int) -> list[tuple[int, bytes]]:
    return [(time_ns, compressed_image(time_ns, JPEG)) for time_ns in times]


def test_each_time_gets_the_nearest_image(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    times = sorted(START_NS + rng.integers(0, 20 * STEP_NS, 30))
    images = NearestImages(open_recording(recording(tmp_path / "a.mcap", images_at(*map(int, times)))))
    for asked in range(START_NS - 4 * STEP_NS, START_NS + 30 * STEP_NS, STEP_NS):
        nearest = min(abs(time - asked) for time in times)
        image = images.at(asked)
        assert (image is None) == (nearest > 500_000_000)
        assert image is None or abs(image.time_ns - asked) == nearest
    assert images.remarks() == []


def test_damaged_images_are_counted_and_the_others_given(tmp_path: Path) -> None:
    times = [START_NS + i * STEP_NS for i in range(4)]
    stored = images_at(*times)
    stored[1], stored[2] = (times[1], stored[1][1][:30]), (times[2], b"")
    images = NearestImages(open_recording(recording(tmp_path / "a.mcap", stored)))
    given = [image and image.time_ns for image in map(images.at, times)]
    assert given == [times[0], times[0], times[3], times[3]]
    assert "/camera: 2 images were left out: " in images.remarks()[0]


def test_the_first_topic_is_taken_or_the_one_that_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    late = [(START_NS + 10**12, b"x")]
    recording(
        path,
        images_at(START_NS),
        **{"/a/empty": (IMAGE, "cdr", []), "/zoom": ("foxglove.CompressedImage", "cbor", late)},
    )
    opened = open_recording(path)
    images, zoom = NearestImages(opened), NearestImages(opened, "/zoom")
    assert images.topic is not None and images.topic.name == "/camera"
    assert [topic.name for topic in images.others] == ["/camera", "/zoom"] and zoom.others == []
    assert zoom.at(START_NS) is None
    assert "encoded as cbor" in zoom.remarks()[0] and zoom.remarks()[1] == "/zoom: no image is within 0.5 s of a scan"
    for name in ("/lidar", "/gone"):
        with pytest.raises(ScanError, match=rf"no images on a topic {name}; there are /camera .*, /zoom"):
            NearestImages(opened, name)
    none = NearestImages(open_recording(write_mcap(tmp_path / "b.mcap", {"/lidar": clouds(3)})))
    assert none.topic is None and none.at(START_NS) is None and none.remarks() == []
