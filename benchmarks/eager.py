"""Speed of the runtime relative to the same network in eager PyTorch, float32, with padded pillars.

    python -m benchmarks.eager                                  # the paper's size, random weights, float32
    python -m benchmarks.eager --int8 --tolerance 1             # the same in 8 bits
    python -m benchmarks.eager scan.bin --checkpoint last.ckpt --bundle my_int8_bundle --provider openvino --tolerance 5

Both sides get the same scans and number of threads and run in turn, points in, boxes out. First the head maps of both
are compared, to verify that the network is the same. PyTorch runs in inference mode, float32, with its defaults and
its threads set; in three forms, the usual one first, then two common optimizations.
"""

import copy
import logging
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_deploy import Detector, sample_scan_path
from asca_deploy.benchmark import compare
from asca_deploy.providers import Precision, Provider
from asca_export.bundle_writer import MIN_SCANS, ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import AscaError
from asca_pillars.base.system import cpu_model, default_threads, package_versions
from asca_pillars.cli.bench_parts import comparison_table
from asca_pillars.cli.run_command import run_command
from asca_pillars.config.tree import pillar_spec
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan
from benchmarks.padded import PaddedDetector
from benchmarks.random_weights import random_weights

Scans = Sequence[NDArray[np.float32]]


def main(
    *,
    scans: Annotated[Path | None, typer.Argument(help="A scan or a folder of them. Default: the sample.")] = None,
    config: Annotated[
        str, typer.Option(help="Without a checkpoint: network to give random weights, a YAML or one that ships.")
    ] = "asca_pointpillars_kitti",
    checkpoint: Annotated[Path | None, typer.Option(help="Weights for PyTorch.")] = None,
    bundle: Annotated[Path | None, typer.Option(help="Its export. Default: exported now.")] = None,
    int8: Annotated[bool, typer.Option("--int8", help="Export in 8 bits.")] = False,
    provider: Annotated[Provider, typer.Option(help="Where the bundle runs.")] = "cpu",
    precision: Annotated[Precision, typer.Option(help="In which the bundle runs: float32 or reduced.")] = "float32",
    threads: Annotated[int | None, typer.Option(help="Of both. Default: the physical cores.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="In which all take a turn.")] = 10,
    tolerance: Annotated[
        float, typer.Option(help="Largest difference of a head map that is allowed; int8 and bf16 need more.")
    ] = 1e-3,
) -> None:
    """Compare and print one table."""
    console = Console(markup=False, highlight=False)
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # any scan may be given
    threads = default_threads() if threads is None else threads
    torch.set_num_threads(threads)
    points = [read_scan(path).points for path in find_scans(sample_scan_path() if scans is None else scans)]
    model = random_weights(config, points[0]) if checkpoint is None else load_checkpoint(checkpoint)
    with tempfile.TemporaryDirectory() as folder:
        if bundle is None:
            bundle = Path(folder) / "bundle"
            proof = [points[number % len(points)] for number in range(MIN_SCANS)]
            with console.status("Exporting, which compares the boxes too"):
                export_pillar_bundle(model, bundle, proof, ExportOptions(calibration=proof if int8 else None))
        runtime = Detector(bundle, provider=provider, precision=precision, threads=threads)
        if (report := runtime.bundle.quantization) is not None:
            kept = sum(layer.kept_float for layer in report.layers)
            console.print(f"{len(report.layers) - kept} of {len(report.layers)} layers in 8 bits")
        forms = _forms(model)
        for name, form in forms.items():
            difference, spread = map_difference(runtime, form, points)
            text = f"largest difference {difference:.2g}, their standard deviation is {spread:.2g}"
            console.print(f"head maps, {name} against the bundle: {text}", soft_wrap=True)
            if not difference <= tolerance:
                raise AscaError(f"{bundle}: not the same network within {tolerance:g}; see --tolerance")

        def bar(count: int, what: str) -> Iterable[int]:
            return track(range(count), what, console=console, transient=True)

        ours = f"asca, {runtime.provider} {precision}"
        console.print(comparison_table(compare({**forms, ours: runtime}, points, rounds, bar)))
    counts = ", ".join(str(len(scan)) for scan in points[:4])
    versions = package_versions()
    console.print(
        f"{model.config.name}, {len(points)} scan(s) of {counts} points; {cpu_model()}, {threads} threads; torch "
        f"{versions['torch']}: inference_mode, float32, intra-op threads {torch.get_num_threads()}, "
        f"oneDNN {'on' if torch.backends.mkldnn.enabled else 'off'}; onnxruntime {versions['onnxruntime']}",
        soft_wrap=True,
    )


def _forms(model: Checkpoint) -> dict[str, PaddedDetector]:
    network, spec = model.detector, pillar_spec(model.config)
    assert isinstance(network, PillarDetector), "padded forms are of pillar detectors"
    reordered = copy.deepcopy(network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return {
        "eager, padded": PaddedDetector(network, spec),
        "eager, padded, channels_last": PaddedDetector(reordered, spec, channels_last=True),
        "eager, padded points only, channels_last": PaddedDetector(
            reordered, spec, all_pillars=False, channels_last=True
        ),
    }


def map_difference(runtime: Detector, form: PaddedDetector, scans: Scans) -> tuple[float, float]:
    """Return the largest difference of any head map over the scans, and the smallest standard deviation of a map."""
    worst, spread = 0.0, np.inf
    for points in scans:
        maps = runtime.pipeline.infer(runtime.pipeline.prepare(points, []), []).maps
        expected = form.head_maps(points)
        for name, ours, theirs in zip(HeadMaps._fields, maps, expected, strict=True):
            if ours.shape != tuple(theirs.shape):
                raise AscaError(f"{name} has shape {ours.shape} in the bundle, {tuple(theirs.shape)} in PyTorch")
            worst = max(worst, float(np.abs(ours - theirs.numpy()).max()))
            spread = min(spread, float(theirs.std()))
    return worst, spread


if __name__ == "__main__":
    run_command(main)
