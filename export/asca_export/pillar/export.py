"""A checkpoint becomes a bundle, or a clear refusal."""

import dataclasses
import datetime
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import (
    BACKBONE,
    BUNDLE_FOLDER,
    ENCODER,
    Bundle,
    CanvasFormat,
    Parity,
    PillarBundle,
    PillarSection,
    Provenance,
    RefineSection,
)
from asca_deploy.manifest import load_bundle, write_bundle_manifest
from asca_deploy.pillar.pipeline import PillarPipeline
from asca_export import graphs
from asca_export.fast_forms import FastBackbone, fast_encoder
from asca_export.int8 import calibration_scans, quantize_bundle
from asca_export.parity import prove_parity
from asca_export.pillar.masked_forms import MarkedEncoder, MaskedBackbone
from asca_export.sparse_forms import SparseBackbone
from asca_export.sparse_graphs import export_sparse_backbone, sparse_multiply_accumulates
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import WEIGHTS_FILE, atomic_directory
from asca_pillars.base.system import cpu_model, default_threads, git_revision, package_versions
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import ModelConfig, pillar_spec
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.models.checkpoint_file import save_weights, weights_sha256
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.scans.measure_input import measure_expected_input

MIN_SCANS = 8
LICENSE = "Apache-2.0"

Described = TypeVar("Described", bound=Bundle)


def export_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    *,
    trained_on: str = "not stated",
    command: str = "not stated",
    calibration: Sequence[NDArray[np.float32]] | None = None,
    dense_neck: bool = False,
    weights: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PillarBundle:
    """Write the two graphs and bundle.json, and prove on `scans` that they are the checkpoint's detector.

    With `calibration` the proven float graphs then become 8-bit ones, and the bundle says how far those are from them.
    Nothing appears at `out` unless the proof holds; a bundle that stood there stays until then.

    Args:
        checkpoint: from `load_checkpoint`.
        out: the bundle's folder.
        scans: at least MIN_SCANS scans (N, 4), metres, LiDAR frame, and reflectance. If the checkpoint does not say
            what its training scans looked like, these stand in for them, and the manifest says so.
        trained_on: what the weights have seen, in words, for the manifest.
        command: the command that trained them.
        calibration: scans (N, 4) that set the ranges of an 8-bit bundle; those that are among `scans` are left out
            and counted.
        dense_neck: write a sparse neck as dense convolutions with masks, in float32 alone, see `pillar.masked_forms`.
        weights: the checkpoint's file, whose weights are to lie beside the graphs in 16 bits; None leaves them out.
        progress: told what is being done.

    Raises:
        ExportError: too few scans, to prove parity or to calibrate on; `dense_neck` of a neck that is dense, or in
            8 bits; or PyTorch and onnxruntime differ; names the first stage that does.
    """
    require_parity_scans(scans)
    config, detector = checkpoint.config, checkpoint.detector
    if not (isinstance(config.model, PillarModel) and isinstance(detector, PillarDetector)):
        raise ExportError(f"model.kind {config.model.kind}: only pillar detectors can be exported")
    if dense_neck:
        require_maskable(config.model, int8=calibration is not None)
    if calibration is not None:
        calibration_scans(calibration, scans, config.model.spec)  # too few are told before the work, not after it
    progress("Exporting and proving parity")
    with atomic_directory(out, *BUNDLE_FOLDER) as folder:
        gmac = _export_graphs(detector, folder, scans, dense_neck=dense_neck)
        network = config.model.network
        neck, cells = ("dense", None) if dense_neck else (network.neck, detector.preparation.active_cells)
        section = PillarSection(network.cpa, network.pillar_channels, CanvasFormat(), neck, cells)
        draft = draft_bundle(checkpoint, scans, trained_on, command, pillar=section, backbone_gmac=gmac)

        def prove(signed: PillarBundle) -> Parity:
            return prove_parity(detector, PillarPipeline(folder, signed, threads=default_threads()), scans)

        bundle = write_proven(folder, draft, prove, weights)
        if calibration is not None:
            bundle = quantize_bundle(folder, bundle, detector, calibration, scans, progress)
    return bundle


def require_parity_scans(scans: Sequence[NDArray[np.float32]]) -> None:
    """Refuse to prove parity on fewer than MIN_SCANS scans (N, 4), metres, LiDAR frame.

    Raises:
        ExportError: there are fewer.
    """
    if len(scans) < MIN_SCANS:
        raise ExportError(f"{len(scans)} scans given to prove parity on, at least {MIN_SCANS} are needed; add --scans")


