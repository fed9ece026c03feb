"""Samples of the second stage and their batches."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.models.two_stage.preparation import RefineSample, collate_samples
from asca_pillars.ops.two_stage.first_stage import run_first_stage
from asca_pillars.ops.two_stage.prepare import RefineSettings, refine_scan, roi_features
from tests.helpers.scenes import make_scene
from tests.models.two_stage.random_stage import SETTINGS, RandomStage
from tests.models.two_stage.small_refiner import prepare_sample

GEOMETRY = RefineSettings(ball_samples=6, grid_size=2, grid_samples=5)


def sample(seed: int, draw: int = 0) -> RefineSample:
    points, boxes = make_scene(seed)[:2]
    frame = LabeledFrame(f"{seed:06d}", points, boxes, np.array([0, 0, 1, 2]))
    proposed = run_first_stage(RandomStage(), points, SETTINGS)
    return prepare_sample(frame, proposed, GEOMETRY, 12, np.random.default_rng(draw))


def test_a_sample_depends_on_its_generator_alone() -> None:
    one, same, other = sample(0), sample(0), sample(0, draw=1)
    assert one.targets.rois.tolist() == same.targets.rois.tolist() != other.targets.rois.tolist()
    np.testing.assert_array_equal(one.scan.grid_indices[1], same.scan.grid_indices[1])


def test_points_that_no_ball_reaches_are_left_out_and_no_others() -> None:
    points = make_scene(0)[0]
    proposed = run_first_stage(RandomStage(), points, SETTINGS)
    found = refine_scan(points, proposed, proposed.proposals, GEOMETRY)
    away = np.linalg.norm(found.keypoints[:, None] - points[None, :, :3], axis=2)
    for radius_m, indices in zip(GEOMETRY.ball_radii_m, found.ball_indices, strict=True):
        inside = np.minimum((away < radius_m).sum(axis=1), GEOMETRY.ball_samples)
        for row, count in zip(indices, inside, strict=True):
            assert len(np.unique(row)) == pytest.approx(count, abs=0)
    with ThreadPoolExecutor(1) as executor:  # a second thread finds the same
        second = refine_scan(points, proposed, proposed.proposals, GEOMETRY, executor)
    for one, two in zip(
        found.ball_indices + found.grid_indices, second.ball_indices + second.grid_indices, strict=True
    ):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(found.grid_points, second.grid_points)
    features = roi_features(proposals := proposed.proposals)
    assert (features[:, :3].argmax(axis=1) == proposals.labels).all()
    np.testing.assert_allclose(1 / (1 + np.exp(-features[:, 3])), proposals.scores, rtol=1e-4)
    np.testing.assert_array_equal(features[:, 4:], proposals.boxes[:, 3:6])


def test_indices_of_a_batch_point_at_the_same_rows() -> None:
    samples = [sample(0), sample(1)]
    scans, (batch, targets) = [each.scan for each in samples], collate_samples(samples)
    assert targets.residuals.shape == (24, 7) and len(targets.keypoint_states) == len(batch.keypoints)
    rows = np.concatenate([s.points for s in scans] + [np.full((1, 4), np.nan)])
    for radius, together in enumerate(batch.ball_indices):
        alone = [np.concatenate([s.points, np.full((1, 4), np.nan)])[s.ball_indices[radius]] for s in scans]
        np.testing.assert_array_equal(rows[together.numpy()], np.concatenate(alone))
    rows = np.concatenate([s.keypoints for s in scans] + [np.full((1, 3), np.nan)])
    for radius, together in enumerate(batch.grid_indices):
        alone = [np.concatenate([s.keypoints, np.full((1, 3), np.nan)])[s.grid_indices[radius]] for s in scans]
        np.testing.assert_array_equal(rows[together.numpy()], np.concatenate(alone))
        assert any((s.grid_indices[radius] == len(s.keypoints)).any() for s in scans), "some balls are empty"


@pytest.mark.parametrize("change", [{"grid_size": 0}, {"ball_radii_m": (0.4, -1)}, {"grid_radii_m": ()}])
def test_impossible_settings(change: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(change))):
        RefineSettings(**change)
