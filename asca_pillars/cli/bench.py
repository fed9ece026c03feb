"""`asca bench`: time of every stage, with the machine's properties."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.cli.options import (
    AroundOption,
    AxesOption,
    BundleOption,
    ColumnsOption,
    JsonOption,
    PoseOption,
    PrecisionOption,
    ProviderOption,
    ReflectanceScaleOption,
    ScansOrRecordingArgument,
    SensorHeightOption,
    ThreadsOption,
    TopicOption,
    scan_settings,
)

MOST_SCANS = 100  # held in memory, and run in every round


def bench(
    scans: ScansOrRecordingArgument = None,
    *,
    bundle: BundleOption = None,
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            "--compare",
            help="Another bundle, run in turn with the first on the same scans: how many times as fast it is, with "
            "quartiles over the rounds. Such ratios hold on a busy machine, times do not. Repeatable.",
            rich_help_panel="Input",
        ),
    ] = None,
    around: AroundOption = False,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    topic: TopicOption = None,
    rounds: Annotated[
        int,
        typer.Option(
            "--rounds",
            min=1,
            help="Timed passes over the scans, for each table.",
            metavar="N",
            rich_help_panel="Measurements",
        ),
    ] = 30,
    matrix: Annotated[
        bool,
        typer.Option(
            "--matrix",
            help="Every provider, precision and number of threads in turn (of the --compare bundles too): speed, and "
            "how far the boxes are from float32 on the stock CPU provider. What cannot run says why.",
            rich_help_panel="Measurements",
        ),
    ] = False,
    scaling: Annotated[
        bool,
        typer.Option(
            "--scaling",
            help="Each stage at 1,000 to 1,000,000 points, made from the first scan.",
            rich_help_panel="Measurements",
        ),
    ] = False,
    stream: Annotated[
        bool,
        typer.Option(
            "--stream",
            help="Scans per second and latency of detector.stream(scans) beside single calls.",
            rich_help_panel="Measurements",
        ),
    ] = False,
    cold: Annotated[
        bool,
        typer.Option(
            "--cold",
            help="New processes: seconds to the first boxes, and the peak memory of asca detect.",
            rich_help_panel="Measurements",
        ),
    ] = False,
    deadline: Annotated[
        float | None,
        typer.Option(
            "--deadline",
            min=0.001,
            help="Milliseconds, such as 100: print the share of scans that take longer.",
            rich_help_panel="Output",
            metavar="MS",
        ),
    ] = None,
    late_share: Annotated[
        float,
        typer.Option(
            "--late",
            min=0,
            max=1,
            help="With --deadline: exit with code 1 if a larger share takes longer.",
            rich_help_panel="Output",
            metavar="SHARE",
        ),
    ] = 1.0,
    json: JsonOption = None,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
) -> None:
    """Time every stage from points to boxes: p50, p95, p99, FPS, cold start, memory, and the machine it ran on.

    Two lines say where to look for more speed: what is spent outside the graphs, and the roofline, the share of the
    machine's measured matrix multiplications per second that the backbone reaches. Of more than 100 scans some are
    timed, evenly spaced; of a recording the first 100 with points.

    Example: asca bench my_scans/ --matrix --compare fast
    """
    import logging
    import os
    import sys

    from rich.console import Console

    from asca_deploy import sample_scan_path
    from asca_deploy.manifest import load_bundle
    from asca_deploy.open_model import RuntimeOptions, open_detector
    from asca_pillars.base.errors import ConfigError, ScanError
    from asca_pillars.base.files import require_writable, write_json
    from asca_pillars.base.installation import require
    from asca_pillars.base.own_files import json_object, require_own_file
    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.bench_parts import Parts, measure_parts, named_bundles
    from asca_pillars.cli.progress import Bars, print_remark
    from asca_pillars.scans.find_scans import name_scans
    from asca_pillars.scans.recordings.recorded_scans import RecordedScans, is_recording, open_recording
    from asca_pillars.scans.scan_settings import ScanInput

    # A pipe has no width, and the tables are wider than rich's default of 80 columns.
    piped = not sys.stdout.isatty() and "COLUMNS" not in os.environ
    console = Console(markup=False, highlight=False, width=120 if piped else None)
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # no warnings of unusual scans, as in `asca detect`
    if around and (matrix or cold):
        raise ConfigError("--matrix and --cold time single passes; leave them out, or --around")
    settings = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    if recordings := [path for path in scans or () if is_recording(path)]:
        if len(scans or ()) > 1:
            raise ConfigError(f"{recordings[0]}: is a recording, which must be the only input")
        require("recordings")
        with Bars(Console(markup=False), transient=True) as bars:
            recording = open_recording(recordings[0], Reporter(bars))
        recorded = RecordedScans(recording, recording.point_cloud_topic(topic), settings.reflectance_scale)
        mounting, notes = recorded.mounting(settings)
        points = [scan.points for scan in recorded.first(MOST_SCANS)]
        if not points:
            raise ScanError(f"{recordings[0]}: none of the first scans of {recorded.topic.name} has points")
        notes.append(f"timing the first {len(points)} scans with points")
    else:
        if topic is not None:
            raise ConfigError(f"--topic {topic}: is for recordings (.mcap, .db3, .bag); leave it out")
        paths = [scan.path for scan in name_scans(scans or [sample_scan_path()])]
        scan_input = ScanInput(settings, paths)
        mounting, notes = scan_input.mounting, scan_input.notes
        timed = paths[:: -(-len(paths) // MOST_SCANS)]
        if len(timed) < len(paths):
            notes.append(f"timing {len(timed)} of the {len(paths)} scans, evenly spaced")
        points = [scan_input.read(path).points for path in timed]
    for line in notes:
        print_remark(console, line)
    if scaling and not len(points[0]):
        raise ScanError("the first scan has no points to take fewer or more of; give another for --scaling")
    bundles = named_bundles([bundle, *(compare or ())])
    for folder in bundles.values():
        load_bundle(folder)  # a damaged one is reported now and not after minutes
    report_json = "asca bench", json_object("fps", "stages_ms", "runs_on", "graphs_sha256")
    require_writable(json, *report_json)
    options = RuntimeOptions(bundle=bundle, provider=provider, precision=precision, threads=threads)
    detector = open_detector(options, mounting=mounting, around=around)
    parts = Parts(compare=bool(compare), matrix=matrix, scaling=scaling, stream=stream, cold=cold, deadline_ms=deadline)
    result = measure_parts(detector, points, rounds, parts, bundles, console)
    if json is not None:
        require_own_file(json, *report_json)
        write_json(json, result)
    if deadline is not None and result["late_share"] > late_share:
        raise typer.Exit(1)
