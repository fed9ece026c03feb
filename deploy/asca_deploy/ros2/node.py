"""ROS 2 node; the only module that imports `rclpy`, which comes with ROS or with the extra `ros2`."""

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detector import Detector
from asca_deploy.ros2.health import Systemd
from asca_deploy.ros2.live import LiveDetection
from asca_deploy.ros2.messages import (
    Stamp,
    detection_array,
    diagnostic_array,
    filled,
    marker_array,
    message_type,
)
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.tracker import Tracker, Tracks
from asca_pillars.base.errors import ConfigError, ProviderError
from asca_pillars.base.installation import install_command
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_settings import ScanSettings
from asca_pillars.scans.transforms import Transforms

Qos: TypeAlias = Literal["auto", "best_effort", "reliable"]

_DEPTH = 5  # messages that may wait in the middleware while one is taken over
_LOOK_S = 0.1  # between two looks at who publishes
_STATUS_S = 1.0
_SPIN_S = 0.1
_STUCK_S = 10.0  # for one scan, without a watchdog


@dataclass(frozen=True, kw_only=True)
class NodeSettings:
    """Settings of `asca ros2`.

    Attributes:
        topic: of `sensor_msgs/PointCloud2`.
        reading: as `LiveDetection`.
        qos: of the subscription; "auto": as the publishers offer, see `reliability`.
        frame: the frame of the vehicle, x forward, y left, z up, to which TF says how the scans lie; None: the mounting
            of `reading` says it.
        log_every: scans between two lines of figures in the log.
        ros_args: arguments for ROS, such as `--ros-args -r __ns:=/front`.

    Raises:
        ConfigError: `qos` is another word, or `log_every` is below 1.
    """

    topic: str
    reading: ScanSettings
    qos: Qos = "auto"
    frame: str | None = None
    log_every: int = 100
    ros_args: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.qos not in get_args(Qos):
            raise ConfigError(f"--qos {self.qos}: give {', '.join(get_args(Qos)[:-1])} or {get_args(Qos)[-1]}")
        if self.log_every < 1:
            raise ConfigError(f"--log-every {self.log_every}: give 1 or more scans")


def reliability(offered: Sequence[str], qos: Qos) -> Literal["best_effort", "reliable"] | None:
    """Return the reliability to subscribe with; None if it depends on publishers and there are none yet.

    A reliable subscription gets nothing of a best-effort publisher. A best-effort subscription gets messages of both,
    but loses each one that lacks a fragment, as clouds larger than the middleware's buffers do. So
    the subscription is reliable where all publishers are.

    Args:
        offered: by each publisher, "reliable" or "best_effort".
        qos: the setting.
    """
    if qos != "auto":
        return qos
    if not offered:
        return None
    return "reliable" if all(offer == "reliable" for offer in offered) else "best_effort"


def log(event: str, **facts: Any) -> None:
    """Print a line of JSON with the time on standard output."""
    print(json.dumps({"time_s": round(time.time(), 3), "event": event} | facts), flush=True)


