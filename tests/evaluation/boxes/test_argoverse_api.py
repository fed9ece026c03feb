"""The figures of Argoverse 2's own API on random frames; runs where `av2` is installed (`pip install av2`)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.evaluation.boxes.argoverse_metrics import argoverse_scores
from asca_pillars.evaluation.boxes.box_pairs import EvaluatedFrame
from tests.evaluation.boxes import box_brute_force as brute

pd = pytest.importorskip("pandas")
api = pytest.importorskip("av2.evaluation.detection.eval")
NAMES = ("Car", "Forklift")


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("stretch", [1.0, 4.0])
def test_figures_are_the_apis(seed: int, stretch: float) -> None:
    """With a stretch of 4 some objects and detections lie beyond the range that counts."""
    frames = [_stretched(frame, stretch) for frame in brute.random_frames(seed, frames=12)]
    table = _api_table(frames)
    for score in argoverse_scores(frames, NAMES):
        assert score.ap is not None and score.cds is not None
        ours = [score.ap / 100, score.ate_m, score.ase, score.aoe_rad, score.cds / 100]
        assert ours == pytest.approx(table.loc[score.class_name].tolist(), abs=1e-8)


def test_only_the_first_hundred_detections_of_a_frame_count() -> None:
    frame = brute.random_frames(3, frames=1)[0]
    rng = np.random.default_rng(0)
    crowd = np.repeat(frame.detections, 25, axis=0)
    crowd[:, :3] += rng.normal(0, 0.5, (len(crowd), 3))
    types, scores = [kind for kind in frame.detection_types for _ in range(25)], rng.random(len(crowd))
    many = [replace(frame, detections=crowd, detection_types=types, scores=scores)]
    assert max(types.count(name) for name in NAMES) > 100
    table = _api_table(many)
    for score in argoverse_scores(many, NAMES):
        assert score.ap is not None
        assert score.ap / 100 == pytest.approx(table.loc[score.class_name]["AP"], abs=1e-8)


def _stretched(frame: EvaluatedFrame, factor: float) -> EvaluatedFrame:
    """Every box moved out along x and y together with the object that is nearest to it."""
    shift = (factor - 1) * frame.objects[:, :2]
    if not len(shift):
        return frame
    nearest = np.linalg.norm(frame.detections[:, None, :2] - frame.objects[None, :, :2], axis=2).argmin(axis=1)
    objects, found = frame.objects.copy(), frame.detections.copy()
    objects[:, :2] += shift
    found[:, :2] += shift[nearest]
    return replace(frame, objects=objects, detections=found)


def _api_table(frames: Sequence[EvaluatedFrame]):
    config = api.DetectionCfg(eval_only_roi_instances=False, categories=NAMES)
    columns = [*config.affinity_thresholds_m, *api.TP_ERROR_COLUMNS, "is_evaluated"]
    found_rows, object_rows = [], []
    for frame in frames:
        for name in NAMES:
            own = np.array(frame.detection_types) == name
            scores = np.asarray(frame.scores)[own]
            found = np.column_stack([_cuboids(frame.detections[own]), scores])
            own = np.array(frame.object_types) == name
            objects = np.column_stack([_cuboids(frame.objects[own]), 3.0 * frame.visible[own]])
            of_found, of_objects = api.accumulate(found, objects, config)
            found_rows.append(pd.DataFrame(of_found, columns=columns).assign(category=name, score=scores))
            object_rows.append(pd.DataFrame(of_objects, columns=columns).assign(category=name))
    return api.summarize_metrics(
        pd.concat(found_rows, ignore_index=True), pd.concat(object_rows, ignore_index=True), config
    )


def _cuboids(boxes: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, 7) -> (N, 10), yaw as a quaternion."""
    half, none = boxes[:, 6] / 2, np.zeros(len(boxes))
    return np.column_stack([boxes[:, :6], np.cos(half), none, none, np.sin(half)])
