"""AP by IoU, nuScenes' and Argoverse 2's metrics: cases worked out by hand, and a twin of loops on random frames."""

import math

import numpy as np
import pytest

from asca_pillars.evaluation.boxes.argoverse_metrics import argoverse_scores
from asca_pillars.evaluation.boxes.box_pairs import BANDS, EvaluatedFrame
from asca_pillars.evaluation.boxes.iou_metrics import IOUS, IouScore, fixed_scores, iou_scores
from asca_pillars.evaluation.boxes.nuscenes_metrics import nuscenes_scores
from tests.evaluation.boxes import box_brute_force as brute

NAMES = ("Car", "Forklift")


def box(x: float, y: float = 0.0, *, yaw: float = 0.0, size: tuple[float, float, float] = (4, 2, 1.5)) -> list[float]:
    return [x, y, -1.0, *size, yaw]


def frame(objects: list, found: list[tuple[float, list]], *, visible: list[bool] | None = None) -> EvaluatedFrame:
    boxes = np.array([item for _, item in found], np.float64).reshape(-1, 7)
    return EvaluatedFrame(
        "0",
        np.array(objects, np.float64).reshape(-1, 7),
        ["Car"] * len(objects),
        np.array([True] * len(objects) if visible is None else visible, bool),
        boxes,
        ["Car"] * len(found),
        np.array([score for score, _ in found]),
    )


def ap(frames: list[EvaluatedFrame], least: float = 0.5, band: str = "all", metric: str = "3d") -> float | None:
    return next(s.ap for s in iou_scores(frames, ["Car"]) if (s.metric, s.min_iou, s.band) == (metric, least, band))


def test_what_holds_no_point_is_neither_missed_nor_false() -> None:
    found = [(0.9, box(20)), (0.8, box(10))]
    assert ap([frame([box(10), box(20)], found, visible=[True, False])]) == 100
    assert ap([frame([box(10)], found)]) == 50
    assert ap([frame([box(10)], [], visible=[False])]) is None


def test_nuscenes_floors_and_the_first_recall_above_them() -> None:
    # One of ten found: a recall of 0.1 is not above the floor. Precision below 0.1 counts nothing.
    score = nuscenes_scores([frame([box(10 * k) for k in range(1, 11)], [(0.9, box(10))])], ["Car"])[0]
    assert (score.ap, score.ate_m, score.ase, score.aoe_rad) == (0, 1, 1, 1)
    wrong = [(0.9 - 0.01 * k, box(-100 - 10 * k)) for k in range(20)]
    assert nuscenes_scores([frame([box(10)], [*wrong, (0.1, box(10))])], ["Car"])[0].ap == 0
    # A match at exactly the limit is none.
    assert nuscenes_scores([frame([box(10)], [(0.9, box(10.5))])], ["Car"])[0].ap_by_distance == pytest.approx(
        (0, 100, 100, 100)
    )
    # 11 of 100 found, all at score 0.9 and 0.3 m off: of the 90 samples from recall 0.11 on the first one alone counts.
    objects = [box(10.0 * k) for k in range(1, 101)]
    found = [(0.9, box(10.0 * k + 0.3)) for k in range(1, 12)]
    score = nuscenes_scores([frame(objects, found)], ["Car"])[0]
    assert score.ap == pytest.approx(100 / 90) and score.ate_m == pytest.approx(0.3)
    score = nuscenes_scores([frame(objects, found[:10])], ["Car"])[0]
    assert score.ap == 0 and score.ate_m == 1