def require_maskable(model: ModelConfig, *, int8: bool) -> None:
    """Refuse the form of dense convolutions with masks where there is none.

    Raises:
        ExportError: `model` is not a pillar detector with a sparse neck, or it is to be in 8 bits.
    """
    if not isinstance(model, PillarModel):
        raise ExportError(f"--dense-neck: only kind pillar has that form, this is kind {model.kind}; leave it out")
    if model.network.neck == "dense":
        raise ExportError("--dense-neck: the neck of this model is dense; leave it out")
    if int8:
        raise ExportError("--dense-neck with --int8: its form is float32 alone; leave one of them out")


def draft_bundle(
    checkpoint: Checkpoint,
    scans: Sequence[NDArray[np.float32]],
    trained_on: str,
    command: str,
    *,
    pillar: PillarSection,
    backbone_gmac: float,
    refine: RefineSection | None = None,
) -> PillarBundle:
    """The manifest of a checkpoint in float32, without graphs and proof; scans (N, 4) and words as in `export_bundle`.

    Args:
        pillar: of the graphs.
        backbone_gmac: multiply-accumulates of the backbone, 10^9.
        refine: of the second stage, if there is one.
    """
    config, expected = checkpoint.config, checkpoint.expected_input
    return PillarBundle(
        name=config.name,
        kind="pillar" if refine is None else "pillar_refine",
        spec=pillar_spec(config),
        pillar=pillar,
        precision="float32",
        backbone_gmac=backbone_gmac,
        graphs={},
        parity=None,
        quantization=None,
        expected_input=expected or measure_expected_input(scans, config.data.camera_view),
        expected_input_from="training" if expected else "export",
        provenance=provenance(checkpoint, trained_on, command),
        license=LICENSE,
        refine=refine,
    )


def write_proven(
    folder: Path, draft: Described, prove: Callable[[Described], Parity], weights: Path | None
) -> Described:
    """Sign the graphs in `folder`, and write their manifest with the parity that `prove` finds as the runtime opens it.

    `weights` as in `export_bundle`.

    Raises:
        ExportError: there is none.
    """
    if weights is not None:
        save_weights(weights, folder / WEIGHTS_FILE)
        digest = hashlib.sha256((folder / WEIGHTS_FILE).read_bytes()).hexdigest()
        kept = dataclasses.replace(draft.provenance, weights_file=WEIGHTS_FILE, weights_file_sha256=digest)
        draft = dataclasses.replace(draft, provenance=kept)
    signed = graphs.sign(folder, draft)
    write_bundle_manifest(folder, signed)
    opened = load_bundle(folder)
    assert isinstance(opened, type(draft)), "as it was written"
    bundle = dataclasses.replace(signed, parity=prove(opened))
    write_bundle_manifest(folder, bundle)
    return bundle


def provenance(checkpoint: Checkpoint, trained_on: str, command: str) -> Provenance:
    """Where the weights of a checkpoint come from; see `export_bundle` for the arguments."""
    return Provenance(
        command=command,
        created=datetime.datetime.now(datetime.UTC).date().isoformat(),
        git_revision=git_revision(),
        trained_on=trained_on,
        seed=checkpoint.config.train.seed,
        steps=checkpoint.steps,
        versions=package_versions(),
        machine=cpu_model(),
        weights_sha256=weights_sha256(checkpoint.detector.state_dict()),
    )


def _export_graphs(
    detector: PillarDetector, folder: Path, scans: Sequence[NDArray[np.float32]], *, dense_neck: bool
) -> float:
    """Write both graphs; the backbone's multiply-accumulates, 10^9, of a sparse neck in the mean over the scans."""
    preparation = detector.preparation
    encode = fast_encoder(detector.encode)
    graphs.export_encoder(MarkedEncoder(encode) if dense_neck else encode, graphs.graph_path(folder, ENCODER))
    path = graphs.graph_path(folder, BACKBONE)
    if dense_neck or preparation.active_cells is None:
        dense = MaskedBackbone(detector) if dense_neck else FastBackbone(detector)
        graphs.export_backbone(dense, detector.grid.map_shape, path)
        return graphs.multiply_accumulates(path) / 1e9
    backbone = SparseBackbone(detector)
    export_sparse_backbone(backbone, path)
    tables = [preparation.place(preparation.spec.pillarize(scan)).tables for scan in scans]
    return float(np.mean([sparse_multiply_accumulates(backbone, each) for each in tables if each is not None])) / 1e9
