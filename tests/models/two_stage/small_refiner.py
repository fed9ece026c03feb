"""A small second stage, and its input as training draws it."""

import numpy as np
import torch

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.detections import Detections
from asca_pillars.models.two_stage.layers import BallSource, KeypointEncoder, PillarRefiner, RoiHead, SetAbstraction
from asca_pillars.models.two_stage.preparation import RefineBatch, RefineSample, collate_samples, sample_of
from asca_pillars.ops.points.sampling import farthest_points
from asca_pillars.ops.two_stage.decode import match_proposals, sample_rois
from asca_pillars.ops.two_stage.first_stage import SecondStageInputs
from asca_pillars.ops.two_stage.prepare import RefineSettings
from tests.helpers.scenes import make_scene

NAMES = ("Car", "Pedestrian", "Cyclist")
LABELS = np.array([0, 0, 1, 2])
SETTINGS = RefineSettings(grid_size=3, ball_samples=8, grid_samples=8)
BEV_CHANNELS = 3


def small_refiner(seed: int = 0) -> PillarRefiner:
    torch.manual_seed(seed)
    encode = KeypointEncoder([BallSource(1, 2, (8, 16))], BEV_CHANNELS, 16, weighting_channels=16)
    head = RoiHead(
        [SetAbstraction(16, (16, 16)) for _ in range(2)], 3, roi_channels=len(NAMES) + 4, hidden=32, dropout=0.0
    )
    return PillarRefiner(encode, head)


def proposed_frame(seed: int) -> tuple[LabeledFrame, SecondStageInputs]:
    """A scene with, for each of its boxes, three proposals not quite in its place, and one in none."""
    points, boxes = make_scene(seed)[:2]
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 1, (3, len(boxes), 7)) * [0.15, 0.1, 0.1, 0.1, 0.05, 0.05, 0.1]
    lost = np.array([[20, 6, -1, 4, 2, 1.5, 0.3]])
    moved = np.concatenate([*(boxes + noise), lost]).astype(np.float32)
    labels = np.append(np.tile(LABELS, 3), 0)
    detections = Detections(moved, rng.uniform(0.1, 0.9, len(moved)).astype(np.float32), labels, NAMES)
    keypoints = np.ascontiguousarray(points[farthest_points(points, 256), :3])
    bev = rng.normal(size=(len(keypoints), BEV_CHANNELS)).astype(np.float32)
    return LabeledFrame(f"{seed:06d}", points, boxes, LABELS), SecondStageInputs(detections, keypoints, bev)


def prepare_sample(
    frame: LabeledFrame, proposed: SecondStageInputs, settings: RefineSettings, rois: int, rng: np.random.Generator
) -> RefineSample:
    """Draw `rois` proposals of a frame and compute their neighbours and targets."""
    overlaps = match_proposals(proposed.proposals, frame.boxes, frame.labels)
    return sample_of(frame, proposed, overlaps, sample_rois(overlaps, rois, rng), settings)


def batch(seeds: tuple[int, ...]) -> RefineBatch:
    rng = np.random.default_rng(0)
    return collate_samples([prepare_sample(*proposed_frame(seed), SETTINGS, 16, rng) for seed in seeds])
