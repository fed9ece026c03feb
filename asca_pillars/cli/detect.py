"""`asca detect`: boxes of scans or a recording as tables, pictures, KITTI text and tracks."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from asca_pillars.base.errors import ConfigError, PartialError
from asca_pillars.cli.options import (
    AxesOption,
    BundleOption,
    ClusterOption,
    ColumnsOption,
    PoseOption,
    PrecisionOption,
    ProviderOption,
    ReflectanceScaleOption,
    ScansOrRecordingArgument,
    ScoreOption,
    SensorHeightOption,
    ThreadsOption,
    TopicOption,
    VideoOption,
    VideoViewOption,
    ViewOption,
    read_scores,
    scan_settings,
)
from asca_pillars.data.importing.formats import TOOLS

if TYPE_CHECKING:
    from rich.console import Console

    from asca_deploy.detect_archive import ArchiveResult
    from asca_deploy.detect_scans import DetectedScans
    from asca_deploy.recordings.detect_recording import RecordingResult
    from asca_pillars.pictures.video import VideoView

TIMED_FRAMES = 6  # least number of frames; the first one, the warm-up, is left out


def detect(
    scans: ScansOrRecordingArgument = None,
    *,
    bundle: BundleOption = None,
    around: ViewOption = None,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    topic: TopicOption = None,
    frame: Annotated[
        str | None,
        typer.Option(
            "--frame",
            help="Of a recording: the vehicle's frame (base_link), x forward, y left, z up; points and boxes are taken "
            "into it by /tf_static. --sensor-height is then the height of that frame.",
            rich_help_panel="Recording",
        ),
    ] = None,
    track: Annotated[
        bool,
        typer.Option(
            "--track",
            help="In a recording, or a folder of scans in order: give boxes identities and velocities over time.",
            rich_help_panel="Recording",
        ),
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            help="Of a folder of scans: scans per second. Default: 10.",
            rich_help_panel="Recording",
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            "--times",
            metavar="FILE",
            help="Of a folder of scans, instead of --rate: the seconds of each scan, one in a line.",
            rich_help_panel="Recording",
        ),
    ] = None,
    odometry: Annotated[
        str | None,
        typer.Option(
            "--odometry",
            help="With --track: the topic of the car's poses (nav_msgs/Odometry).",
            rich_help_panel="Recording",
        ),
    ] = None,
    foxglove: Annotated[
        Path | None,
        typer.Option(
            "--foxglove",
            help="Of a recording or a folder: also write the boxes as an MCAP for Foxglove.",
            rich_help_panel="Recording",
        ),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(
            "--rerun",
            help="Of a recording or a folder: also write scans and boxes as an .rrd for the rerun viewer.",
            rich_help_panel="Recording",
        ),
    ] = None,
    image_topic: Annotated[
        str | None,
        typer.Option(
            "--image-topic",
            help="Of a recording, with --rerun: the topic of the camera images. Default: the first one.",
            rich_help_panel="Recording",
        ),
    ] = None,
    calib: Annotated[
        Path | None,
        typer.Option(
            "--calib",
            help="Of a recording: a KITTI calibration; also write KITTI's tracking text.",
            rich_help_panel="Recording",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for pictures and boxes.", rich_help_panel="Output")
    ] = Path("detections"),
    score: ScoreOption = None,
    pictures: Annotated[
        bool | None,
        typer.Option(
            "--pictures/--no-pictures",
            help="Draw a bird's-eye picture of each scan; without, faster. Default: drawn, but not with --cluster.",
            rich_help_panel="Output",
        ),
    ] = None,
    video: VideoOption = None,
    video_view: VideoViewOption = "above",
    write: Annotated[
        str | None,
        typer.Option(
            "--write",
            metavar="FORMAT",
            help=f"Also write the boxes as labels to correct, to OUT/FORMAT: {', '.join(TOOLS)} (docs/LABELLING.md).",
            rich_help_panel="Output",
        ),
    ] = None,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Find cars, pedestrians and cyclists; write the boxes and a bird's-eye picture of each scan.

    OUT/NAME.json holds the boxes of one scan in the scan's own frame, OUT/detections.jsonl those of the whole run, one
    line per scan. In a KITTI folder NAME.txt is KITTI text, and the boxes are drawn on the camera image. Labels beside
    the scans (KITTI's label_2/, or a dataset.yaml above them) are drawn in white. OUT/index.html shows all pictures,
    sorted by scores and misses.

    A scan that cannot be read is named and left out; the others are detected, and the exit code is 3.

    A recording (.mcap, .db3, .bag, a rosbag2 folder, a .pcap of Ouster or Velodyne) is detected scan by scan;
    OUT/detections.jsonl has a line for each, with its time. After a kill the same command resumes.

    With --cluster only OUT/detections.jsonl is written, and the same command resumes a broken run.

    Examples:

    asca detect drive1/ drive2/ --out results --no-pictures

    asca detect my_scans/ --score Car=0.6 --score Pedestrian=0.4

    asca detect sweeps/ --axes y-forward --sensor-height auto

    asca detect drive.mcap --track --foxglove boxes.mcap

    asca detect drive.mcap --track --video drive.mp4 --video-view chase

    asca detect drive1/ --track --rate 10 --video drive.mp4 --rerun drive.rrd

    asca detect /mnt/archive --out /mnt/boxes --cluster local
    """
    import logging

    from rich.console import Console

    from asca_deploy import sample_scan_path
    from asca_deploy.open_model import RuntimeOptions
    from asca_pillars.cli.progress import Bars
    from asca_pillars.scans.recordings.recorded_scans import is_recording

    console = Console(markup=False)
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # its warnings are printed below, with the scan's name
    reading = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    options = RuntimeOptions(bundle=bundle, provider=provider, precision=precision, threads=threads)
    scores = read_scores(score)
    view = cast("VideoView", video_view)
    recordings = [path for path in scans or () if is_recording(path)]
    if write is not None:
        from asca_pillars.data.importing.tool_labels import require_unchanged

        if recordings:
            raise ConfigError(f"--write {write}: labels belong to scan files, and {recordings[0]} is a recording")
        require_unchanged(out, write)
    if recordings:
        _refuse_times(rate, times)
        if cluster is not None or len(scans or ()) > 1:
            raise ConfigError(f"{recordings[0]}: is a recording, which must be the only input, without --cluster")
        if pictures:
            raise ConfigError("--pictures: scans of a recording are not drawn; leave it out, or give --rerun FILE")
        if columns is not None:
            raise ConfigError(f"--columns {columns}: is for .bin files, and a recording names its fields; leave it out")
        from asca_deploy.recordings.detect_recording import detect_recording

        with Bars(console) as bars:
            recorded = detect_recording(
                recordings[0],
                out,
                topic=topic,
                frame=frame,
                track=track,
                odometry=odometry,
                calib=calib,
                foxglove=foxglove,
                rerun=rerun,
                image_topic=image_topic,
                video=video,
                video_view=view,
                options=options,
                reading=reading,
                score=scores,
                around=around,
                progress=bars,
                remark=bars.remark,
            )
        _print_recording(recorded, console)
        return
    if topic or frame or odometry or calib or image_topic:
        options_of = "--topic, --frame, --odometry, --image-topic and --calib"
        raise ConfigError(f"{options_of} need a recording (.mcap, .db3, .bag, .pcap)")
    if cluster is not None:
        from asca_deploy.detect_archive import detect_archive
        from asca_pillars.scans.find_scans import name_scans

        if video is not None or video_view != "above":
            option = f"--video-view {video_view}" if video is None else f"--video {video}"
            raise ConfigError(f"{option}: cannot be combined with --cluster; leave one of them out")
        if track or rate is not None or times or foxglove or rerun:
            raise ConfigError(
                "--track, --rate, --times, --foxglove and --rerun cannot be combined with --cluster; leave them out"
            )
        if pictures:
            raise ConfigError("--pictures: cannot be combined with --cluster; leave one of them out")
        paths = [scan.path for scan in name_scans(scans or [sample_scan_path()])]
        with Bars(console, transient=True) as bars:
            archive = detect_archive(
                paths,
                out,
                address=cluster,
                options=options,
                reading=reading,
                score=scores,
                around=around,
                progress=bars,
                remark=bars.remark,
            )
        _write_labels(out, write, console)
        _print_archive(archive, out, console)
        return
    from asca_deploy.detect_scans import detect_scans

    with Bars(console) as bars:
        result = detect_scans(
            scans or None,
            out,
            options=options,
            reading=reading,
            score=scores,
            around=around,
            pictures=pictures is not False,
            track=track,
            rate_hz=rate,
            times=times,
            foxglove=foxglove,
            rerun=rerun,
            video=video,
            video_view=view,
            progress=bars,
            failed=lambda line: print(f"asca: {line}", file=sys.stderr),
        )
    _write_labels(out, write, console)
    _print_scans(result, [path for path in (foxglove, rerun, video) if path is not None], out, console)


