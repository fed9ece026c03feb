"""`asca export`: a checkpoint in, a bundle out that was compared with it; or from a bundle what other runtimes need."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.cli.extras import require
from asca_pillars.cli.options import ScoreOption, read_scores


def export(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            help="RUN/checkpoints/best.ckpt or last.ckpt, or a bundle that holds its weights, such as asca_sim; with "
            "--golden or --browser any bundle."
        ),
    ],
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to be written.")],
    scans: Annotated[
        Path | None,
        typer.Option(
            "--scans",
            help="Scans like those trained on, to compare on. Default: 8 simulated ones. With --golden or --browser "
            "the one that is run. Default: the sample that comes with asca.",
        ),
    ] = None,
    trained_on: Annotated[
        str | None,
        typer.Option(
            "--trained-on",
            help="What the weights saw, for the manifest. Default: what a bundle says of itself, or `not stated`.",
        ),
    ] = None,
    score: ScoreOption = None,
    range_m: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            "--range",
            metavar="X0 X1 Y0 Y1",
            help="Where the bundle looks for objects, in metres; the weights are the same for every range. Default: "
            "the checkpoint's. Ahead alone: 0 69.12 -30.72 30.72",
        ),
    ] = None,
    int8: Annotated[
        bool, typer.Option("--int8", help="8-bit backbone: several times faster on a CPU, a quarter of the size.")
    ] = False,
    calibrate: Annotated[
        Path | None,
        typer.Option(
            "--calibrate",
            help="Scans like those trained on, to calibrate with; 96 of the folder, evenly spaced. Default: simulated.",
        ),
    ] = None,
    dense_neck: Annotated[
        bool,
        typer.Option(
            "--dense-neck",
            help="Write a sparse neck as dense convolutions with masks: the same boxes, for OpenVINO and TensorRT, "
            "which want fixed shapes, and for GPUs. Slower on a CPU.",
        ),
    ] = False,
    with_weights: Annotated[
        bool, typer.Option("--with-weights", help="Add the weights, in 16 bits, for `asca train --init`.")
    ] = False,
    golden: Annotated[
        bool, typer.Option("--golden", help="Write every stage's arrays for one scan, to check other runtimes by.")
    ] = False,
    browser: Annotated[
        bool, typer.Option("--browser", help="Write a static web page that runs the bundle in the browser.")
    ] = False,
    ort_web: Annotated[
        Path | None,
        typer.Option(
            "--ort-web",
            help="For --browser: npm's package onnxruntime-web, a .tgz or its folder. Default: what `npm pack` or `npm "
            "install` left in this folder.",
        ),
    ] = None,
) -> None:
    """Export to ONNX and compare with PyTorch on scans, head maps and boxes; fails if they differ.

    With --int8 the graphs that passed become 8-bit ones; bundle.json says how far they are from the float ones, layer
    by layer, and which layers stay in floating point because of it.

    With --golden or --browser a finished bundle is read instead of a checkpoint, and PyTorch is not needed.

    Examples:

    asca export runs/small/checkpoints/last.ckpt -o my_bundle --score Car=0.4

    asca export asca_sim --dense-neck -o asca_sim_dense

    asca export asca_sim --range 0 51.2 -25.6 25.6 -o asca_sim_near

    asca export my_bundle --golden -o golden
    """
    if golden or browser or ort_web is not None:
        from asca_pillars.cli.export_runtime import export_for_runtime

        of_a_checkpoint = {
            "--trained-on": trained_on,
            "--score": score,
            "--range": range_m,
            "--int8": int8,
            "--calibrate": calibrate,
            "--dense-neck": dense_neck,
            "--with-weights": with_weights,
        }
        export_for_runtime(checkpoint, out, scans, of_a_checkpoint, golden=golden, browser=browser, ort_web=ort_web)
        return
    require("train")
    from dataclasses import replace

    import numpy as np
    from rich.console import Console

    from asca_deploy.bundle import BUNDLE_FOLDER
    from asca_export.export import export_bundle
    from asca_export.pillar.export import require_maskable
    from asca_export.proven_bundle import ExportOptions
    from asca_pillars.base.errors import ConfigError
    from asca_pillars.base.own_files import require_not_input, require_replaceable
    from asca_pillars.cli.export_steps import (
        CALIBRATION_SCANS,
        CALIBRATION_SEED,
        PARITY_SCANS,
        PARITY_SEED,
        View,
        open_source,
        print_quantization,
        read_or_simulate,
        with_ranges,
    )

    console = Console(markup=False)
    require_replaceable(out, *BUNDLE_FOLDER)  # before minutes of work
    require_not_input(out, (scans, calibrate))
    source = open_source(checkpoint)
    loaded = source.checkpoint
    spec = loaded.config.model.spec.with_score_threshold(source.score_thresholds)
    if (scores := read_scores(score)) is not None:
        spec = spec.with_score_threshold(scores)
    if range_m is not None:
        spec = with_ranges(spec, range_m)
    model = replace(loaded.config.model, spec=spec)  # type: ignore[arg-type]  # of the same kind
    loaded = loaded.with_model(model)
    if calibrate is not None and not int8:
        raise ConfigError(f"--calibrate {calibrate} without --int8: only an 8-bit bundle is calibrated; add --int8")
    require_not_input(out, (getattr(model, "first_stage", None),))
    if dense_neck:
        require_maskable(loaded.config.model, int8=int8)
    if loaded.expected_input is None and scans is None:
        raise ConfigError(
            f"{checkpoint} does not say what its training scans looked like, which the bundle has to know; "
            "give some of them with --scans"
        )
    points = read_or_simulate(scans, console, PARITY_SCANS, PARITY_SEED)
    # Ranges are those of what the model was trained on; parity has to hold for whole revolutions too.
    view: View = "camera" if loaded.config.data.camera_view else "full"
    calibration = read_or_simulate(calibrate, console, CALIBRATION_SCANS, CALIBRATION_SEED, view) if int8 else None
    # A bundle that is written anew from its own weights keeps them: they may be the only ones.
    keeps = with_weights or source.path.parent.resolve() == out.resolve()
    weights = source.path if keeps else None
    with console.status("Exporting") as status:
        options = ExportOptions(
            trained_on=trained_on or source.trained_on,
            command=source.command,
            calibration=calibration,
            dense_neck=dense_neck,
            weights=weights,
            progress=status.update,
        )
        bundle = export_bundle(loaded, out, points, options)
    parity = bundle.parity
    assert parity is not None, "export_bundle proves it"
    console.print(
        f"{out}: parity on {parity.scans} scans: head maps within {parity.head_maps_max_abs_error:.2g}, "
        f"boxes within {parity.box_max_error_m:.2g} m and {np.rad2deg(parity.yaw_max_error_rad):.2g} degrees"
    )
    if bundle.expected_input_from == "export":
        console.print("The checkpoint does not describe its training scans: expected_input is measured on --scans")
    if bundle.quantization is not None:
        print_quantization(bundle.quantization, console)
