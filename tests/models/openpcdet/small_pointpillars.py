"""A small PointPillars whose weights are imported."""

from asca_pillars.config.pillar import NetworkConfig
from asca_pillars.detection.decode import PostProcess
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits
from asca_pillars.ops.pillar.spec import PillarSpec

GRID = PillarGrid((4.8, 25.28), (-6.4, 8.96), (-3.0, 1.5), v_max_m=0.32, v_y_m=0.32, zones=1)


SLOTS = 6


SPEC = PillarSpec(
    post=PostProcess(nms_iou=0.01, candidates=200, max_detections=60),
    grid=GRID,
    limits=PillarLimits(2000, SLOTS),
    anchor_places="ends",
    anchor_scores="every",
)


NETWORK = NetworkConfig(
    cpa="none",
    pillar_channels=12,
    block_channels=(10, 12, 14),
    block_convs=(1, 2, 1),
    upsample_channels=8,
    empty_slots=True,
)
