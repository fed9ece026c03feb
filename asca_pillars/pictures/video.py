"""Videos of boxes over time, H.264 in MP4: from above or in 3D, with identities and trails.

The encoder is the program ffmpeg: that of the package imageio-ffmpeg (extra `video`), else the system's. OpenCV's own
writer has MPEG-4 alone, which browsers do not play.
"""

import importlib.util
import shutil
import subprocess
import tempfile
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import AscaError, ConfigError
from asca_pillars.base.installation import install_command
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.pictures.colors import ground_height
from asca_pillars.pictures.drawing import Image, Texts, Trail
from asca_pillars.pictures.perspective import draw_chase
from asca_pillars.pictures.visualize import class_color, class_layers, draw_layers

VideoView = Literal["above", "chase"]
SUFFIX = ".mp4"
MADE_BY = "asca-pillars video"
WIDTH_PX: dict[str, int] = {"above": 900, "chase": 1280}
TRAIL_S = 3.0
"""Length of a trail in seconds."""
_HEAD_BYTES = 16 << 20  # the file's index, with the comment, stands before the pictures
_GRAY = (190, 180, 172)


def find_encoder() -> str:
    """Return the program that encodes videos.

    Raises:
        AscaError: there is none; the message says how to install it.
    """
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    if ffmpeg := shutil.which("ffmpeg"):
        return ffmpeg
    raise AscaError(f"a video needs ffmpeg, which is not here: {install_command('video')}")


def is_own_video(path: Path) -> bool:
    """Return whether it is an MP4 that a `VideoFile` wrote."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    return head[4:8] == b"ftyp" and MADE_BY.encode() in head


class VideoFile:
    """Writes an MP4 of pictures of one size; complete when the block ends.

    Args:
        path: to write to; the caller renames it.
        rate_hz: pictures a second.

    Raises:
        AscaError: there is no encoder.
        OSError: the encoder failed, as on a full disk.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path, self._rate_hz, self._encoder = path, rate_hz, find_encoder()
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._shape: tuple[int, ...] = ()

    def __enter__(self) -> "VideoFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.finish()
        elif self._process is not None:
            self._process.kill()
            self._process.wait()

    def write(self, image: Image) -> None:
        """Add a picture (H, W, 3), BGR. An odd last row or column is left out: H.264 has none."""
        image = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
        if self._process is None:
            self._process, self._shape = self._start(image), image.shape
        if image.shape != self._shape:
            raise ValueError(f"a picture of {image.shape} after one of {self._shape}; all have one size")
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(image.tobytes())
        except BrokenPipeError:
            self.finish()

    def finish(self) -> None:
        """Write the end."""
        if self._process is None:
            return
        process, self._process = self._process, None
        assert process.stdin is not None and self._said is not None
        with suppress(BrokenPipeError):
            process.stdin.close()
        code = process.wait()
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        self._said.close()
        if code:
            raise OSError(f"{self._path}: ffmpeg failed ({lines[-1] if lines else f'exit code {code}'})")

    def _start(self, image: Image) -> "subprocess.Popen[bytes]":
        height, width = image.shape[:2]
        command = [self._encoder, "-hide_banner", "-loglevel", "error", "-nostdin", "-y"]
        command += ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{width}x{height}", "-r", f"{self._rate_hz:.6g}"]
        command += ["-i", "-", "-an", "-c:v", "libx264", "-preset", "veryfast", "-crf", "21", "-pix_fmt", "yuv420p"]
        command += ["-movflags", "+faststart", "-metadata", f"comment={MADE_BY}", "-f", "mp4", str(self._path)]
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - read when the encoder has ended
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._said)


def require_view(view: str) -> None:
    """Raise ConfigError unless there is such a `VideoView`."""
    if view not in get_args(VideoView):
        raise ConfigError(f"--video-view {view}: give {' or '.join(get_args(VideoView))}")


