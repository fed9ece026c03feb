"""A checkpoint becomes a bundle, or a clear refusal."""

import dataclasses
import datetime
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import (
    BACKBONE,
    ENCODER,
    SCHEMA_VERSION,
    Bundle,
    Graphs,
    Provenance,
    write_bundle_manifest,
)
from asca_deploy.canvas import CanvasFormat
from asca_deploy.detector import Detector
from asca_deploy.input_check import expected_input
from asca_deploy.layout import layout_of
from asca_export import graphs
from asca_export.fast_forms import FastBackbone
from asca_export.int8 import quantize_bundle
from asca_export.parity import prove_parity
from asca_pillars.errors import ExportError
from asca_pillars.files import atomic_directory
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.schema import to_dict
from asca_pillars.system import cpu_model, git_revision, package_versions

MIN_SCANS = 8
LICENSE = "Apache-2.0"


def export_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    *,
    trained_on: str = "not stated",
    command: str = "not stated",
    calibration: Sequence[NDArray[np.float32]] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Bundle:
    """Write the two graphs and bundle.json, and prove on `scans` that they are the checkpoint's detector.

    With `calibration` the proven float graphs then become 8-bit ones, and the bundle says how far those are from them.
    Nothing appears at `out` unless the proof holds; a bundle that stood there stays until then.

    Args:
        checkpoint: from `load_checkpoint`.
        out: the bundle's folder.
        scans: at least MIN_SCANS scans (N, 4) like those trained on; the runtime later warns of scans unlike them.
        trained_on: what the weights have seen, in words, for the manifest.
        command: the command that trained them.
        calibration: scans, others than `scans`, that set the ranges of an 8-bit bundle.
        say: told what is being done.

    Raises:
        ExportError: too few scans, or PyTorch and onnxruntime differ; names the first stage that does.
    """
    if len(scans) < MIN_SCANS:
        raise ExportError(f"{len(scans)} scans given to prove parity on, at least {MIN_SCANS} are needed; add --scans")
    config, detector, steps = checkpoint
    if config.network.neck == "sparse":
        raise ExportError(
            "network.neck = sparse has no bundle yet; its weights fit network.neck=dense, but were not trained for it"
        )
    say("Exporting and proving parity")
    with atomic_directory(out) as folder:
        graphs.export_encoder(detector, folder / ENCODER)
        graphs.export_backbone(FastBackbone(detector), detector.grid, folder / BACKBONE)
        essentials = {
            "schema_version": SCHEMA_VERSION,
            "name": config.name,
            "cpa": config.network.cpa,
            "license": LICENSE,
            "spec": to_dict(config.detector),
            "layout": layout_of(config.detector),
        }
        for name in (ENCODER, BACKBONE):
            graphs.stamp(folder / name, essentials)
        draft = Bundle(
            name=config.name,
            spec=config.detector,
            cpa=config.network.cpa,
            channels=config.network.pillar_channels,
            precision="float32",
            canvas=CanvasFormat(),
            backbone_gmac=graphs.multiply_accumulates(folder / BACKBONE) / 1e9,
            graphs=Graphs.of(folder),
            parity=None,
            quantization=None,
            expected_input=expected_input(scans),
            provenance=Provenance(
                command=command,
                created=datetime.datetime.now(datetime.UTC).date().isoformat(),
                git_revision=git_revision(),
                trained_on=trained_on,
                seed=config.train.seed,
                steps=steps,
                versions=package_versions(),
                machine=cpu_model(),
            ),
            license=LICENSE,
        )
        write_bundle_manifest(folder, draft)
        bundle = dataclasses.replace(draft, parity=prove_parity(detector, Detector(folder), scans))
        write_bundle_manifest(folder, bundle)
        if calibration is not None:
            bundle = quantize_bundle(folder, bundle, detector, calibration, scans, say)
    return bundle
