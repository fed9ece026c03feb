"""Launch the detector as a ROS 2 node.

ros2 launch asca.launch.py topic:=/ouster/points arguments:="--around --track"
"""

import shlex
from typing import Any

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration


def _node(context: Any) -> list[ExecuteProcess]:
    values = {name: LaunchConfiguration(name).perform(context) for name in ("asca", "topic", "arguments")}
    command = [values["asca"], "ros2", "--topic", values["topic"], *shlex.split(values["arguments"])]
    return [ExecuteProcess(cmd=command, output="screen", respawn=True, respawn_delay=2.0)]


def generate_launch_description() -> LaunchDescription:
    """The node as a process that is started again when it ends."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("asca", default_value="asca", description="path of the command"),
            DeclareLaunchArgument("topic", default_value="/points", description="of sensor_msgs/PointCloud2"),
            DeclareLaunchArgument("arguments", default_value="", description="further options of asca ros2"),
            OpaqueFunction(function=_node),
        ]
    )