def run_node(
    settings: NodeSettings, open_detector: Callable[[Mounting], Detector], tracker: Tracker | None = None
) -> None:
    """Answer the topic's scans until SIGINT or SIGTERM.

    The detector is warmed up before the node subscribes, so that the first scan is answered as fast as the others.

    Raises:
        ProviderError: ROS 2 is not installed, or its part that a setting needs.
        AscaError: the detector cannot be opened, or ended.
    """
    rclpy = _rclpy()
    if settings.frame is not None:
        _tf_message()
    with _stop_signals() as stop:
        transforms = Transforms()
        frame = settings.frame
        pose_of = None
        if frame is not None:

            def pose_of(source: str) -> NDArray[np.float64] | None:
                return transforms.between(source, frame)

        publishers: list[Callable[[Stamp, ScanDetections | Tracks], None]] = []

        def answer(stamp: Stamp, detections: ScanDetections | Tracks) -> None:
            for publish in publishers:
                publish(stamp, detections)
            if (live.health.answered + 1) % settings.log_every == 0:
                log("scans", **live.health.summary())

        live = LiveDetection(open_detector, settings.reading, answer, log, tracker=tracker, pose_of=pose_of)
        if stop.is_set():
            return
        rclpy.init(args=["asca", *settings.ros_args], signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        try:
            node = _Node(rclpy, settings, live, transforms)
            publishers += node.publishers()
            _spin(rclpy, node, live, stop)
            node.close()
        finally:
            rclpy.try_shutdown()


def _spin(rclpy: Any, node: "_Node", live: LiveDetection, stop: threading.Event) -> None:
    failures: list[BaseException] = []

    def work() -> None:
        try:
            live.run()
        except BaseException as error:
            failures.append(error)

    worker = threading.Thread(target=work, name="asca-detector", daemon=True)
    systemd = Systemd()
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node.node)
    worker.start()
    systemd.ready("warmed up")
    log("ready", model=node.model, topic=node.topic, qos=node.qos)
    told_s = time.monotonic()
    try:
        while worker.is_alive() and not stop.is_set():
            executor.spin_once(timeout_sec=_SPIN_S)
            limit_s = systemd.watchdog_s or _STUCK_S
            if systemd.watchdog_s and time.monotonic() - told_s > limit_s / 3 and live.busy_s() < limit_s:
                told_s = time.monotonic()
                systemd.alive(f"{live.health.answered} scans answered, {live.health.dropped} dropped")
    finally:
        systemd.stopping()
        live.close()
        worker.join(timeout=1.0)
        log("end", **live.health.summary())
        executor.shutdown(timeout_sec=0.2)
    if failures:
        raise failures[0]


