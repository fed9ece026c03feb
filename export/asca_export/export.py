"""Export of a checkpoint to a bundle."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import Bundle
from asca_export.bundle_writer import DEFAULTS, ExportOptions
from asca_export.pillar.export import export_pillar_bundle, require_maskable
from asca_export.pv_rcnn.export import export_pv_rcnn_bundle
from asca_export.two_stage.export import export_refine_bundle
from asca_pillars.models.build import Checkpoint

EXPORTERS: dict[str, Callable[[Checkpoint, Any, Any, ExportOptions], Bundle]] = {
    "pillar": export_pillar_bundle,
    "pillar_refine": export_refine_bundle,
    "pv_rcnn": export_pv_rcnn_bundle,
}
"""Exporters by `model.kind`."""


def export_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    options: ExportOptions = DEFAULTS,
) -> Bundle:
    """Write a checkpoint's graphs and bundle.json, and prove on `scans` that they are its detector.

    With `options.calibration` the proven float graphs then become 8-bit ones, and the bundle says how far those are
    from them. Nothing appears at `out` unless the proof holds; a bundle that stood there stays until then.

    Args:
        checkpoint: from `load_checkpoint`.
        out: the bundle's folder.
        scans: at least MIN_SCANS scans (N, 4), metres, LiDAR frame, and reflectance. If the checkpoint does not say
            what its training scans looked like, these stand in for them, and the manifest says so.
        options: see `ExportOptions`.

    Raises:
        ExportError: too few scans, to prove parity or to calibrate on; a network that has not the form or the
            precision that is asked for; or PyTorch and onnxruntime differ; names the first stage that does.
    """
    model = checkpoint.config.model
    if options.dense_neck:
        require_maskable(model, int8=options.calibration is not None)
    return EXPORTERS[model.kind](checkpoint, out, scans, options)
