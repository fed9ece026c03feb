"""`asca ros2`: boxes for a live topic of point clouds."""

from typing import Annotated, cast

import typer

from asca_pillars.cli.options import (
    AroundOption,
    AxesOption,
    BundleOption,
    PoseOption,
    PrecisionOption,
    ProviderOption,
    ReflectanceScaleOption,
    ScoreOption,
    SensorHeightOption,
    ThreadsOption,
    read_scores,
    scan_settings,
)


def ros2(
    ros_args: Annotated[
        list[str] | None, typer.Argument(help="After --, arguments for ROS: -- --ros-args -r __ns:=/front")
    ] = None,
    *,
    topic: Annotated[
        str, typer.Option("--topic", help="Of the scans, sensor_msgs/PointCloud2.", rich_help_panel="Input")
    ] = "/points",
    qos: Annotated[
        str,
        typer.Option(
            "--qos",
            help="auto, best_effort or reliable. auto: reliable where all publishers are, else best_effort.",
            rich_help_panel="Input",
        ),
    ] = "auto",
    bundle: BundleOption = None,
    frame: Annotated[
        str | None,
        typer.Option(
            "--frame",
            help="The vehicle's frame (base_link), x forward, y left, z up: how the scans lie in it is taken from TF. "
            "--sensor-height is then the height of that frame.",
            rich_help_panel="Sensor",
        ),
    ] = None,
    around: AroundOption = False,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    track: Annotated[
        bool, typer.Option("--track", help="Give boxes identities and velocities over time.", rich_help_panel="Output")
    ] = False,
    score: ScoreOption = None,
    log_every: Annotated[
        int,
        typer.Option("--log-every", help="Scans between two lines of figures in the log.", rich_help_panel="Output"),
    ] = 100,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
) -> None:
    """Answer every scan of a ROS 2 topic with boxes, until SIGINT or SIGTERM.

    Published are ~/markers (visualization_msgs/MarkerArray), ~/detections (vision_msgs/Detection3DArray, where that
    package is installed) and /diagnostics, with the stamp and the frame of the scan. While the detector works, the
    oldest scan that waits gives way to later ones and is counted. The log is lines of JSON on standard output.

    Needs ROS 2 (rclpy) in this Python. docs/LIVE.md says more.

    Examples:

    asca ros2 --topic /ouster/points --around --sensor-height auto --track

    asca ros2 --topic /velodyne_points --frame base_link --sensor-height 0.35 --score Car=0.4
    """
    import logging
    import os

    from asca_deploy.detector import Detector
    from asca_deploy.open_model import RuntimeOptions, open_detector, track_thresholds
    from asca_deploy.ros2.node import NodeSettings, Qos, run_node
    from asca_deploy.tracker import Tracker
    from asca_pillars.scans.mounting import Mounting

    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # its warnings are in the diagnostics
    reading = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=None
    )
    settings = NodeSettings(
        topic=topic, reading=reading, qos=cast("Qos", qos), frame=frame, log_every=log_every, ros_args=ros_args or ()
    )
    options = RuntimeOptions(bundle=bundle, provider=provider, precision=precision, threads=threads)
    scores = read_scores(score)
    births, weak = track_thresholds(bundle, scores)
    least = weak if track else scores

    def opened(mounting: Mounting) -> Detector:
        return open_detector(options, least, mounting, around=around)

    run_node(settings, opened, Tracker(birth_score=births) if track else None)
    os._exit(0)  # everything is closed; on a busy machine the libraries would take seconds to unload
