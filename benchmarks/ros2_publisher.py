"""Latency of `asca ros2`: a process that publishes clouds on /points and times the returned boxes.

    asca ros2 --topic /points                                        # in another terminal
    python -m benchmarks.ros2_publisher --scans data/around/training/velodyne --count 600 --qos reliable

Latencies are from the call that publishes a scan to the arrival of its boxes in the same process. Prints JSON. Both
processes need ROS 2 (tests/requirements-ros2.txt); best effort needs FASTDDS_DEFAULT_PROFILES_FILE, see
docs/LIVE.md.
"""

import array
import json
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from asca_pillars.cli.run_command import run_command
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan

_DISCOVERY_S = 20.0
_LAST_ANSWERS_S = 5.0


def main(
    qos: Annotated[Literal["reliable", "best_effort"], typer.Option(help="Reliability that is offered.")] = "reliable",
    count: Annotated[int, typer.Option(help="Scans to publish.")] = 600,
    rate: Annotated[float, typer.Option(help="Scans per second.")] = 10.0,
    points: Annotated[int, typer.Option(help="Points of a scan; a smaller scan begins again.")] = 120_000,
    scans: Annotated[Path | None, typer.Option(help="Folder of scans, in turn. Default: points by chance.")] = None,
) -> None:
    """Publish, listen, and print the stamps and frames of the answers, latencies and the node's diagnostics."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import PointCloud2, PointField
    from visualization_msgs.msg import MarkerArray

    rclpy.init()
    node = rclpy.create_node("sensor")
    profile = QoSProfile(depth=10, reliability=getattr(ReliabilityPolicy, qos.upper()))
    publisher = node.create_publisher(PointCloud2, "/points", profile)
    answers: list[tuple[int, str]] = []
    statuses: list[str] = []
    published_s: dict[int, float] = {}
    latencies_ms: list[float] = []

    def answered(message: Any) -> None:
        header = message.markers[0].header
        latencies_ms.append(1e3 * (time.monotonic() - published_s[header.stamp.sec]))
        answers.append((header.stamp.sec, header.frame_id))

    node.create_subscription(MarkerArray, "/asca/markers", answered, 10)
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: statuses.append(m.status[0].message), 10)
    cloud = PointCloud2(height=1, width=points, point_step=16, row_step=16 * points)
    cloud.fields = [PointField(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyzi")]
    cloud.header.frame_id = "lidar"
    contents = _contents(scans, points)

    end = time.monotonic() + _DISCOVERY_S
    while not (publisher.get_subscription_count() and node.count_publishers("/asca/markers")):
        rclpy.spin_once(node, timeout_sec=0.05)
        if time.monotonic() > end:
            break
    due = time.monotonic()
    for number in range(1, count + 1):
        cloud.header.stamp.sec = number
        cloud.data = contents[number % len(contents)]
        published_s[number] = time.monotonic()
        publisher.publish(cloud)
        due += 1.0 / rate
        while (left := due - time.monotonic()) > 0:
            rclpy.spin_once(node, timeout_sec=left)
    end = time.monotonic() + _LAST_ANSWERS_S
    while len(answers) < count and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
    figures: dict[str, Any] = {"published": count, "answered": len(answers), "in_order": answers == sorted(answers)}
    if latencies_ms:
        p50, p95, p99, most = np.percentile(latencies_ms, [50, 95, 99, 100]).round(1).tolist()
        figures["latency_ms"] = {"p50": p50, "p95": p95, "p99": p99, "max": most}
    print(json.dumps({"figures": figures, "answers": answers, "statuses": statuses}))
    rclpy.shutdown()


def _contents(folder: Path | None, points: int) -> "list[array.array[int]]":
    """Return the bytes of the clouds."""
    if folder is None:
        clouds = [np.random.default_rng(0).uniform([0, -20, -2, 0], [40, 20, 1, 1], (points, 4))]
    else:
        clouds = [np.resize(read_scan(path).points, (points, 4)) for path in find_scans(folder)[:20]]
    return [array.array("B", cloud.astype(np.float32).tobytes()) for cloud in clouds]


if __name__ == "__main__":
    run_command(main)
