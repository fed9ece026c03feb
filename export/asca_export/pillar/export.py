"""Export of a pillar detector's checkpoint to a bundle."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import nn

from asca_deploy.bundle import BACKBONE, BUNDLE_FOLDER, ENCODER, PFN, CanvasFormat, Parity, PillarBundle, PillarSection
from asca_deploy.pillar.pipeline import PillarPipeline
from asca_export import graphs
from asca_export.bundle_writer import DEFAULTS, ExportOptions, draft_bundle, require_parity_scans, write_bundle
from asca_export.fast_forms import FastBackbone, MarkedEncoder, MaskedBackbone, split_encoder
from asca_export.int8 import calibration_scans, quantize_bundle
from asca_export.parity import check_parity
from asca_export.sparse_forms import SparseBackbone, export_sparse_backbone, sparse_multiply_accumulates
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import atomic_directory
from asca_pillars.base.system import default_threads
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import ModelConfig
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.pillar.network import PillarDetector


def export_pillar_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    options: ExportOptions = DEFAULTS,
) -> PillarBundle:
    """Export kind pillar, see `asca_export.export.export_bundle`: pfn.onnx, encoder.onnx, backbone.onnx."""
    model, detector, calibration = checkpoint.config.model, checkpoint.detector, options.calibration
    assert isinstance(model, PillarModel) and isinstance(detector, PillarDetector), "it is of kind pillar"
    require_parity_scans(scans)
    if calibration is not None:
        calibration_scans(calibration, scans, model.spec)  # too few are told before the work, not after it
    options.progress("Exporting and proving parity")
    with atomic_directory(out, *BUNDLE_FOLDER) as folder:
        gmac = _export_graphs(detector, folder, scans, dense_neck=options.dense_neck)
        network = model.network
        neck, cells = ("dense", None) if options.dense_neck else (network.neck, detector.preparation.active_cells)
        section = PillarSection(network.cpa, network.pillar_channels, CanvasFormat(), neck, cells)
        draft = draft_bundle(
            PillarBundle, model.spec, checkpoint, scans, options, kind="pillar", pillar=section, backbone_gmac=gmac
        )

        def compare(opened: PillarBundle) -> Parity:
            return check_parity(detector, PillarPipeline(folder, opened, threads=default_threads()), scans)

        bundle = write_bundle(folder, draft, compare, options.weights)
        if calibration is not None:
            bundle = quantize_bundle(folder, bundle, detector, calibration, scans, options.progress)
    return bundle


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


def _export_graphs(
    detector: PillarDetector, folder: Path, scans: Sequence[NDArray[np.float32]], *, dense_neck: bool
) -> float:
    """Write the graphs; return the backbone's multiply-accumulates, 10^9, of a sparse neck the mean over scans."""
    preparation = detector.preparation
    split, encoder = split_encoder(detector.encode), graphs.graph_path(folder, ENCODER)
    if split is None:
        graphs.export_encoder(_marked(detector.encode, dense_neck), encoder)
    else:
        graphs.export_pfn(split.pfn, graphs.graph_path(folder, PFN))
        graphs.export_attention(_marked(split.attention, dense_neck), len(split.pfn.bias), encoder)
    path = graphs.graph_path(folder, BACKBONE)
    if dense_neck or preparation.active_cells is None:
        dense = MaskedBackbone(detector) if dense_neck else FastBackbone(detector)
        graphs.export_backbone(dense, detector.grid.map_shape, path)
        return graphs.multiply_accumulates(path) / 1e9
    backbone = SparseBackbone(detector)
    export_sparse_backbone(backbone, path)
    rulebooks = [preparation.place(preparation.spec.pillarize(scan)).rulebooks for scan in scans]
    counts = [sparse_multiply_accumulates(backbone, built) for built in rulebooks if built is not None]
    return float(np.mean(counts)) / 1e9


def _marked(encode: nn.Module, dense_neck: bool) -> nn.Module:
    return MarkedEncoder(encode) if dense_neck else encode
