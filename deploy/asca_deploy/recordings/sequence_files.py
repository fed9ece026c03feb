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
from asca_deploy.recordings.results import ResultFile
from asca_deploy.recordings.video import RecordingVideo, recording_rate_hz, require_video
from asca_deploy.result_files import COMMAND
from asca_pillars.base.files import atomic_path, require_suffix, require_writable
from asca_pillars.base.installation import require
from asca_pillars.pictures.video import VideoView
from asca_pillars.scans.recordings.images import NearestImages


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
