"""Live detection in point clouds that arrive at any time; the part of the node without ROS."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detector import Detector
from asca_deploy.ros2.health import Health
from asca_deploy.ros2.messages import Stamp, stamp_of
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.shipped import sample_scan_path
from asca_deploy.stream import ScanQueue
from asca_deploy.tracker import Tracker, Tracks
from asca_pillars.base.errors import AscaError, ConfigError, ScanError
from asca_pillars.scans.ground_height import NamedPoints, estimate_named_height
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.recordings.point_clouds import point_cloud_points
from asca_pillars.scans.scan_reader import finite_scan, read_scan
from asca_pillars.scans.scan_settings import (
    SAMPLE_SCANS,
    SEARCHED_SCANS,
    ScanSettings,
    common_reflectance_scale,
    has_finite_point,
)

_SCALE_SCANS = 16  # with points, that decide the reflectance's scale, as in a recording
_WARM_UP_SCANS = 3
_AGAIN_S = 0.1  # between two looks for a transform
_REMIND_S = 5.0

Answer = Callable[[Stamp, ScanDetections | Tracks], None]
Log = Callable[..., None]
"""Function that logs an event: its name, and its values by keyword."""


@dataclass(frozen=True)
class _Taken:
    """A waiting scan."""

    stamp: Stamp
    at_s: float


class LiveDetection:
    """Live detection: a queue that one thread fills with clouds, and a detector that another runs (`run`).

    Args:
        open_detector: a detector for a mounting; called once, or twice where scans decide the mounting.
        reading: how the points are to be read, and the mounting as far as it is stated; a height of "auto" is
            estimated from the first scans, which are not answered.
        answer: called with each scan's boxes, or its tracks, in the order of the scans.
        log: called with what was decided.
        tracker: gives boxes identities; None: none.
        pose_of: from the frame of the scans to their (4, 4) pose in the vehicle's frame, metres, or None as long as
            nobody knows it; then scans wait. None: the mounting says all.

    Attributes:
        health: what was counted.

    Raises:
        AscaError: as the detector; `axes` or `pose` are stated beside `pose_of`.
    """

    def __init__(
        self,
        open_detector: Callable[[Mounting], Detector],
        reading: ScanSettings,
        answer: Answer,
        log: Log,
        *,
        tracker: Tracker | None = None,
        pose_of: Callable[[str], NDArray[np.float64] | None] | None = None,
    ) -> None:
        self._open, self._reading, self._answer, self._log = open_detector, reading, answer, log
        self._tracker, self._pose_of = tracker, pose_of
        self._queue = ScanQueue("drop")
        self._ended = threading.Event()
        self._frame_id: str | None = None  # frame of the scans whose transform is used
        self._scale: float | None = None
        self._scale_scans = 0
        self._working_since: float | None = None
        self.health = Health()
        self._mounting = reading.stated_mounting()
        if pose_of is not None and (reading.pose is not None or reading.axes != "x-forward"):
            raise ConfigError("--frame: says how the scans lie already; leave --axes and --pose out")
        self._is_stated = pose_of is None and reading.sensor_height != "auto"
        self._detector = self._warmed_up()

    @property
    def model(self) -> str:
        """Name of the model."""
        return self._detector.bundle.name

    def enqueue(self, cloud: Any) -> None:
        """Enqueue a `sensor_msgs/PointCloud2`, or an object like it; a full queue drops its oldest scan."""
        at_s = monotonic()
        self.health.count_received()
        stamp = stamp_of(cloud.header)
        try:
            if self._frame_id is not None and stamp.frame_id != self._frame_id:
                raise ScanError(f"the scan is in {stamp.frame_id[:80]}, those before are in {self._frame_id}")
            points = self._points(cloud)
        except AscaError as error:
            if not self.health.unreadable:
                self._log("unreadable", trouble=str(error), said="once; diagnostics count the others")
            self.health.count_unreadable(str(error))
            return
        self._queue.put(points, _Taken(stamp, at_s))
        self.health.dropped = self._queue.dropped

    def run(self) -> None:
        """Answer scans until `close`; errors are raised, and recorded in `health.failure`."""
        try:
            if not self._is_stated and not self._find_mounting():
                return
            for points in self._queue:
                taken: _Taken = self._queue.next_tag()
                self._working_since = monotonic()
                # One scan at a time: a stream takes two more ahead, so that each answer would be later.
                detections = self._detector(points)
                boxes: ScanDetections | Tracks = detections
                if self._tracker is not None:
                    boxes = self._tracker(detections, taken.stamp.seconds or taken.at_s)
                self._answer(taken.stamp, boxes)
                names = boxes.detections.names if isinstance(boxes, Tracks) else boxes.names
                self.health.count_answered(1e3 * (monotonic() - taken.at_s), names, detections.report.warnings)
                self._working_since = None
        except BaseException as error:
            self.health.failure = str(error) or type(error).__name__
            raise

    def close(self) -> None:
        """Stop answering scans, except the one in the detector."""
        self._ended.set()
        self._queue.close()
        self._queue.interrupt()

    def busy_s(self) -> float:
        """Return the seconds that the detector has spent on a scan without an answer; 0 while it waits for one."""
        since = self._working_since
        return 0.0 if since is None else monotonic() - since

    def _points(self, cloud: Any) -> NDArray[np.float32]:
        """Return the finite points of a cloud, their reflectances in 0..1 by the scale that the first scans have."""
        stored = point_cloud_points(cloud, "the scan")
        scale = self._reading.reflectance_scale
        if scale == "auto" and stored.reflectance is not None:
            if self._scale_scans < _SCALE_SCANS and has_finite_point(stored):
                decided = common_reflectance_scale([stored]).scale
                self._scale_scans += 1
                if decided != "auto" and decided > (self._scale or 0.0):
                    self._scale = decided
                    self._log("reflectance_scale", scale=decided)
            scale = self._scale or scale
        return finite_scan(stored, scale).points

    def _find_mounting(self) -> bool:
        """Take the mounting from the transforms and the first scans; False if the node ends before."""
        waiting = iter(self._queue)
        if self._pose_of is not None:
            pose = self._wait_for_pose(waiting, self._pose_of)
            if pose is None:
                return False
            first, second, third, last = (tuple(row) for row in pose.tolist())
            self._mounting = replace(self._mounting, pose=(first, second, third, last))
        if self._reading.sensor_height == "auto":
            estimate = estimate_named_height(self._samples(waiting), self._mounting, SAMPLE_SCANS)
            if self._ended.is_set():
                return False
            self._mounting = replace(self._mounting, sensor_height_m=estimate.height_m)
            self._log("sensor_height", height_m=round(estimate.height_m, 3), text=str(estimate))
        self._detector = self._warmed_up()
        return True

    def _wait_for_pose(
        self, waiting: Iterator[NDArray[np.float32]], pose_of: Callable[[str], NDArray[np.float64] | None]
    ) -> NDArray[np.float64] | None:
        if next(waiting, None) is None:
            return None
        frame_id = self._queue.next_tag().stamp.frame_id
        reminded_s = monotonic() - _REMIND_S
        while (pose := pose_of(frame_id)) is None:
            if monotonic() - reminded_s >= _REMIND_S:
                reminded_s = monotonic()
                self._log(
                    "waiting", text=f"no transform from {frame_id[:80]} yet; scans are dropped until there is one"
                )
            if self._ended.wait(_AGAIN_S):
                return None
        self._frame_id = frame_id
        self._log("transform", frame_id=frame_id, pose=np.round(pose, 4).tolist())
        return pose

    def _samples(self, waiting: Iterator[NDArray[np.float32]]) -> Iterator[NamedPoints]:
        for number, points in enumerate(waiting, start=1):
            self._queue.next_tag()
            if number > SEARCHED_SCANS:
                return
            yield NamedPoints(f"scan {number}", points)

    def _warmed_up(self) -> Detector:
        """Return a detector that is warmed up."""
        detector = self._open(self._mounting)
        points = read_scan(sample_scan_path()).points
        for _ in range(_WARM_UP_SCANS):
            detector(points)
        return detector
