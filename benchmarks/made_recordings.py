"""Recordings of simulated sequences: the scans of `asca simulate --sequences` as an MCAP, a rosbag2 or a ROS 1 bag.

    python -m benchmarks.made_recordings data/drives drive.mcap
    python -m benchmarks.made_recordings data/drives drive_bag

A name without a suffix makes a rosbag2 folder (SQLite), one on .bag a ROS 1 bag. Scans are sensor_msgs/PointCloud2 with
x, y, z and intensity as float32 on /points, with the time stamps of the labels.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from asca_pillars.cli.run_command import run_command
from asca_pillars.data.boxes.box_split import BoxSplit

TOPIC, FRAME_ID = "/points", "lidar"
TYPE = "sensor_msgs/msg/PointCloud2"


def main(
    data: Annotated[Path, typer.Argument(help="Dataset of simulated sequences.")],
    out: Annotated[Path, typer.Argument(help="File *.mcap or *.bag, or a folder to be made.")],
) -> None:
    """Write all scans of the dataset, in the order of their times."""
    print(f"{write_recording(out, stamped_scans(data))} scans in {out}")


def stamped_scans(data: Path) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield time in nanoseconds and points (N, 4) of every scan."""
    split = BoxSplit(data)
    for frame_id in split.frame_ids:
        labels = json.loads((split.labels_path / f"{frame_id}.json").read_text(encoding="utf-8"))
        yield round(labels["time_s"] * 1e9), split.points(frame_id)


def write_recording(out: Path, scans: Iterator[tuple[int, NDArray[np.float32]]]) -> int:
    """Write scans, each with its time in nanoseconds and points (N, 4), in metres; how many there were."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    if out.suffix == ".mcap":
        return _write_mcap(out, scans)
    ros1 = out.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    count = 0
    with Writer1(out) if ros1 else Writer2(out, version=9) as writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        for time_ns, points in scans:
            message = point_cloud2(store, time_ns, points)
            data = store.serialize_ros1(message, TYPE) if ros1 else store.serialize_cdr(message, TYPE)
            writer.write(connection, time_ns, data)
            count += 1
    return count


def _write_mcap(out: Path, scans: Iterator[tuple[int, NDArray[np.float32]]]) -> int:
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = store.generate_msgdef(TYPE, ros_version=2)
    count = 0
    with out.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="asca-pillars")
        schema = writer.register_schema(TYPE, "ros2msg", definition.encode())
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for time_ns, points in scans:
            data = bytes(store.serialize_cdr(point_cloud2(store, time_ns, points), TYPE))
            writer.add_message(channel, time_ns, data, time_ns)
            count += 1
        writer.finish()
    return count


def point_cloud2(store: Any, time_ns: int, points: NDArray[np.float32]) -> Any:
    """Return points (N, 4), in metres, as a message of the type store."""
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    extra = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    field = types["sensor_msgs/msg/PointField"]
    return types[TYPE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME_ID, **extra),
        height=1,
        width=len(points),
        fields=[
            field(name=name, offset=4 * index, datatype=7, count=1)
            for index, name in enumerate(("x", "y", "z", "intensity"))
        ],
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(points),
        data=np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1),
        is_dense=True,
    )


if __name__ == "__main__":
    run_command(main)