class BoxVideo:
    """Draws scan after scan with its boxes into a video.

    Args:
        file: is written to.
        view: from above, or in 3D from behind the sensor.
        ranges: where the detector looked, level frame; they choose what is shown.
        level: from the scans' frame to a level one; None: it is such a one.
    """

    def __init__(self, file: VideoFile, view: VideoView, ranges: Ranges, level: FrameChange | None = None) -> None:
        require_view(view)
        self._file, self._view, self._ranges, self._level = file, view, ranges, level
        self._ground_m: float | None = None
        self._trails: dict[int, deque[tuple[float, NDArray[np.float64]]]] = {}
        self._began_s: float | None = None

    def add(
        self,
        points: NDArray[np.floating],
        detections: Detections,
        time_s: float,
        track_ids: NDArray[np.integer] | None = None,
        pose: NDArray[np.float64] | None = None,
    ) -> None:
        """Add one scan.

        Args:
            points: (N, >=3) metres, in the scan's frame.
            detections: found in it, in the same frame.
            time_s: of the scan.
            track_ids: (M,) identity of each box, drawn beside it with a trail; None: scores are drawn.
            pose: 4x4, from the scan to a frame that stands still; None: trails show how things moved about the sensor.
        """
        self._file.write(self.draw(points, detections, time_s, track_ids, pose))

    def draw(
        self,
        points: NDArray[np.floating],
        detections: Detections,
        time_s: float,
        track_ids: NDArray[np.integer] | None = None,
        pose: NDArray[np.float64] | None = None,
    ) -> Image:
        """Return the picture that `add` adds, (H, W, 3) BGR."""
        boxes: NDArray[np.floating] = detections.boxes
        trails, texts = [], None
        if track_ids is not None:
            trails = self._extend(detections, track_ids, time_s, np.eye(4) if pose is None else pose)
            texts = [f"{name} {number}" for name, number in zip(detections.names, track_ids.tolist(), strict=True)]
        if self._level is not None:
            points, boxes = self._level.points(points), self._level.boxes(boxes)
        shown = Detections(boxes.astype(np.float32), detections.scores, detections.labels, detections.class_names)
        if self._ground_m is None and len(points):
            heights = points[:, 2]
            self._ground_m = ground_height(heights[np.isfinite(heights)])
        layers = class_layers(shown, texts=texts)
        width_px = WIDTH_PX[self._view]
        options = {"width_px": width_px, "trails": trails, "ground_m": self._ground_m}
        if self._view == "chase":
            image = draw_chase(points, layers, self._ranges, **options)  # type: ignore[arg-type]
        else:
            image = draw_layers(points, layers, self._ranges, room_for=_whole(self._ranges), **options)  # type: ignore[arg-type]
        self._began_s = time_s if self._began_s is None else self._began_s
        Texts(image, 0.45).put(f"{time_s - self._began_s:.1f} s", [(16, image.shape[0] - 14)], _GRAY)
        return image

    def _extend(
        self, detections: Detections, track_ids: NDArray[np.integer], time_s: float, pose: NDArray[np.float64]
    ) -> list[Trail]:
        """Extend the boxes' trails by their places; return the trails of these boxes in the picture's frame."""
        boxes = detections.boxes.astype(np.float64)
        floors = np.column_stack([boxes[:, :2], boxes[:, 2] - boxes[:, 5] / 2])
        from_world = np.linalg.inv(pose)
        trails = []
        for number, floor, name in zip(track_ids.tolist(), floors, detections.names, strict=True):
            trail = self._trails.setdefault(number, deque())
            trail.append((time_s, pose[:3, :3] @ floor + pose[:3, 3]))
            while abs(time_s - trail[0][0]) > TRAIL_S:
                trail.popleft()
            places = np.stack([place for _, place in trail]) @ from_world[:3, :3].T + from_world[:3, 3]
            if self._level is not None:
                places = self._level.points(places)
            trails.append(Trail(places, class_color(name)))
        return trails


def _whole(ranges: Ranges) -> NDArray[np.float64]:
    """Return a box (1, 7) as large as the ranges, so that all pictures have the same extent and size."""
    (x_min, x_max), (y_min, y_max), _ = ranges
    return np.array([[(x_min + x_max) / 2, (y_min + y_max) / 2, 0, x_max - x_min, y_max - y_min, 1, 0]])
