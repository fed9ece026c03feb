"""`asca detect`: scans or a recording in, tables, pictures, KITTI text and tracks out."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.errors import ConfigError
from asca_pillars.cli.options import (
    AroundOption,
    AxesOption,
    BundleOption,
    ClusterOption,
    ColumnsOption,
    PoseOption,
    PrecisionOption,
    ProviderOption,
    ReflectanceScaleOption,
    RuntimeOptions,
    ScansArgument,
    ScoreOption,
    SensorHeightOption,
    ThreadsOption,
    VideoOption,
    VideoViewOption,
    read_scores,
)


def detect(
    scans: ScansArgument = None,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for pictures and boxes.")] = Path("detections"),
    bundle: BundleOption = None,
    score: ScoreOption = None,
    pictures: Annotated[
        bool | None,
        typer.Option(
            "--pictures/--no-pictures",
            help="Draw a bird's-eye picture of each scan; without, faster. Default: drawn, but not with --cluster.",
        ),
    ] = None,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
    around: AroundOption = False,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    topic: Annotated[
        str | None, typer.Option("--topic", help="Of a recording: the topic of its scans. Default: the only one.")
    ] = None,
    track: Annotated[
        bool, typer.Option("--track", help="In a recording: give boxes identities and velocities over time.")
    ] = False,
    odometry: Annotated[
        str | None,
        typer.Option("--odometry", help="With --track: the topic of the car's poses (nav_msgs/Odometry)."),
    ] = None,
    foxglove: Annotated[
        Path | None, typer.Option("--foxglove", help="Of a recording: also write the boxes as an MCAP for Foxglove.")
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option("--rerun", help="Of a recording: also write scans and boxes as an .rrd for the rerun viewer."),
    ] = None,
    video: VideoOption = None,
    video_view: VideoViewOption = "above",
    calib: Annotated[
        Path | None,
        typer.Option("--calib", help="Of a recording: a KITTI calibration; also write KITTI's tracking text."),
    ] = None,
    cluster: ClusterOption = None,
) -> None:
    """Find cars, pedestrians and cyclists; write the boxes and a bird's-eye picture of each scan.

    OUT/NAME.json holds the boxes of one scan in the scan's own frame, OUT/detections.jsonl those of the whole run, one
    line per scan. In a KITTI folder NAME.txt is KITTI text, and the boxes are drawn on the camera image. Labels beside
    the scans (KITTI's label_2/, or a dataset.yaml above them) are drawn in white. OUT/index.html shows all pictures,
    sorted by scores and misses.

    A scan that cannot be read is named and left out; the others are detected, and the exit code is 2.

    A recording (.mcap, .db3, .bag, a rosbag2 folder) is detected scan by scan; OUT/detections.jsonl has a line for
    each, with its time. After a kill the same command goes on where it was.

    With --cluster only OUT/detections.jsonl is written, and the same command goes on where a broken run stopped.

    Examples:

    asca detect drive1/ drive2/ --out results --no-pictures

    asca detect my_scans/ --score Car=0.6 --score Pedestrian=0.4

    asca detect sweeps/ --around --axes y-forward --sensor-height auto

    asca detect drive.mcap --track --foxglove boxes.mcap

    asca detect drive.mcap --track --video drive.mp4 --video-view chase

    asca detect /mnt/archive --out /mnt/boxes --cluster local
    """
    import logging

    from rich.console import Console

    from asca_deploy import sample_scan_path
    from asca_deploy.auto import summary
    from asca_pillars.cli.detect_files import ResultWriter
    from asca_pillars.cli.detect_scans import detect_scans
    from asca_pillars.cli.detect_video import video_options
    from asca_pillars.cli.models import open_detector
    from asca_pillars.cli.scan_input import ScanInput, scan_settings
    from asca_pillars.data.boxes.detector_scope import detector_scope
    from asca_pillars.scans.find_scans import name_scans
    from asca_pillars.scans.recordings.open_recording import is_recording

    console = Console(markup=False)
    logging.getLogger("asca_deploy").setLevel(logging.ERROR)  # its warnings are printed below, with the scan's name
    reading = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    options = RuntimeOptions(bundle=bundle, provider=provider, precision=precision, threads=threads)
    scores = read_scores(score)
    view = video_options(video, video_view, [*(scans or ()), *([] if calib is None else [calib])])
    recordings = [path for path in scans or () if is_recording(path)]
    if recordings:
        if cluster is not None or len(scans or ()) > 1:
            raise ConfigError(f"{recordings[0]}: is a recording; give one alone, without --cluster")
        if pictures:
            raise ConfigError("--pictures: scans of a recording are not drawn; leave it out, or give --rerun FILE")
        if columns is not None:
            raise ConfigError(f"--columns {columns}: is for .bin files, and a recording names its fields; leave it out")
        from asca_pillars.cli.detect_recording import RecordingTask, detect_recording

        task = RecordingTask(
            path=recordings[0],
            out=out,
            score=scores,
            around=around,
            topic=topic,
            track=track,
            odometry=odometry,
            calib=calib,
            foxglove=foxglove,
            rerun=rerun,
            video=video,
            video_view=view,
        )
        detect_recording(task, reading, options, console)
        return
    if topic or track or odometry or foxglove or rerun or calib:
        options_of_recordings = "--topic, --track, --odometry, --foxglove, --rerun and --calib"
        raise ConfigError(f"{options_of_recordings} need a recording (.mcap, .db3, .bag)")
    named = name_scans(scans or [sample_scan_path()])
    scan_input = ScanInput(reading, [path for path, _ in named])
    if cluster is not None:
        from asca_pillars.cli.detect_archive import detect_archive

        if video is not None:
            raise ConfigError(f"--video {video}: is not made with --cluster; leave one of them out")
        if pictures:
            raise ConfigError("--pictures: are not drawn with --cluster; leave one of them out")
        paths = [path for path, _ in named]
        detect_archive(paths, scan_input, reading, options, out, score=scores, around=around, address=cluster)
        return
    detector = open_detector(options, scores, scan_input.mounting, around=around)
    if detector.candidates:
        console.print(summary(detector.runs_on, detector.candidates), soft_wrap=True)
    scope = detector_scope(detector.spec, around=around)
    names = [name for _, name in named]
    writer = ResultWriter(out, names, pictures=pictures is not False, scope=scope, video=video, video_view=view)
    detect_scans(named, scan_input, detector, writer, console)