def _refuse_times(rate: float | None, times: Path | None) -> None:
    """Refuse options for the times of scans with inputs other than folders."""
    if rate is not None or times is not None:
        option = f"--rate {rate:g}" if rate is not None else f"--times {times}"
        raise ConfigError(f"{option}: is for folders of scans, and a recording has its times; leave it out")


def _write_labels(out: Path, name: str | None, console: "Console") -> None:
    """Write the boxes of the run that `out` holds as labels of a tool, if one was named."""
    if name is not None:
        from asca_deploy.result_files import RUN_FILE
        from asca_pillars.data.importing.tool_labels import write_prelabels

        console.print(f"Labels to correct: {write_prelabels(out / RUN_FILE, name, out)}/", soft_wrap=True)


def _print_scans(result: "DetectedScans", files: Sequence[Path], out: Path, console: "Console") -> None:
    """Print boxes or a line per scan, remarks and times; PartialError if some scans failed."""
    from asca_deploy.auto import summary
    from asca_pillars.cli import detect_tables as show
    from asca_pillars.cli.progress import print_remark

    detector = result.detector
    if detector.candidates:
        console.print(summary(detector.runs_on, detector.candidates), soft_wrap=True)
    asked = len(result) + result.unreadable
    is_single = asked == 1
    console.print(show.boxes(result[0].path, result[0].detections) if is_single else show.scans(result, detector.spec))
    for line in result.remarks:
        print_remark(console, line)
    reports = [scan.detections.report for scan in result]
    while len(reports) < TIMED_FRAMES:
        reports.append(detector(result.last_points).report)
    console.print(show.timing(reports[1:], detector))
    console.print(f"Results: {', '.join([f'{out}/', *map(str, files)])}", soft_wrap=True)
    if unwritten := len(result.failed) - result.unreadable:
        raise PartialError(f"results of {unwritten} of {asked} scans could not be written; they are named above")
    if result.unreadable:
        raise PartialError(f"{result.unreadable} of {asked} scans could not be read; they are named above")


