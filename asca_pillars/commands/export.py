"""`asca export`: a checkpoint in, a bundle out that was compared with it; or from a bundle what other runtimes need."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.commands.extras import require


def export(
    checkpoint: Annotated[
        Path,
        typer.Argument(help="RUN/checkpoints/best.ckpt or last.ckpt; with --golden or --browser a bundle."),
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
        str, typer.Option("--trained-on", help="What the weights have seen, for the manifest.")
    ] = "not stated",
    score: Annotated[
        list[str] | None,
        typer.Option(
            "--score", help="CLASS=VALUE: report this class from this score on. Repeatable. Default: the config's."
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

    asca export my_bundle --golden -o golden
    """
    if golden or browser or ort_web is not None:
        from asca_pillars.commands.export_runtime import export_for_runtime

        of_a_checkpoint = {"--score": score, "--int8": int8, "--calibrate": calibrate, "--with-weights": with_weights}
        export_for_runtime(checkpoint, out, scans, of_a_checkpoint, golden=golden, browser=browser, ort_web=ort_web)
        return
    require("train")
    from dataclasses import replace

    import numpy as np
    from rich.console import Console

    from asca_deploy.bundle import MANIFEST, AnyBundle
    from asca_export.exporter import export_bundle
    from asca_export.pv_rcnn_exporter import export_pv_rcnn_bundle
    from asca_export.refine_exporter import export_refine_bundle
    from asca_pillars.commands.export_steps import (
        CALIBRATION_SCANS,
        CALIBRATION_SEED,
        PARITY_SCANS,
        PARITY_SEED,
        View,
        class_score,
        print_quantization,
        read_or_simulate,
        run_environment,
    )
    from asca_pillars.errors import ConfigError
    from asca_pillars.files import require_replaceable
    from asca_pillars.models.checkpoint import load_checkpoint

    console = Console(markup=False)
    require_replaceable(out, "asca export", MANIFEST)  # before minutes of work
    loaded = load_checkpoint(checkpoint)
    spec = loaded.config.model.spec.with_score_threshold(dict(class_score(text) for text in score or ()))
    model = replace(loaded.config.model, spec=spec)  # type: ignore[arg-type]  # of the same kind
    loaded = loaded._replace(config=replace(loaded.config, model=model))
    if calibrate is not None and not int8:
        raise ConfigError(f"--calibrate {calibrate} without --int8: only an 8-bit bundle is calibrated; add --int8")
    kinds = {"pillar": export_bundle, "pillar_refine": export_refine_bundle, "pv_rcnn": export_pv_rcnn_bundle}
    export_kind = kinds[loaded.config.model.kind]
    if loaded.expected_input is None and scans is None:
        raise ConfigError(
            f"{checkpoint} does not say what its training scans looked like, which the bundle has to know; "
            "give some of them with --scans"
        )
    command = run_environment(checkpoint).get("command", "not recorded")
    points = read_or_simulate(scans, console, PARITY_SCANS, PARITY_SEED)
    # Ranges are those of what the model was trained on; parity has to hold for whole revolutions too.
    view: View = "camera" if loaded.config.data.camera_view else "full"
    calibration = read_or_simulate(calibrate, console, CALIBRATION_SCANS, CALIBRATION_SEED, view) if int8 else None
    weights = checkpoint if with_weights else None
    with console.status("Exporting") as status:
        bundle: AnyBundle = export_kind(
            loaded,
            out,
            points,
            trained_on=trained_on,
            command=command,
            calibration=calibration,
            weights=weights,
            progress=status.update,
        )
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
