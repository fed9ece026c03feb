"""Proposals and keypoints of a first stage."""

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.proposals import ProposalSettings
from asca_pillars.ops.two_stage.first_stage import (
    FirstStageOutputs,
    FirstStageSettings,
    KeypointSettings,
    run_first_stage,
)
from tests.helpers.scenes import SPEC, make_scene
from tests.models.two_stage.random_stage import CHANNELS, SETTINGS, RandomStage


def test_keypoints_are_points_near_proposals_and_some_scans_have_none() -> None:
    points, stage = make_scene(0)[0], RandomStage()
    found = run_first_stage(stage, points, SETTINGS)
    assert 0 < len(found.keypoints) <= 64
    assert (found.keypoints[:, None] == points[None, :, :3]).all(axis=2).any(axis=1).all()
    away = np.linalg.norm(found.keypoints[:, None, :2] - found.proposals.boxes[None, :, :2], axis=2)
    reach = np.hypot(found.proposals.boxes[:, 3], found.proposals.boxes[:, 4]) / 2 + SETTINGS.keypoints.margin_m
    assert (away < reach + 1e-4).any(axis=1).all()
    assert found.bev.shape == (len(found.keypoints), CHANNELS)
    found = run_first_stage(RandomStage(), np.empty((0, 4), np.float32), SETTINGS)
    assert found.keypoints.shape == (0, 3)
    assert found.bev.shape == (0, CHANNELS)
    settings = FirstStageSettings(ProposalSettings(score_threshold=1.0))
    found = run_first_stage(RandomStage(), make_scene(0)[0], settings)
    assert len(found.proposals) == len(found.keypoints) == 0


class PlacesStage(RandomStage):
    """Its neck says of each cell where it is."""

    def __call__(self, points: NDArray[np.float32]) -> FirstStageOutputs:
        x_m, y_m = SPEC.head_centers_m()
        neck = np.stack(np.meshgrid(x_m, y_m), axis=-1).astype(np.float32)
        return super().__call__(points)._replace(neck=neck)


def test_a_keypoint_reads_the_neck_at_its_own_place() -> None:
    found = run_first_stage(PlacesStage(), make_scene(0)[0], SETTINGS)
    own = found.keypoints[:, :2]
    lowest, highest = np.array([(centers[0], centers[-1]) for centers in SPEC.head_centers_m()]).T
    between = ((own > lowest) & (own < highest)).all(axis=1)
    assert between.sum() > 30, "beside the outermost cells the map's border counts"
    np.testing.assert_allclose(found.bev[between], own[between], atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        (lambda: ProposalSettings(nms_iou=1.5), "nms_iou 1.5"),
        (lambda: ProposalSettings(quotas=(3, 0)), "quotas"),
        (lambda: KeypointSettings(count=0), "count 0"),
    ],
)
def test_impossible_settings(settings: object, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        settings()  # type: ignore[operator]