class _Node:
    """Connection to ROS: the subscription, which follows the publishers, and the answers."""

    def __init__(self, rclpy: Any, settings: NodeSettings, live: LiveDetection, transforms: Transforms) -> None:
        self._rclpy, self._settings, self._live = rclpy, settings, live
        self.node = rclpy.create_node("asca")
        self.topic, self.qos = self.node.resolve_topic_name(settings.topic), settings.qos
        self.model = live.model
        self._subscription: Any = None
        self._reliability: str | None = None
        self._markers = self._publisher("visualization_msgs/MarkerArray", "~/markers")
        self._detections = self._publisher("vision_msgs/Detection3DArray", "~/detections", needed=False)
        self._diagnostics = self._publisher("diagnostic_msgs/DiagnosticArray", "/diagnostics")
        if settings.frame is not None:
            kind, qos = _tf_message(), rclpy.qos.QoSProfile(depth=100)
            still = rclpy.qos.QoSProfile(depth=100, durability=rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL)
            self.node.create_subscription(kind, "/tf", transforms.add, qos)
            self.node.create_subscription(kind, "/tf_static", transforms.add, still)
        self._follow()
        self.node.create_timer(_LOOK_S, self._follow)
        self.node.create_timer(_STATUS_S, self._publish_diagnostics)

    def publishers(self) -> list[Callable[[Stamp, ScanDetections | Tracks], None]]:
        """Return the publishers of the boxes of a scan."""
        both = [self._publish(self._markers, marker_array), self._publish(self._detections, detection_array)]
        return [publisher for publisher in both if publisher is not None]

    def close(self) -> None:
        """Destroy the ROS node."""
        self.node.destroy_node()

    def _publish(
        self, publisher: Any, fields_of: Callable[[Stamp, ScanDetections | Tracks], Mapping[str, Any]]
    ) -> Callable[[Stamp, ScanDetections | Tracks], None] | None:
        if publisher is None:
            return None
        kind = publisher.msg_type

        def publish(stamp: Stamp, detections: ScanDetections | Tracks) -> None:
            if publisher.get_subscription_count():  # messages take longer to be made than boxes to be tracked
                publisher.publish(filled(kind(), fields_of(stamp, detections)))

        return publish

    def _publisher(self, kind: str, topic: str, *, needed: bool = True) -> Any:
        try:
            return self.node.create_publisher(message_type(kind), topic, 10)
        except ImportError:
            package = kind.partition("/")[0]
            if needed:
                raise ProviderError(f"{package} is not installed: {_remedy(package)}") from None
            log("absent", text=f"{package} is not installed, no {kind} is published: {_remedy(package)}")
            return None

    def _follow(self) -> None:
        """Subscribe with the publishers' reliability."""
        qos = self._rclpy.qos
        offered = [
            "reliable" if publisher.qos_profile.reliability == qos.ReliabilityPolicy.RELIABLE else "best_effort"
            for publisher in self.node.get_publishers_info_by_topic(self.topic)
        ]
        requested = reliability(offered, self._settings.qos)
        if requested is None or requested == self._reliability:
            return
        if self._subscription is not None:
            self.node.destroy_subscription(self._subscription)
        profile = qos.QoSProfile(depth=_DEPTH, reliability=getattr(qos.ReliabilityPolicy, requested.upper()))
        self._subscription = self.node.create_subscription(
            message_type("sensor_msgs/PointCloud2"),
            self.topic,
            self._live.enqueue,
            profile,
            event_callbacks=self._events(),
        )
        self._reliability = requested
        log("subscribed", topic=self.topic, reliability=requested, publishers=len(offered))

    def _events(self) -> Any:
        """Return the callbacks for events of the middleware."""
        from rclpy.event_handler import SubscriptionEventCallbacks

        def lost(event: Any) -> None:
            self._live.health.lost += int(event.total_count_change)

        return SubscriptionEventCallbacks(message_lost=lost, use_default_callbacks=True)

    def _publish_diagnostics(self) -> None:
        level, message = self._live.health.status(self.topic, self.node.count_publishers(self.topic))
        if not self._diagnostics.get_subscription_count():
            return
        health, now = self._live.health, self.node.get_clock().now().to_msg()
        values = {
            "received": health.received,
            "answered": health.answered,
            "dropped": health.dropped,
            "lost": health.lost,
            "unreadable": health.unreadable,
            "reliability": self._reliability,
            "busy_s": round(self._live.busy_s(), 3),
        }
        fields = diagnostic_array(
            now.sec, now.nanosec, level=level, message=message, hardware_id=self.model, values=values
        )
        self._diagnostics.publish(filled(self._diagnostics.msg_type(), fields))


@contextmanager
def _stop_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set; a second signal ends the process as usual."""
    stop = threading.Event()
    kinds = signal.SIGINT, signal.SIGTERM
    before = {kind: signal.getsignal(kind) for kind in kinds}

    def restore() -> None:
        for kind, handler in before.items():
            signal.signal(kind, handler)

    def end(*_: object) -> None:
        stop.set()
        restore()

    for kind in kinds:
        signal.signal(kind, end)
    try:
        yield stop
    finally:
        restore()


def _rclpy() -> Any:
    try:
        import rclpy
        import rclpy.event_handler
        import rclpy.executors
        import rclpy.qos
        import rclpy.signals
    except ImportError as error:
        raise ProviderError(f"ROS 2 is not installed ({error}): {_remedy('rclpy')}") from None
    return rclpy


def _tf_message() -> Any:
    try:
        return message_type("tf2_msgs/TFMessage")
    except ImportError:
        raise ProviderError(
            f"--frame: tf2_msgs is not installed: {_remedy('tf2_msgs')}; or give --pose FILE instead"
        ) from None


def _remedy(package: str) -> str:
    distribution = os.environ.get("ROS_DISTRO")
    if distribution:
        return f"apt-get install ros-{distribution}-{package.replace('_', '-')}"
    by_pip = "" if package in ("vision_msgs", "tf2_msgs") else f", or {install_command('ros2')}"
    return f"source a ROS 2 that has it (/opt/ros/DISTRO/setup.bash), in the same Python{by_pip}"
