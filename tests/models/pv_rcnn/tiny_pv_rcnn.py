"""PV-RCNN on a grid so coarse and with so few channels that it is trained in seconds, and frames for it."""

import dataclasses
from typing import Any

import numpy as np
import torch

from asca_pillars.config.pv_rcnn import PvRcnnModel, PvRcnnNetwork
from asca_pillars.config.tree import Config, DataConfig, TrainConfig
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.proposals import AnchorProposals
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector, build_pv_rcnn_detector
from asca_pillars.models.pv_rcnn.preparation import LabeledVoxels
from asca_pillars.ops.pv_rcnn.prepare import SourceBalls, VoxelSetSettings
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid
from tests.helpers.scenes import make_scene

SPEC = VoxelSpec(
    post=PostProcess(nms_iou=0.1),
    grid=VoxelGrid((4.8, 25.6), (-6.4, 8.0), (-3.0, 1.0), (0.2, 0.2, 0.1)),
    last_stride=1,
    anchor_places="cells",
)
SETTINGS = VoxelSetSettings(
    keypoints=96,
    sources=(
        SourceBalls("points", (0.6, 1.2), (6, 6)),
        SourceBalls("conv2", (1.2,), (6,)),
        SourceBalls("conv4", (2.4,), (8,)),
    ),
    proposals=AnchorProposals(candidates=200, nms_iou=0.7, count=24),
    grid_size=3,
    grid_radii_m=(0.8, 1.6),
    grid_samples=6,
)
NETWORK = PvRcnnNetwork(
    voxel_channels=(4, 6, 8, 8, 12),
    block_channels=(16, 24),
    block_convs=(1, 1),
    upsample_channels=16,
    source_widths=((8, 8), (8, 8), (8, 8)),
    keypoint_channels=16,
    weighting_channels=16,
    grid_widths=(16, 16),
    hidden=32,
    dropout=0.0,
)
VARIANTS: dict[str, dict[str, Any]] = {
    "published": {},
    "gate": {"network": dataclasses.replace(NETWORK, gate="keypoint")},
    "dual attention": {"network": dataclasses.replace(NETWORK, attention="dual")},
    "residual dual attention": {"network": dataclasses.replace(NETWORK, attention="rda")},
    "adaptive scales": {
        "settings": dataclasses.replace(
            SETTINGS, sources=SETTINGS.sources[1:], scale_radii_m=(0.8, 1.6, 3.2), scale_samples=5
        ),
        "network": dataclasses.replace(
            NETWORK, source_widths=NETWORK.source_widths[1:], scale_widths=(8, 12, 16), scale_channels=8
        ),
    },
    "VectorPool": {"settings": dataclasses.replace(SETTINGS, vector_cells=2)},
    "distance IoU": {"box_loss": "va"},
    "deformed": {"settings": dataclasses.replace(SETTINGS, deform="paper")},
    "deformed as the authors": {"settings": dataclasses.replace(SETTINGS, deform="authors")},
}
"""What differs from `MODEL`."""
EVERYTHING: dict[str, Any] = {
    "network": dataclasses.replace(
        NETWORK, gate="keypoint", attention="rda", source_widths=((8, 8), (8, 8)), scale_widths=(8, 12)
    ),
    "settings": dataclasses.replace(
        SETTINGS,
        deform="paper",
        sources=(SourceBalls("points", (1.2,), (6,)), SETTINGS.sources[-1]),
        grid_radii_m=(1.6,),  # few sources and one radius: the graph of a cube is eight times that of a ball
        vector_cells=2,
        scale_radii_m=(0.8, 1.6),
        scale_samples=3,  # the graph takes time by the square of it
    ),
    "box_loss": "va",
}
MODEL = PvRcnnModel(
    spec=SPEC,
    settings=SETTINGS,
    network=NETWORK,
    training_proposals=AnchorProposals(candidates=400, nms_iou=0.8, count=64),
    rois=24,
    scores="both",
)


def tiny_detector(**changes: Any) -> PvRcnnDetector:
    """The same random weights each time."""
    torch.manual_seed(0)
    return build_pv_rcnn_detector(dataclasses.replace(MODEL, **changes))


def frame(seed: int) -> LabeledFrame:
    points, boxes, _ = make_scene(seed)
    return LabeledFrame(f"{seed:06d}", points, boxes, np.array([0, 0, 1, 2]))


def batch(detector: PvRcnnDetector, *frames: LabeledFrame) -> LabeledVoxels:
    return detector.preparation.collate([detector.preparation.prepare(each, None) for each in frames])


def tiny_config(model: PvRcnnModel = MODEL, **recipe: Any) -> Config:
    """Two epochs of two frames a step."""
    train = {"epochs": 2, "batch_size": 2, "learning_rate": 1e-2, "checkpoint_steps": 1} | recipe
    return Config(name="tiny_pv_rcnn", model=model, data=DataConfig(workers=0), train=TrainConfig(**train))
