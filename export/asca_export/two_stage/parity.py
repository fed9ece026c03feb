"""Parity of a bundle of two stages and the trained model: graph by graph on the same inputs, then the boxes."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from asca_deploy.bundle import Parity
from asca_deploy.two_stage.pipeline import RefinePipeline, refine_inputs
from asca_export.parity import MAP_TOLERANCE, require_close, require_compared, require_same_refined
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.two_stage.layers import PillarRefiner
from asca_pillars.models.two_stage.preparation import collate_scans
from asca_pillars.ops.two_stage.first_stage import FirstStage, second_stage_inputs
from asca_pillars.ops.two_stage.prepare import refine_scan


def check_refine_parity(
    refiner: PillarRefiner,
    stage: FirstStage,
    runtime: RefinePipeline,
    model: RefineModel,
    scans: Sequence[NDArray[np.float32]],
) -> Parity:
    """Compare the first stage as it was trained on and the second in PyTorch with the exported graphs.

    The second stage's graph and its boxes are compared on the same proposals, because a proposal that one side has
    and the other lacks, by a tie between scores, would hide what the graph does.

    Args:
        refiner: in evaluation mode.
        stage: the first stage that it was trained on.
        runtime: opened on the bundle.
        scans: (N, 4) each.

    Raises:
        ExportError: they differ; names the first stage that does, and the scan. Or no scan has a point in the ranges.
    """
    worst = worst_box = worst_yaw = 0.0
    compared = 0
    for number, scan in enumerate(scans):
        points = scan[np.isfinite(scan).all(axis=1)]
        expected, found = stage(points), runtime.infer(runtime.prepare(points, []), []).found
        for name, one, other in zip(HeadMaps._fields, expected.maps, found.maps, strict=True):
            worst = max(worst, require_close(f"head `{name}`", one, other, MAP_TOLERANCE, number))
        allowed = MAP_TOLERANCE * max(1.0, float(np.abs(expected.neck).max(initial=0.0)))
        worst = max(worst, require_close("neck", expected.neck, found.neck, allowed, number))
        proposed = second_stage_inputs(found, points, model.spec, model.refine.seen)
        if not len(proposed.proposals):
            continue
        compared += 1
        asked = refine_scan(points, proposed, proposed.proposals, model.refine.neighbors)
        with torch.inference_mode():
            wanted = refiner(collate_scans([asked]))
        ours = wanted.confidence.numpy(), wanted.residuals.numpy()
        theirs = runtime.refine(refine_inputs(asked))
        for name, one, other in zip(("confidence", "residuals"), ours, theirs, strict=True):
            worst = max(worst, require_close(f"refine `{name}`", one, other, MAP_TOLERANCE, number))
        scores = model.refine.scores
        difference = require_same_refined(proposed.proposals, ours, theirs, model.spec, scores, number)
        worst_box, worst_yaw = max(worst_box, difference.center_size_m), max(worst_yaw, difference.yaw_rad)
    return Parity(worst, worst_box, worst_yaw, require_compared(compared), MAP_TOLERANCE)
