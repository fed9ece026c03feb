"""`asca detect`: scans in, tables, pictures and KITTI text out."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.commands.options import (
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
    SensorHeightOption,
    ThreadsOption,
)
from asca_pillars.errors import ConfigError, ScanError

TIMED_FRAMES = 6  # at least so many are run, the first is left out: one frame alone times the warm-up


def detect(
    scans: ScansArgument = None,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for pictures and boxes.")] = Path("detections"),
    bundle: BundleOption = None,
    score: Annotated[
        float | None,
        typer.Option("--score", help="Report detections from this score on. Default: the bundle's, per class."),
    ] = None,
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
    cluster: ClusterOption = None,
) -> None:
    """Find cars, pedestrians and cyclists; write the boxes and a bird's-eye picture of each scan.

    OUT/NAME.json holds the boxes of one scan in the scan's own frame, OUT/detections.jsonl those of the whole run, one
    line per scan. In a KITTI folder NAME.txt is KITTI text, and the boxes are drawn on the camera image. Labels beside
    the scans (KITTI's label_2/, or a dataset.yaml above them) are drawn in white.

    A scan that cannot be read is named and left out; the others are detected, and the exit code is 2.

    With --cluster only OUT/detections.jsonl is written, and the same command goes on where a broken run stopped.

    Examples:

    asca detect drive1/ drive2/ --out results --no-pictures

    asca detect sweeps/ --around --axes y-forward --sensor-height auto

    asca detect /mnt/archive --out /mnt/boxes --cluster local
    """
    import logging
    import sys

    from rich.console import Console
    from rich.progress import track

    from asca_deploy import sample_scan_path
    from asca_deploy.auto import summary
    from asca_pillars.commands import detect_tables as show
    from asca_pillars.commands.detect_files import ResultWriter
    from asca_pillars.commands.models import open_detector
    from asca_pillars.commands.scan_input import ScanInput, scan_settings
    from asca_pillars.data.scans.find_scans import name_scans

    console = Console(markup=False)
    logging.getLogger("asca_deploy").setLevel(logging.ERROR)  # its warnings are printed below, with the scan's name
    named = name_scans(scans or [sample_scan_path()])
    settings = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    scan_input = ScanInput(settings, [path for path, _ in named])
    options = RuntimeOptions(bundle=bundle, provider=provider, precision=precision, threads=threads)
    if cluster is not None:
        from asca_pillars.commands.detect_archive import detect_archive

        if pictures:
            raise ConfigError("--pictures: are not drawn with --cluster; leave one of them out")
        paths = [path for path, _ in named]
        detect_archive(paths, scan_input, settings, options, out, score=score, around=around, address=cluster)
        return
    detector = open_detector(options, score, scan_input.mounting, around=around)
    if detector.candidates:
        console.print(summary(detector.runs_on, detector.candidates), soft_wrap=True)
    results: list[show.Result] = []
    unreadable = 0
    with ResultWriter(out, pictures=pictures is not False) as write:
        for path, name in track(named, "Detecting", console=console, disable=len(named) == 1):
            try:
                scan = scan_input.read(path)
                detections = detector(scan.points)
            except (ScanError, OSError) as error:
                if len(named) == 1:
                    raise
                unreadable += 1
                print(f"asca: {error}", file=sys.stderr)
                continue
            results.append(show.Result(path, scan.notes, detections.labels, detections.report))
            write(path, name, scan, detections)
    if not results:
        raise ScanError(f"none of the {len(named)} scans can be read")
    console.print(show.boxes(path, detections) if len(named) == 1 else show.scans(results, detector.spec.class_names))
    for line in (*scan_input.said, *show.notes(results), *write.remarks[:1]):
        console.print(line, style="yellow", soft_wrap=True)
    reports = [result.report for result in results]
    while len(reports) < TIMED_FRAMES:
        reports.append(detector(scan.points).report)
    console.print(show.timing(reports[1:], detector))
    console.print(f"Results: {out}/")
    if unreadable:
        raise ScanError(f"{unreadable} of {len(named)} scans could not be read; they are named above")
