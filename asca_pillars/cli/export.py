"""`asca export`: export of a checkpoint to a verified bundle, or of a bundle to files for other runtimes."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asca_pillars.cli.options import ScoreOption, read_scores

if TYPE_CHECKING:
    from rich.console import Console

    from asca_deploy.bundle import Quantization


def export(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            help="RUN/checkpoints/best.ckpt or last.ckpt, or a bundle that holds its weights, such as default; with "
            "--golden or --browser any bundle."
        ),
    ],
    *,
    scans: Annotated[
        Path | None,
        typer.Option(
            "--scans",
            help="Scans like those trained on, to compare on. Default: 8 simulated ones. With --golden or --browser "
            "the one that is run. Default: the sample that comes with asca.",
            rich_help_panel="Input",
        ),
    ] = None,
    calibrate: Annotated[
        Path | None,
        typer.Option(
            "--calibrate",
            help="Scans like those trained on, to calibrate with; 96 of the folder, evenly spaced. Default: simulated.",
            rich_help_panel="Input",
        ),
    ] = None,
    ort_web: Annotated[
        Path | None,
        typer.Option(
            "--ort-web",
            help="For --browser: npm's package onnxruntime-web, a .tgz or its folder. Default: what `npm pack` or `npm "
            "install` left in this folder.",
            rich_help_panel="Input",
        ),
    ] = None,
    trained_on: Annotated[
        str | None,
        typer.Option(
            "--trained-on",
            help="What the weights saw, for the manifest. Default: what a bundle says of itself, or `not stated`.",
            rich_help_panel="Bundle",
        ),
    ] = None,
    range_m: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            "--range",
            metavar="X0 X1 Y0 Y1",
            help="Where the bundle looks for objects, in metres; the weights are the same for every range. Default: "
            "the checkpoint's. Ahead alone: 0 69.12 -30.72 30.72",
            rich_help_panel="Bundle",
        ),
    ] = None,
    int8: Annotated[
        bool,
        typer.Option(
            "--int8",
            help="8-bit backbone: several times faster on a CPU, a quarter of the size.",
            rich_help_panel="Bundle",
        ),
    ] = False,
    dense_neck: Annotated[
        bool,
        typer.Option(
            "--dense-neck",
            help="Write a sparse neck as dense convolutions with masks: the same boxes, for OpenVINO and TensorRT, "
            "which want fixed shapes, and for GPUs. Slower on a CPU.",
            rich_help_panel="Bundle",
        ),
    ] = False,
    with_weights: Annotated[
        bool,
        typer.Option(
            "--with-weights", help="Add the weights, in 16 bits, for `asca train --init`.", rich_help_panel="Bundle"
        ),
    ] = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to be written.", rich_help_panel="Output")],
    score: ScoreOption = None,
    post: Annotated[
        list[str] | None,
        typer.Option(
            "--post",
            metavar="KEY=VALUE",
            help="Suppression of overlapping boxes: nms_iou, candidates, max_detections, vote_iou (docs/BUNDLE.md). "
            "Repeatable. Default: the checkpoint's.",
            rich_help_panel="Bundle",
        ),
    ] = None,
    golden: Annotated[
        bool,
        typer.Option(
            "--golden",
            help="Write every stage's arrays for one scan, to check other runtimes by.",
            rich_help_panel="Output",
        ),
    ] = False,
    browser: Annotated[
        bool,
        typer.Option(
            "--browser",
            help="Write a static web page that runs the bundle in the browser, zipped too.",
            rich_help_panel="Output",
        ),
    ] = False,
) -> None:
    """Export to ONNX and compare with PyTorch on scans, head maps and boxes; fails if they differ.

    With --int8 the graphs that passed become 8-bit ones; bundle.json says how far they are from the float ones, layer
    by layer, and which layers stay in floating point because of it.

    With --golden or --browser a finished bundle is read instead of a checkpoint, and PyTorch is not needed.

    Examples:

    asca export runs/small/checkpoints/last.ckpt -o my_bundle --score Car=0.4

    asca export default --dense-neck -o dense

    asca export default --range 0 51.2 -25.6 25.6 -o near

    asca export my_bundle --golden -o golden
    """
    if golden or browser or ort_web is not None:
        of_a_checkpoint = {
            "--trained-on": trained_on,
            "--score": score,
            "--post": post,
            "--range": range_m,
            "--int8": int8,
            "--calibrate": calibrate,
            "--dense-neck": dense_neck,
            "--with-weights": with_weights,
        }
        _export_for_runtime(checkpoint, out, scans, of_a_checkpoint, golden=golden, browser=browser, ort_web=ort_web)
        return
    import numpy as np
    from rich.console import Console

    from asca_export.export_checkpoint import export as run
    from asca_pillars.cli.progress import Bars

    console = Console(markup=False)
    with Bars(console, transient=True) as bars:
        bundle = run(
            checkpoint,
            out,
            scans=scans,
            trained_on=trained_on,
            score=read_scores(score),
            post=post or (),
            range_m=range_m,
            int8=int8,
            calibrate=calibrate,
            dense_neck=dense_neck,
            with_weights=with_weights,
            progress=bars,
            step=bars.step,
        )
    parity = bundle.parity
    assert parity is not None, "export proves it"
    console.print(
        f"{out}: parity on {parity.scans} scans: head maps within {parity.head_maps_max_abs_error:.2g}, "
        f"boxes within {parity.box_max_error_m:.2g} m and {np.rad2deg(parity.yaw_max_error_rad):.2g} degrees"
    )
    if bundle.expected_input_from == "export":
        console.print("The checkpoint does not describe its training scans: expected_input is measured on --scans")
    if bundle.quantization is not None:
        _print_quantization(bundle.quantization, console)


def _print_quantization(report: "Quantization", console: "Console") -> None:
    """Print a row per layer, and the effect on the boxes."""
    from rich.table import Table

    table = Table(title=f"In 8 bits, calibrated on {report.calibration_scans} scans")
    if report.dropped_scans:
        console.print(f"{report.dropped_scans} calibration scans left out: parity is proven on the same ones")
    table.add_column("layer")
    table.add_column("logit error if only it stays float", justify="right")
    table.add_column("kept float")
    for layer in report.layers:
        table.add_row(layer.layer, f"{layer.logit_rms_error:.4f}", "yes" if layer.kept_float else "")
    console.print(table)
    console.print(
        f"Logit error {report.logit_rms_error:.4f}; {report.boxes_matched} of {report.boxes} boxes on "
        f"{report.compared_scans} scans remain, {report.boxes_added} are new. "
        "`asca eval` on both bundles shows the difference in AP"
    )


def _export_for_runtime(
    bundle: Path,
    out: Path,
    scans: Path | None,
    of_a_checkpoint: Mapping[str, object],
    *,
    golden: bool,
    browser: bool,
    ort_web: Path | None,
) -> None:
    """Run `asca export --golden` or `asca export --browser`.

    Args:
        bundle: folder, or name of one that ships.
        out: output folder.
        scans: the scan, or a folder whose first scan is used; None for the package's sample.
        of_a_checkpoint: options, by name, that do not apply to a bundle.
        golden, browser: exactly one of them is set.
        ort_web: npm's package onnxruntime-web, for `browser`.

    Raises:
        ConfigError: options that do not go together.
    """
    from rich.console import Console

    from asca_deploy import find_bundle, sample_scan_path
    from asca_deploy.browser_page import START, find_ort_web, page_zip, write_page
    from asca_deploy.golden import GOLDEN, write_golden
    from asca_pillars.base.errors import ConfigError
    from asca_pillars.scans.find_scans import find_scans

    if golden == browser or (ort_web is not None and not browser):
        raise ConfigError("give either --golden or --browser; --ort-web is for --browser")
    if given := [name for name, value in of_a_checkpoint.items() if value]:
        raise ConfigError(f"{given[0]} is for a checkpoint, and --golden and --browser read a bundle; leave it out")
    folder = find_bundle(bundle)
    scan = sample_scan_path() if scans is None else find_scans(scans)[0]
    console = Console(markup=False)
    if browser:
        size_bytes = write_page(out, folder, scan, find_ort_web(ort_web))
        zipped = page_zip(out)
        console.print(f"{out}: {size_bytes / 1e6:.0f} MB. {START.format(out=out)}", soft_wrap=True)
        console.print(f"{zipped}: {zipped.stat().st_size / 1e6:.0f} MB, the same to copy or upload", soft_wrap=True)
        return
    stages = write_golden(out, folder, scan)
    arrays = [array for named in stages.values() for array in named.values()]
    size_bytes = sum(array.nbytes for array in arrays)
    boxes = len(stages["suppress"]["boxes"])
    console.print(
        f"{out}: {len(arrays)} arrays, {size_bytes / 1e6:.0f} MB, {boxes} boxes of {scan.name}; {GOLDEN} names them",
        soft_wrap=True,
    )
