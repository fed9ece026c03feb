"""Videos of detections: a check before the work that one can be written, and that of a recording."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_deploy.recordings.results import FrameResult
from asca_deploy.result_files import COMMAND
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.files import require_suffix, require_writable
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.ranges import Ranges
from asca_pillars.pictures.video import SUFFIX, BoxVideo, VideoFile, VideoView, find_encoder, is_own_video, require_view

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

    def write(self, found: FrameResult, points: NDArray[np.float32] | None) -> None:
        """Write one picture."""
        assert points is not None, "it shows points"
        ids = None if found.tracks is None else found.tracks.track_ids
        pose = None if self._pose_at is None else self._pose_at(found.time_ns)
        self._video.add(points, found.detections, found.time_ns / 1e9, ids, pose)

    def finish(self) -> None:
        """Write the end."""
        self._file.finish()