def test_argoverse_by_hand_and_its_published_size_error() -> None:
    # One of two found, 1.5 m off in z: a true positive at 2 and 4 m. Recall 1/2: 51 of 101 samples.
    low = [10, 0, -2.5, 4, 2, 1.5, math.pi / 2]
    score = argoverse_scores([frame([box(10), box(30)], [(0.9, low)])], ["Car"])[0]
    assert score.ap == pytest.approx(100 * 51 / 101 / 2)
    assert (score.ate_m, score.ase, score.aoe_rad) == pytest.approx((1.5, 0, math.pi / 2))
    assert score.cds == pytest.approx(100 * 51 / 101 / 2 * (0.25 + 1 + 0.5) / 3)
    # The API's test of `iou_3d_axis_aligned`: sizes (4, 10, 3) and (9, 5, 2) have 4 * 5 * 2 / (9 * 10 * 3) in common.
    found = [(0.9, box(10, size=(4, 10, 3)))]
    score = argoverse_scores([frame([box(10, size=(9, 5, 2))], found)], ["Car"])[0]
    assert score.ase == pytest.approx(1 - 40 / 270, abs=1e-12)
    assert score.ap == pytest.approx(100) and score.cds == pytest.approx(100 * (1 + 40 / 270 + 1) / 3)
    # nuScenes divides by the volume of the union, 120 + 90 - 40.
    nusc = nuscenes_scores([frame([box(10, size=(9, 5, 2))], found)], ["Car"])[0]
    assert nusc.ase == pytest.approx(1 - 40 / 170)


def test_argoverse_limits_range_and_number() -> None:
    crowd = [(0.9 - 0.001 * k, box(-10 - k)) for k in range(100)]
    assert argoverse_scores([frame([box(10)], [*crowd, (0.1, box(10))])], ["Car"])[0].ap == 0
    far = frame([box(10), box(151)], [(0.9, box(10)), (0.95, box(151))])
    assert argoverse_scores([far], ["Car"])[0].ap == pytest.approx(100)


@pytest.mark.parametrize("seed", range(5))
def test_the_twin_agrees_on_random_frames(seed: int) -> None:
    frames = brute.random_frames(seed, frames=5)
    for score in iou_scores(frames, NAMES):
        expected = brute.iou_ap(frames, score.class_name, score.min_iou, _keeps(score), flat=score.metric == "bev")
        assert score.ap == (None if expected is None else pytest.approx(expected))
    for nusc in nuscenes_scores(frames, NAMES):
        if nusc.band == "all":
            expected_ap, errors = brute.nuscenes(frames, nusc.class_name)
            assert nusc.ap == pytest.approx(expected_ap)
            assert (nusc.ate_m, nusc.ase, nusc.aoe_rad) == pytest.approx(tuple(errors))
    for argo in argoverse_scores(frames, NAMES):
        expected_ap, errors, cds = brute.argoverse(frames, argo.class_name)
        assert (argo.ap, argo.cds) == (pytest.approx(expected_ap), pytest.approx(cds))
        assert (argo.ate_m, argo.ase, argo.aoe_rad) == pytest.approx(tuple(errors))


def test_fixed_scores_by_hand() -> None:
    frames = [frame([box(10), box(20), box(-20)], [(0.9, box(10.5)), (0.6, box(45)), (0.5, box(20)), (0.2, box(-20))])]
    results = {item.band: item for item in fixed_scores(frames, ["Car"], {"Car": 0.4})}
    assert (results["all"].found, results["all"].detections, results["all"].objects) == (2, 3, 3)
    assert (results["behind"].recall, results["behind"].precision) == (0, None)
    assert (results["30-50 m"].recall, results["30-50 m"].precision) == (None, 0)
    assert results["all"].best_score == 0.2  # 3 of 3 with one false: F1 6/7


def test_no_detections_at_all() -> None:
    nothing = [frame([box(10)], [])]
    assert ap(nothing) == 0 and nuscenes_scores(nothing, ["Car"])[0].ap == 0
    assert argoverse_scores(nothing, ["Car"])[0].ap == 0
    assert fixed_scores(nothing, ["Car"], {"Car": 0.3})[0].best_score is None


def _keeps(score: IouScore):
    assert score.min_iou in IOUS
    return lambda one: bool(BANDS[score.band](np.array([one]))[0])
