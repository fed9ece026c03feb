"""Export of a PV-RCNN checkpoint to a bundle."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, BUNDLE_FOLDER, Parity, PvRcnnBundle, PvRcnnSection
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_export import graphs
from asca_export.bundle_writer import DEFAULTS, ExportOptions, draft_bundle, require_parity_scans, write_bundle
from asca_export.int8 import calibration_scans
from asca_export.pv_rcnn.graphs import export_pv_rcnn_graphs
from asca_export.pv_rcnn.int8 import quantize_pv_rcnn_bundle, require_quantizable
from asca_export.pv_rcnn.parity import check_pv_rcnn_parity
from asca_pillars.base.files import atomic_directory
from asca_pillars.base.system import default_threads
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector


def export_pv_rcnn_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    options: ExportOptions = DEFAULTS,
) -> PvRcnnBundle:
    """Export kind pv_rcnn, see `asca_export.export.export_bundle`: four graphs.

    With `options.calibration` the first stage is put in 8 bits; what follows the proposals stays in float32.
    """
    model, detector, calibration = checkpoint.config.model, checkpoint.detector, options.calibration
    assert isinstance(model, PvRcnnModel) and isinstance(detector, PvRcnnDetector), "it is of kind pv_rcnn"
    require_parity_scans(scans)
    if calibration is not None:
        require_quantizable(model)
        calibration_scans(calibration, scans, model.spec)  # too few are told before the work, not after it
    options.progress("Exporting and proving parity")
    with atomic_directory(out, *BUNDLE_FOLDER) as folder:
        network = model.network
        section = PvRcnnSection(network.voxel_channels, network.keypoint_channels, model.settings, model.scores)
        draft = draft_bundle(
            PvRcnnBundle, model.spec, checkpoint, scans, options, kind="pv_rcnn", pv_rcnn=section, backbone_gmac=0.0
        )
        export_pv_rcnn_graphs(detector.network, draft, folder)
        gmac = graphs.multiply_accumulates(graphs.graph_path(folder, BACKBONE)) / 1e9

        def compare(opened: PvRcnnBundle) -> Parity:
            pipeline = PvRcnnPipeline(folder, opened, threads=default_threads())
            return check_pv_rcnn_parity(detector.network, pipeline, scans)

        bundle = write_bundle(folder, dataclasses.replace(draft, backbone_gmac=gmac), compare, options.weights)
        if calibration is not None:
            bundle = quantize_pv_rcnn_bundle(folder, bundle, detector.network, calibration, scans, options.progress)
    return bundle
