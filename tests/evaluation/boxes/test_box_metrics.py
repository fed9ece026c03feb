"""AP by IoU, nuScenes' and Argoverse 2's metrics: cases worked out by hand, and a twin of loops on random frames."""

import math
from dataclasses import replace

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


def test_labels_against_themselves_are_perfect() -> None:
    frames = [
        replace(one, visible=np.ones(len(one.objects), bool), found=one.objects, found_types=one.object_types)
        for one in brute.random_frames(3)
    ]
    frames = [replace(one, scores=np.linspace(0.5, 0.9, len(one.objects))) for one in frames]
    assert all(score.ap in (None, pytest.approx(100)) for score in iou_scores(frames, NAMES))
    for score in nuscenes_scores(frames, NAMES):
        if score.band == "all":
            assert score.ap == pytest.approx(100) and (score.ate_m, score.ase, score.aoe_rad) == (
                0,
                pytest.approx(0),
                0,
            )
    for argo in argoverse_scores(frames, NAMES):
        assert argo.ap == pytest.approx(100) and argo.cds == pytest.approx(100)


def test_iou_ap_by_hand() -> None:
    # Four objects; by score: true, false, true. Recalls 1/4 and 2/4 at precisions 1 and 2/3: 1/4 + 1/4 * 2/3.
    objects = [box(10), box(20), box(30), box(40)]
    found = [(0.9, box(10)), (0.8, box(50)), (0.7, box(20))]
    assert ap([frame(objects, found)]) == pytest.approx(100 * (1 / 4 + 1 / 6))
    # Shifted by 1 m of 4 m: IoU 3/5.
    assert ap([frame([box(10)], [(0.9, box(11))])]) == 100 and ap([frame([box(10)], [(0.9, box(11))])], 0.7) == 0
    # From above only, half as high is no matter.
    low = box(10, size=(4, 2, 0.5))
    assert ap([frame([box(10)], [(0.9, low)])], metric="bev") == 100 and ap([frame([box(10)], [(0.9, low)])]) == 0


def test_a_double_detection_is_false_and_the_better_score_keeps_the_object() -> None:
    assert ap([frame([box(10), box(20)], [(0.9, box(10)), (0.8, box(10)), (0.7, box(20))])]) == pytest.approx(
        100 * (1 / 2 + 1 / 2 * 2 / 3)
    )


def test_what_holds_no_point_is_neither_missed_nor_false() -> None:
    found = [(0.9, box(20)), (0.8, box(10))]
    assert ap([frame([box(10), box(20)], found, visible=[True, False])]) == 100
    assert ap([frame([box(10)], found)]) == 50
    assert ap([frame([box(10)], [], visible=[False])]) is None


def test_bands_take_an_object_with_its_detection() -> None:
    # 29.9 m and 30.1 m away match each other, whichever band is asked; the false one at 40 m stays in its own.
    frames = [frame([box(29.9), box(-20), box(0, 45)], [(0.9, box(30.1)), (0.95, box(40))])]
    values = {band: ap(frames, 0.5, band) for band in BANDS}
    assert values == {
        "all": pytest.approx(100 / 6),
        "0-30 m": 50,
        "30-50 m": 0,
        "50+ m": None,
        "ahead": 50,
        "beside": 0,
        "behind": 0,
    }


def test_nuscenes_by_hand() -> None:
    # Two objects, one found 0.7 m off and a quarter larger in each direction, turned by 0.2: recall 1/2 at precision 1.
    found = box(10.7, yaw=0.2, size=(5, 2.5, 1.875))
    score = nuscenes_scores([frame([box(10), box(30)], [(0.9, found)])], ["Car"])[0]
    # Recalls 0.11 .. 0.50 count fully: 40 of 90 samples; at 0.5 m nothing matches.
    assert score.ap_by_distance == pytest.approx((0, 4000 / 90, 4000 / 90, 4000 / 90))
    assert score.ap == pytest.approx(3000 / 90)
    assert (score.ate_m, score.ase, score.aoe_rad) == pytest.approx((0.7, 1 - 0.8**3, 0.2))


def test_nuscenes_errors_are_running_means_at_the_recalls() -> None:
    # Errors 0.2 m at score 0.8 (recall 1/2) and 0.6 m at 0.4 (recall 1). Up to recall 1/2 the score is 0.8, the mean
    # 0.2; beyond, the score falls linearly to 0.4 and the mean rises linearly to (0.2 + 0.6) / 2 = 0.4.
    found = [(0.8, box(10.2)), (0.4, box(30.6))]
    score = nuscenes_scores([frame([box(10), box(30)], found)], ["Car"])[0]
    assert score.ate_m == pytest.approx((40 * 0.2 + sum(0.2 + 0.2 * k / 50 for k in range(1, 51))) / 90)


