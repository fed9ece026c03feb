"""Clouds in, boxes out, without ROS: in order, with their stamps, the oldest dropped; and what systemd is told."""

import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector
from asca_deploy.ros2.health import Systemd
from asca_deploy.ros2.live import LiveDetection
from asca_deploy.ros2.messages import ERROR, OK, WARN, Stamp
from asca_deploy.ros2.node import NodeSettings, reliability
from asca_deploy.tracker import Tracker, Tracks
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_settings import ScanSettings

XYZI = ("x", "y", "z", "intensity")


def cloud(points: NDArray[Any], sec: int = 1, frame_id: str = "lidar", names: tuple[str, ...] = XYZI) -> Any:
    """A PointCloud2 as rclpy gives it."""
    fields = [SimpleNamespace(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(names)]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=5), frame_id=frame_id)
    data = np.ascontiguousarray(points, np.float32)
    step = 4 * len(names)
    return SimpleNamespace(
        header=header, height=1, width=len(data), point_step=step, row_step=step * len(data), is_bigendian=False,
        fields=fields, data=memoryview(data.tobytes()),
    )  # fmt: skip


class Running:
    """A `LiveDetection` at work in its thread, with what it answered."""

    def __init__(self, bundle: Path, reading: ScanSettings | None = None, **options: Any) -> None:
        self.answers: list[tuple[Stamp, Detections | Tracks]] = []
        self.events: list[dict[str, Any]] = []
        self.mountings: list[Mounting] = []
        self.came, self.entered, self.free = threading.Semaphore(0), threading.Event(), threading.Event()
        self.free.set()
        self.live = LiveDetection(
            self._open(bundle),
            reading or ScanSettings(),
            self._answer,
            lambda event, **facts: self.events.append({"event": event} | facts),
            **options,
        )
        self.error: BaseException | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _open(self, bundle: Path) -> Callable[[Mounting], Detector]:
        return lambda mounting: self.mountings.append(mounting) or Detector(bundle, threads=1, mounting=mounting)

    def _answer(self, stamp: Stamp, found: Detections | Tracks) -> None:
        self.entered.set()
        self.free.wait(20)
        self.answers.append((stamp, found))
        self.came.release()

    def _run(self) -> None:
        try:
            self.live.run()
        except BaseException as error:
            self.error = error

    def ask(self, one: Any) -> Detections | Tracks:
        self.live.enqueue(one)
        assert self.came.acquire(timeout=20)
        return self.answers[-1][1]

    def end(self) -> None:
        self.live.close()
        self.thread.join(timeout=20)
        assert not self.thread.is_alive()


def test_answers_are_those_of_the_detector(tiny_bundle: Path, scans: list[NDArray[np.float32]]) -> None:
    running, detector = Running(tiny_bundle), Detector(tiny_bundle, threads=1)
    found = [running.ask(cloud(points, sec)) for sec, points in enumerate(scans)]
    running.end()
    assert [stamp for stamp, _ in running.answers] == [Stamp(sec, 5, "lidar") for sec in range(len(scans))]
    assert any(len(detector(points)) for points in scans)
    for one, points in zip(found, scans, strict=True):
        assert isinstance(one, Detections)
        np.testing.assert_array_equal(one.boxes, detector(points).boxes)
    health = running.live.health
    assert (health.received, health.answered, health.dropped) == (3, 3, 0)
    assert running.live.busy_s() == 0 and running.error is None
    assert health.summary()["latency_ms"].keys() == {"p50", "p95", "p99", "max"}


