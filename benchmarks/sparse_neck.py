"""Comparison of a detector with a sparse neck and one with a dense neck: random weights, points to boxes, in turn.

    python -m benchmarks.sparse_neck scans/                     # the paper's width in 8 bits; default: the sample scan
    python -m benchmarks.sparse_neck scans/ --float32 --keep bundles/

Once with whole scans and once with the camera's field of view. Ratios of a round's medians hold on a busy
machine too, times do not. `asca bench scans/ --bundle bundles/asca_sim_sparse_int8` shows the time by stage of a
bundle that was kept.
"""

import logging
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_deploy import Detector, sample_scan_path
from asca_deploy.benchmark import Comparison, compare
from asca_deploy.benchmark.speed_comparison import Run
from asca_deploy.benchmark.timing import Track, silently
from asca_pillars.base.system import cpu_model, default_threads, package_versions
from asca_pillars.cli.bench_parts import comparison_table
from asca_pillars.cli.run_command import run_command
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan
from benchmarks.host_path import camera_view
from benchmarks.random_weights import Neck, export_random_weights, random_weights

Scans: TypeAlias = Sequence[NDArray[np.float32]]

NECKS: tuple[Neck, ...] = ("dense", "sparse")


def main(
    scans: Annotated[list[Path] | None, typer.Argument(help="Scans, or folders of them. Default: the sample.")] = None,
    *,
    config: Annotated[str, typer.Option(help="YAML, or the name of one that ships.")] = "asca_sim",
    float32: Annotated[bool, typer.Option("--float32", help="Not in 8 bits.")] = False,
    threads: Annotated[int | None, typer.Option(help="Of both. Default: the physical cores.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="In which both take a turn.")] = 10,
    keep: Annotated[
        Path | None, typer.Option(help="Folder for the bundles; those that are there already are not exported again.")
    ] = None,
) -> None:
    """Export both, in minutes, and print a table for each view."""
    console = Console(markup=False, highlight=False)
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # any scan may be given
    threads = default_threads() if threads is None else threads
    loaded = [read_scan(path).points for given in scans or [sample_scan_path()] for path in find_scans(given)]
    with tempfile.TemporaryDirectory() as work, console.status("Exporting") as status:
        bundles = export_both(config, keep or Path(work), int8=not float32, progress=status.update)
        detectors: dict[str, Detector] = {neck: Detector(bundle, threads=threads) for neck, bundle in bundles.items()}
        status.stop()

        def bar(count: int, what: str) -> Iterable[int]:
            return track(range(count), what, console=console, transient=True)

        for view, found in compare_views(detectors, loaded, rounds, bar).items():
            console.print(f"{view}, {len(loaded)} scan(s)")
            console.print(comparison_table(found))
    gmac = ", ".join(f"{neck} {each.bundle.backbone_gmac:.1f}" for neck, each in detectors.items())
    versions = package_versions()
    console.print(
        f"{config} with random weights, {detectors['sparse'].bundle.precision}, GMAC on the sample: {gmac}; "
        f"{cpu_model()}, {threads} threads, onnxruntime {versions['onnxruntime']}",
        soft_wrap=True,
    )


def export_both(
    config: str, folder: Path, *, int8: bool, progress: Callable[[str], None] = lambda _: None
) -> dict[Neck, Path]:
    """Export bundles of the configuration with either neck to `folder`; existing ones are kept."""
    points, bundles = read_scan(sample_scan_path()).points, {}
    for neck in NECKS:
        bundles[neck] = folder / f"{Path(config).stem}_{neck}_{'int8' if int8 else 'float32'}"
        if not bundles[neck].exists():
            model = random_weights(config, points, neck)
            export_random_weights(model, points, bundles[neck], int8=int8, progress=progress)
    return bundles


def compare_views(
    detectors: Mapping[str, Run], scans: Scans, rounds: int, bar: Track = silently
) -> dict[str, Comparison]:
    """Compare the detectors in turn on the camera's view of scans (N, 4), metres, LiDAR frame, and on whole scans."""
    views = {"camera view": [points[camera_view(points)] for points in scans], "whole scans": scans}
    return {name: compare(detectors, part, rounds, bar) for name, part in views.items()}


if __name__ == "__main__":
    run_command(main)
