"""A checkpoint of PV-RCNN becomes a bundle, or a clear refusal."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, BUNDLE_FOLDER, Parity, PvRcnnBundle, PvRcnnSection
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_export import graphs
from asca_export.int8 import calibration_scans
from asca_export.pillar.export import LICENSE, provenance, require_parity_scans, write_proven
from asca_export.pv_rcnn.graphs import export_pv_rcnn_graphs
from asca_export.pv_rcnn.int8 import quantize_pv_rcnn_bundle, require_quantizable
from asca_export.pv_rcnn.parity import prove_pv_rcnn_parity
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import atomic_directory
from asca_pillars.base.system import default_threads
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from asca_pillars.scans.measure_input import measure_expected_input


def export_pv_rcnn_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    *,
    trained_on: str = "not stated",
    command: str = "not stated",
    calibration: Sequence[NDArray[np.float32]] | None = None,
    weights: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PvRcnnBundle:
    """Write the four graphs and bundle.json, and prove on `scans` that they are the checkpoint's detector.

    Arguments as of `pillar.export.export_bundle`. With `calibration` the first stage is then put in 8 bits; what
    follows the proposals stays in float32.

    Raises:
        ExportError: too few scans, or PyTorch and onnxruntime differ; names the first stage that does. Or the network
            is one that is not put in 8 bits.
    """
    require_parity_scans(scans)
    config, detector, expected = checkpoint.config, checkpoint.detector, checkpoint.expected_input
    model = config.model
    if not (isinstance(model, PvRcnnModel) and isinstance(detector, PvRcnnDetector)):
        raise ExportError(f"model.kind {model.kind}: not PV-RCNN")
    if calibration is not None:
        require_quantizable(model)
        calibration_scans(calibration, scans, model.spec)  # too few are told before the work, not after it
    progress("Exporting and proving parity")
    with atomic_directory(out, *BUNDLE_FOLDER) as folder:
        draft = PvRcnnBundle(
            name=config.name,
            kind="pv_rcnn",
            spec=model.spec,
            pv_rcnn=PvRcnnSection(
                model.network.voxel_channels, model.network.keypoint_channels, model.settings, model.scores
            ),
            precision="float32",
            backbone_gmac=0.0,
            graphs={},
            parity=None,
            quantization=None,
            expected_input=expected or measure_expected_input(scans, config.data.camera_view),
            expected_input_from="training" if expected else "export",
            provenance=provenance(checkpoint, trained_on, command),
            license=LICENSE,
        )
        export_pv_rcnn_graphs(detector.network, draft, folder)
        gmac = graphs.multiply_accumulates(graphs.graph_path(folder, BACKBONE)) / 1e9

        def prove(opened: PvRcnnBundle) -> Parity:
            pipeline = PvRcnnPipeline(folder, opened, threads=default_threads())
            return prove_pv_rcnn_parity(detector.network, pipeline, scans)

        bundle = write_proven(folder, dataclasses.replace(draft, backbone_gmac=gmac), prove, weights)
        if calibration is not None:
            bundle = quantize_pv_rcnn_bundle(folder, bundle, detector.network, calibration, scans, progress)
    return bundle