def test_no_points_not_numbers_and_other_fields(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    running = Running(tiny_bundle)
    assert len(running.ask(cloud(np.zeros((0, 4))))) == 0
    broken = scan.copy()
    broken[::2, 1] = np.nan
    running.ask(cloud(broken))
    for _ in range(2):
        running.live.enqueue(cloud(scan, names=("u", "v", "w", "intensity")))
    running.ask(cloud(scan[:, :3], names=("x", "y", "z")))
    running.end()
    health = running.live.health
    assert (health.received, health.answered, health.unreadable) == (5, 3, 2)
    assert health.error_text is not None and "no field x" in health.error_text
    assert [one["event"] for one in running.events].count("unreadable") == 1


def test_the_oldest_scan_gives_way(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    running = Running(tiny_bundle)
    running.free.clear()
    running.live.enqueue(cloud(scan, 0))
    assert running.entered.wait(20)
    for sec in range(1, 11):
        running.live.enqueue(cloud(scan, sec))
    assert running.live.busy_s() > 0
    dropped = running.live.health.dropped
    assert dropped >= 6
    running.free.set()
    for _ in range(11 - dropped):
        assert running.came.acquire(timeout=20)
    running.end()
    seconds = [stamp.sec for stamp, _ in running.answers]
    assert seconds[0] == 0 and seconds[-1] == 10 and seconds == sorted(seconds)


def test_reflectances_take_the_scale_of_the_first_scans(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    running, detector = Running(tiny_bundle), Detector(tiny_bundle, threads=1)
    bright = scan.copy()
    bright[:, 3] *= 255 / scan[:, 3].max()
    found = running.ask(cloud(bright))
    running.end()
    bright[:, 3] /= 255
    assert isinstance(found, Detections)
    np.testing.assert_array_equal(found.boxes, detector(bright).boxes)
    assert running.events == [{"event": "reflectance_scale", "scale": 255.0}]


def test_tracks_keep_identities(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    running = Running(tiny_bundle, tracker=Tracker(birth_score=0.0, report_score=0.0, death_score=0.0))
    first, second = running.ask(cloud(scan, 10)), running.ask(cloud(scan, 11))
    running.end()
    assert isinstance(first, Tracks) and isinstance(second, Tracks) and len(first)
    assert set(first.track_ids) & set(second.track_ids)


def test_the_mounting_is_taken_from_the_transforms_when_there_are_some(
    tiny_bundle: Path, scan: NDArray[np.float32]
) -> None:
    pose, asked = np.eye(4), threading.Event()
    pose[2, 3] = 1.5
    known: dict[str, NDArray[np.float64]] = {}

    def pose_of(frame: str) -> NDArray[np.float64] | None:
        asked.set()
        return known.get(frame)

    running = Running(tiny_bundle, ScanSettings(sensor_height=0.25), pose_of=pose_of)
    running.live.enqueue(cloud(scan, 1, "roof"))
    assert asked.wait(20)
    known["roof"] = pose
    while not any(one["event"] == "transform" for one in running.events):
        assert running.thread.is_alive()
    running.ask(cloud(scan, 2, "roof"))
    running.live.enqueue(cloud(scan, 3, "bumper"))
    running.end()
    assert np.array(running.mountings[-1].pose) == pytest.approx(pose)
    assert running.mountings[-1].sensor_height_m == 0.25
    events = [one["event"] for one in running.events if one["event"] != "reflectance_scale"]
    assert events == ["waiting", "transform", "unreadable"]
    assert running.live.health.error_text is not None and "bumper" in running.live.health.error_text


def test_a_height_is_estimated_from_the_first_scans(tiny_bundle: Path) -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-20, 20, (20_000, 2)), np.full(20_000, -1.4), np.full(20_000, 0.3)])
    running = Running(tiny_bundle, ScanSettings(sensor_height="auto"))
    while not running.came.acquire(timeout=0.02):
        running.live.enqueue(cloud(ground))
        assert running.thread.is_alive()
    running.end()
    assert running.mountings[-1].sensor_height_m == pytest.approx(1.4, abs=0.05)


def test_a_node_can_end_before_it_knows_the_mounting(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    for clouds in ([], [cloud(scan)]):
        running = Running(tiny_bundle, pose_of=lambda frame: None)
        for one in clouds:
            running.live.enqueue(one)
        running.end()
        assert running.error is None and not running.answers


def test_what_ends_the_detector_is_told(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    running = Running(tiny_bundle)

    def fail(*_: object) -> None:
        raise ScanError("full")

    running.live._answer = fail
    running.live.enqueue(cloud(scan))
    running.thread.join(timeout=20)
    assert isinstance(running.error, ScanError)
    assert running.live.health.status("/points", 1) == (ERROR, "full")


def test_diagnostics_say_what_is_wrong(tiny_bundle: Path, scan: NDArray[np.float32]) -> None:
    live = LiveDetection(
        lambda _: Detector(tiny_bundle, threads=1), ScanSettings(), lambda *_: None, lambda *_, **__: None
    )
    health = live.health
    health.count_received()
    assert health.status("/points", 1) == (OK, "every scan is answered")
    assert health.status("/points", 0) == (WARN, "nobody publishes /points")
    health.dropped += 2
    assert health.status("/points", 1)[0] == WARN and health.status("/points", 1)[0] == OK
    health._last_message_s -= 10
    assert health.status("/points", 1) == (WARN, "no scan on /points for 10 s")


def test_axes_beside_a_frame_are_refused(tiny_bundle: Path) -> None:
    with pytest.raises(ConfigError, match="--frame"):
        Running(tiny_bundle, ScanSettings(axes="y-forward"), pose_of=lambda frame: None)


@pytest.mark.parametrize(
    ("offered", "qos", "chosen"),
    [
        ([], "auto", None),
        (["reliable"], "auto", "reliable"),
        (["reliable", "best_effort"], "auto", "best_effort"),
        (["best_effort"], "auto", "best_effort"),
        (["reliable"], "best_effort", "best_effort"),
        ([], "reliable", "reliable"),
    ],
)
def test_reliability_follows_the_publishers(offered: list[str], qos: Any, chosen: str | None) -> None:
    assert reliability(offered, qos) == chosen


@pytest.mark.parametrize("wrong", [{"qos": "best"}, {"log_every": 0}])
def test_wrong_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        NodeSettings(topic="/points", reading=ScanSettings(), **wrong)


@pytest.mark.parametrize("is_abstract", [False, True])
def test_messages_arrive_on_the_socket(tmp_path: Path, is_abstract: bool) -> None:
    name = f"asca-{os.getpid()}" if is_abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(f"\0{name}" if is_abstract else name)
        environment = {"NOTIFY_SOCKET": f"@{name}" if is_abstract else name, "WATCHDOG_USEC": "3000000"}
        systemd = Systemd(environment)
        systemd.ready("warmed up")
        systemd.alive("5 scans")
        systemd.stopping()
        heard = [listener.recv(1000).decode().splitlines() for _ in range(3)]
    assert heard == [["READY=1", "STATUS=warmed up"], ["WATCHDOG=1", "STATUS=5 scans"], ["STOPPING=1"]]
    assert systemd.watchdog_s == 3.0


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"NOTIFY_SOCKET": "/nobody", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"},  # of another process
        {"NOTIFY_SOCKET": "/nobody", "WATCHDOG_USEC": "0"},
        {"NOTIFY_SOCKET": "/nobody", "WATCHDOG_USEC": "soon"},
    ],
)
def test_where_nobody_watches_nothing_is_told(environment: dict[str, str]) -> None:
    systemd = Systemd(environment)
    systemd.ready("well")
    assert systemd.watchdog_s is None