def _print_recording(result: "RecordingResult", console: "Console") -> None:
    """Print counts and files; PartialError if parts of the recording could not be read."""
    boxes = ", ".join(f"{count} {name}" for name, count in result.boxes.items())
    console.print(f"{result.scans} scans, in all {boxes}", highlight=False)
    if result.cpu_ms_per_scan is not None:
        console.print(f"{result.cpu_ms_per_scan:.1f} ms of CPU per scan")
    console.print(f"Results: {', '.join(map(str, result.files))}", soft_wrap=True)
    if result.problems:
        raise PartialError("; ".join(result.problems))


def _print_archive(result: "ArchiveResult", out: Path, console: "Console") -> None:
    """Print counts; PartialError if some scans could not be read."""
    from asca_deploy.result_files import RUN_FILE, UNREADABLE_FILE

    detected, unreadable = result.counts
    if result.done_before:
        console.print(f"{result.done_before} scans were done by an earlier run", highlight=False)
    if result.repeats:
        console.print(f"{result.repeats} shards were restarted after their worker died", highlight=False)
    console.print(f"{detected} scans: {out / RUN_FILE}", highlight=False, soft_wrap=True)
    if unreadable:
        named = out / UNREADABLE_FILE
        raise PartialError(
            f"{unreadable} of {detected + unreadable} scans could not be read; they are named in {named}"
        )
