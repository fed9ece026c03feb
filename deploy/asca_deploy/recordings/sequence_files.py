"""Files of scans over time, of a recording or a folder: Foxglove, rerun, video."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_deploy.around import ranges_around
from asca_deploy.detector import Detector
from asca_deploy.recordings.foxglove_file import FoxgloveFile, is_own_mcap
from asca_deploy.recordings.rerun_file import RerunFile, is_own_rrd
from asca_deploy.recordings.results import FrameResult, ResultFile
from asca_deploy.result_files import COMMAND
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.files import atomic_path, require_suffix, require_writable
from asca_pillars.base.installation import require
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.pictures.video import SUFFIX, BoxVideo, VideoFile, VideoView, find_encoder, is_own_video, require_view
from asca_pillars.scans.recordings.images import NearestImages

_RATES_HZ = (1.0, 60.0)
_USUAL_RATE_HZ = 10.0


def require_video(video: Path | None, view: str, inputs: Sequence[Path | None]) -> None:
    """Make sure before the work that the video can be written.

    Raises:
        AscaError: there is no such view or no encoder, or `video` is another's file, an input, or no .mp4.
    """
    require_view(view)
    if video is None:
        if view != "above":
            raise ConfigError(f"--video-view {view}: is of a video; give --video FILE.mp4, too")
        return
    require_suffix("--video", video, SUFFIX)
    find_encoder()
    require_writable(video, COMMAND, is_own_video, inputs)


def recording_rate_hz(times_ns: Sequence[int]) -> float:
    """Return the scans per second of a recording or folder, by the usual pause between two; 10 if unknown."""
    steps = np.diff(np.sort(np.array(times_ns, np.int64)))
    steps = steps[steps > 0]
    return float(np.clip(1e9 / float(np.median(steps)), *_RATES_HZ)) if len(steps) else _USUAL_RATE_HZ


class RecordingVideo:
    """Draws each scan of a sequence with its boxes and tracks; OSError if it cannot be written.

    Args:
        path: to write to.
        rate_hz: scans per second.
        view: "above" or "chase".
        ranges: where the detector looked, level frame.
        level: from the scans to a level frame; None: they are level.
        pose_at: the pose of a scan at a time in nanoseconds, 4x4; None: it is not known.
    """

    def __init__(
        self,
        path: Path,
        *,
        rate_hz: float,
        view: VideoView,
        ranges: Ranges,
        level: FrameChange | None,
        pose_at: Callable[[int], NDArray[np.float64]] | None,
    ) -> None:
        self._file, self._pose_at = VideoFile(path, rate_hz), pose_at
        self._video = BoxVideo(self._file, view, ranges, level)

    def write(self, result: FrameResult, points: NDArray[np.float32] | None) -> None:
        """Write one picture."""
        assert points is not None, "it shows points"
        ids = None if result.tracks is None else result.tracks.track_ids
        pose = None if self._pose_at is None else self._pose_at(result.time_ns)
        self._video.add(points, result.detections, result.time_ns / 1e9, ids, pose)

    def finish(self) -> None:
        """Write the end."""
        self._file.finish()


@dataclass(frozen=True, kw_only=True)
class SequenceFiles:
    """Paths of the files to write; None for those not wanted."""

    foxglove: Path | None = None
    rerun: Path | None = None
    video: Path | None = None
    video_view: VideoView = "above"

    @property
    def paths(self) -> list[Path]:
        """The files to write, in a fixed order."""
        return [path for path in (self.foxglove, self.rerun, self.video) if path is not None]

    @property
    def show_points(self) -> bool:
        """True if one of them draws the points of the scans."""
        return self.rerun is not None or self.video is not None

    def check(self, inputs: Sequence[Path | None]) -> None:
        """Make sure before the work that they can be written.

        Raises:
            AscaError: a path has another suffix, is one of `inputs` or another program's file, or a library is missing.
        """
        require_video(self.video, self.video_view, inputs)
        if self.rerun is not None:
            require("view")
            require_suffix("--rerun", self.rerun, ".rrd")
        if self.foxglove is not None:
            require("recordings")
            require_suffix("--foxglove", self.foxglove, ".mcap")
        require_writable(self.foxglove, COMMAND, is_own_mcap, inputs)
        require_writable(self.rerun, COMMAND, is_own_rrd, inputs)

    def open(
        self,
        places: ExitStack,
        handles: ExitStack,
        detector: Detector,
        times_ns: Sequence[int],
        pose_at: Callable[[int], NDArray[np.float64]] | None = None,
        images: NearestImages | None = None,
    ) -> list[ResultFile]:
        """Open the files.

        Args:
            places: gives them their names when it closes without an error.
            handles: completes them; is to be closed before `places`.
            detector: that finds the boxes.
            times_ns: of all scans; the video runs as fast as these.
            pose_at: the pose of a scan at a time in nanoseconds, 4x4; None: it is not known.
            images: of a camera, for rerun; None: none.
        """
        files: list[ResultFile] = []
        if self.foxglove is not None:
            place = places.enter_context(atomic_path(self.foxglove))
            foxglove = FoxgloveFile(handles.enter_context(place.open("wb")))
            handles.callback(foxglove.finish)
            files.append(foxglove)
        if self.rerun is not None:
            rerun = RerunFile(places.enter_context(atomic_path(self.rerun)), images)
            handles.callback(rerun.finish)
            files.append(rerun)
        if self.video is not None:
            level = detector.mounting.level
            video = RecordingVideo(
                places.enter_context(atomic_path(self.video)),
                rate_hz=recording_rate_hz(times_ns),
                view=self.video_view,
                ranges=ranges_around(detector.spec.ranges, detector.passes),
                level=None if level.is_identity else level,
                pose_at=pose_at,
            )
            handles.callback(video.finish)
            files.append(video)
        return files
