"""A process that publishes clouds on /points at 10 Hz and prints what comes back, as JSON.

python publisher.py RELIABLE 20 [SEGMENT]
"""

import array
import json
import sys
import time
from typing import Any


def main() -> None:
    import numpy as np
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import PointCloud2, PointField
    from visualization_msgs.msg import MarkerArray

    kind, count, points = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    rclpy.init()
    node = rclpy.create_node("sensor")
    publisher = node.create_publisher(
        PointCloud2, "/points", QoSProfile(depth=10, reliability=getattr(ReliabilityPolicy, kind))
    )
    answers: list[tuple[int, str]] = []
    statuses: list[str] = []

    def answered(message: Any) -> None:
        header = message.markers[0].header
        answers.append((header.stamp.sec, header.frame_id))

    node.create_subscription(MarkerArray, "/asca/markers", answered, 10)
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: statuses.append(m.status[0].message), 10)
    cloud = PointCloud2(height=1, width=points, point_step=16, row_step=16 * points)
    cloud.fields = [PointField(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyzi")]
    values = np.random.default_rng(0).uniform([0, -20, -2, 0], [40, 20, 1, 1], (points, 4)).astype(np.float32)
    cloud.data = array.array("B", values.tobytes())
    cloud.header.frame_id = "lidar"
    end = time.monotonic() + 20
    while not (publisher.get_subscription_count() and node.count_publishers("/asca/markers")):
        rclpy.spin_once(node, timeout_sec=0.05)
        if time.monotonic() > end:
            break
    for number in range(1, count + 1):
        cloud.header.stamp.sec = number
        publisher.publish(cloud)
        due = time.monotonic() + 0.1
        while (left := due - time.monotonic()) > 0:
            rclpy.spin_once(node, timeout_sec=left)
    end = time.monotonic() + 5
    while len(answers) < count and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
    print(json.dumps({"answers": answers, "statuses": statuses}))
    rclpy.shutdown()


if __name__ == "__main__":
    main()
