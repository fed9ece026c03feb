"""A small checkpoint with a sparse neck, and its smallest scans."""

import numpy as np

from asca_pillars.models.checkpoint import Checkpoint
from tests.export.tiny import tiny_checkpoint
from tests.helpers.scenes import SPEC

NOTHING = np.empty((0, 4), np.float32)
ONE_POINT = np.array([[10.0, 0.5, -1.0, 0.3]], np.float32)


def sparse_checkpoint(rule: str) -> Checkpoint:
    spec = SPEC.with_score_threshold(0.02)  # random weights are never sure of anything
    return tiny_checkpoint("channel", spec, neck="sparse", active_cells=rule)