def test_nuscenes_floors() -> None:
    # One of ten found: a recall of 0.1 is not above the floor. Precision below 0.1 counts nothing.
    score = nuscenes_scores([frame([box(10 * k) for k in range(1, 11)], [(0.9, box(10))])], ["Car"])[0]
    assert (score.ap, score.ate_m, score.ase, score.aoe_rad) == (0, 1, 1, 1)
    wrong = [(0.9 - 0.01 * k, box(-100 - 10 * k)) for k in range(20)]
    assert nuscenes_scores([frame([box(10)], [*wrong, (0.1, box(10))])], ["Car"])[0].ap == 0
    # A match at exactly the limit is none.
    assert nuscenes_scores([frame([box(10)], [(0.9, box(10.5))])], ["Car"])[0].ap_by_distance == pytest.approx(
        (0, 100, 100, 100)
    )


def test_nuscenes_counts_from_the_first_recall_above_the_floor_on() -> None:
    # 11 of 100 found, all at score 0.9 and 0.3 m off: of the 90 samples from recall 0.11 on the first one alone counts.
    objects = [box(10.0 * k) for k in range(1, 101)]
    found = [(0.9, box(10.0 * k + 0.3)) for k in range(1, 12)]
    score = nuscenes_scores([frame(objects, found)], ["Car"])[0]
    assert score.ap == pytest.approx(100 / 90) and score.ate_m == pytest.approx(0.3)
    score = nuscenes_scores([frame(objects, found[:10])], ["Car"])[0]
    assert score.ap == 0 and score.ate_m == 1


def test_argoverse_by_hand() -> None:
    # One of two found, 1.5 m off in z: a true positive at 2 and 4 m. Recall 1/2: 51 of 101 samples.
    low = [10, 0, -2.5, 4, 2, 1.5, math.pi / 2]
    score = argoverse_scores([frame([box(10), box(30)], [(0.9, low)])], ["Car"])[0]
    assert score.ap == pytest.approx(100 * 51 / 101 / 2)
    assert (score.ate_m, score.ase, score.aoe_rad) == pytest.approx((1.5, 0, math.pi / 2))
    assert score.cds == pytest.approx(100 * 51 / 101 / 2 * (0.25 + 1 + 0.5) / 3)


def test_argoverse_size_error_is_the_published_vector() -> None:
    # The API's test of `iou_3d_axis_aligned`: sizes (4, 10, 3) and (9, 5, 2) have 4 * 5 * 2 / (9 * 10 * 3) in common.
    found = [(0.9, box(10, size=(4, 10, 3)))]
    score = argoverse_scores([frame([box(10, size=(9, 5, 2))], found)], ["Car"])[0]
    assert score.ase == pytest.approx(1 - 40 / 270, abs=1e-12)
    assert score.ap == pytest.approx(100) and score.cds == pytest.approx(100 * (1 + 40 / 270 + 1) / 3)
    # nuScenes divides by the volume of the union, 120 + 90 - 40.
    nusc = nuscenes_scores([frame([box(10, size=(9, 5, 2))], found)], ["Car"])[0]
    assert nusc.ase == pytest.approx(1 - 40 / 170)


def test_argoverse_gives_an_object_to_the_best_score_alone() -> None:
    # The better one is nearest to the object at 10 but 3 m off; the other cannot have it, though it is on the spot.
    found = [(0.9, box(13)), (0.8, box(10))]
    score = argoverse_scores([frame([box(10)], found)], ["Car"])[0]
    # At 4 m recall 1 has precision 1, then 1/2 with the second one, and the API samples the latter at recall 1 itself.
    assert score.ap == pytest.approx(100 * 100.5 / 101 / 4) and score.ate_m == 2 and score.cds == 0
    # nuScenes lets it: at 0.5, 1 and 2 m precision rises linearly from 0 to 1/2 at recall 1, and exceeds 0.1 by
    # 0.005 k at the 80 recalls beyond 0.2: 0.005 * 3240 / 90 / 0.9.
    ap_by_distance = nuscenes_scores([frame([box(10)], found)], ["Car"])[0].ap_by_distance
    assert ap_by_distance is not None and ap_by_distance[:3] == pytest.approx([20] * 3)


def test_argoverse_limits_range_and_number() -> None:
    crowd = [(0.9 - 0.001 * k, box(-10 - k)) for k in range(100)]
    assert argoverse_scores([frame([box(10)], [*crowd, (0.1, box(10))])], ["Car"])[0].ap == 0
    far = frame([box(10), box(151)], [(0.9, box(10)), (0.95, box(151))])
    assert argoverse_scores([far], ["Car"])[0].ap == pytest.approx(100)


@pytest.mark.parametrize("seed", range(12))
def test_the_twin_agrees_on_random_frames(seed: int) -> None:
    frames = brute.random_frames(seed)
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
