"""Scans and boxes as a file for the rerun viewer: `rerun out.rrd`."""

import errno
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.recordings.results import FrameResult
from asca_pillars.pictures.colors import class_rgb, ground_height, height_rgb
from asca_pillars.scans.recordings.images import CameraImage, NearestImages

MAX_POINTS = 20_000  # points shown of a scan: a whole revolution of 120,000 takes 14 MB a second
TIMELINE = "time"
MOVES_MPS = 0.5
"""Speed below which tracks have no arrow."""
_BACKGROUND = (14, 18, 24)
_CAMERA = "camera"
APPLICATION = "asca-pillars"
_HEAD_BYTES = 4096  # leading bytes of a file that hold the application's name
_FLUSH_S = 60.0


def is_own_rrd(path: Path) -> bool:
    """Return whether it is a file that a `RerunFile` wrote, and no recording of others."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    return head.startswith(b"RRF") and APPLICATION.encode() in head


class RerunFile:
    """Writes an .rrd: `scan` the points, colored by height, `boxes` what was found, `velocities` of tracks, `camera`.

    The viewer opens it with a 3D view of these, a 2D view of the images if there are any, and its panels folded.
    OSError if it cannot be written.

    Args:
        path: to write to.
        images: of which the nearest one to each scan is shown; None: none.
    """

    def __init__(self, path: Path, images: NearestImages | None = None) -> None:
        import rerun as rr

        self._rr = rr
        self._images = None if images is None or images.topic is None else images
        self._image: CameraImage | None = None
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.save(path)
        self._stream.send_blueprint(self._blueprint())
        self._failed = False
        self._ground_m: float | None = None

    def write(self, result: FrameResult, points: NDArray[np.float32] | None) -> None:
        """Write one scan with its boxes."""
        assert points is not None, "it shows points"
        rr, stream = self._rr, self._stream
        stream.set_time(TIMELINE, timestamp=np.datetime64(result.time_ns, "ns"))
        subset = points[:: -(-len(points) // MAX_POINTS) or 1]
        if self._ground_m is None and len(points):
            self._ground_m = ground_height(points[:, 2])  # once: colors do not flicker
        colors = height_rgb(subset[:, 2], self._ground_m or 0.0)
        stream.log("scan", rr.Points3D(subset[:, :3], colors=colors, radii=0.03))
        stream.log("boxes", self._boxes(result))
        if result.tracks is not None:
            stream.log("velocities", self._velocities(result))
        if self._images is not None:
            self._show(self._images.at(result.time_ns))
        self._flush()

    def finish(self) -> None:
        """Write what is still in memory."""
        if not self._failed:
            self._flush()
            self._stream.disconnect()

    def _flush(self) -> None:
        """Flush after each scan: once its writer has failed, rerun reports it here and blocks anywhere else."""
        try:
            self._stream.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:
            self._failed = True
            raise OSError(errno.EIO, f"rerun cannot write ({error}); is the disk full?") from None

    def _blueprint(self) -> Any:
        import rerun.blueprint as rrb

        name = "Scan, boxes and velocities"
        if self._images is None:
            view = rrb.Spatial3DView(origin="/", name=name, background=_BACKGROUND)
            return rrb.Blueprint(view, collapse_panels=True)
        assert self._images.topic is not None
        contents = ["+ $origin/**", f"- /{_CAMERA}/**"]
        scene = rrb.Spatial3DView(origin="/", contents=contents, name=name, background=_BACKGROUND)
        camera = rrb.Spatial2DView(origin=f"/{_CAMERA}", name=self._images.topic.name)
        return rrb.Blueprint(rrb.Horizontal(scene, camera, column_shares=[3, 2]), collapse_panels=True)

    def _show(self, image: CameraImage | None) -> None:
        """Log an image that is not shown already; None: the one that is shown goes."""
        previous, self._image = self._image, image
        if image is previous:
            return
        if image is None:
            self._stream.log(_CAMERA, self._rr.Clear(recursive=False))
        elif isinstance(image.content, bytes):
            self._stream.log(_CAMERA, self._rr.EncodedImage(contents=image.content, media_type=image.kind))
        else:
            self._stream.log(_CAMERA, self._rr.Image(image.content, color_model=image.kind))

    def _velocities(self, result: FrameResult) -> Any:
        """Return an arrow for each moving track, as long as its way of one second, from the center of its roof."""
        assert result.tracks is not None
        moving = np.hypot(*result.tracks.velocities_mps.T) > MOVES_MPS
        boxes, velocities = result.detections.boxes[moving], result.tracks.velocities_mps[moving]
        return self._rr.Arrows3D(
            origins=np.column_stack([boxes[:, :2], boxes[:, 2] + boxes[:, 5] / 2]),
            vectors=np.column_stack([velocities, np.zeros(len(velocities))]),
            colors=self._colors(result)[moving],
            radii=0.06,
        )

    def _colors(self, result: FrameResult) -> NDArray[np.uint8]:
        return np.array([class_rgb(name) for name in result.detections.names], np.uint8).reshape(-1, 3)

    def _boxes(self, result: FrameResult) -> Any:
        rr, boxes = self._rr, result.detections.boxes
        half: NDArray[np.float64] = boxes[:, 6].astype(np.float64) / 2
        quaternions = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
        if result.tracks is None:
            labels = [f"{box.class_name} {box.score:.2f}" for box in result.detections]
        else:
            labels = [f"{track.detection.class_name} {track.track_id}" for track in result.tracks]
        return rr.Boxes3D(
            centers=boxes[:, :3],
            sizes=boxes[:, 3:6],
            quaternions=quaternions,
            labels=labels,
            colors=self._colors(result),
            radii=0.02,
        )
