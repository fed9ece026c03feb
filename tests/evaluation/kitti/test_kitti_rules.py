"""Rules and curves of KITTI's evaluation on a few boxes; test_average_precision has many."""

from dataclasses import replace

import pytest

from asca_pillars.evaluation.kitti.average_precision import evaluate
from tests.evaluation.kitti.kitti_objects import CAR, CLASSES, DONT_CARE, EVERY, as_frames, beside, counts, hit, results


def test_classes_detections_without_objects_and_frames_that_differ() -> None:
    mine = results([CAR, replace(CAR, type="Cyclist")], [hit()])
    assert mine.curve("Cyclist", "3d", "easy") is None and mine.curve("Car", "3d", "easy") is not None
    assert mine.to_json()["Cyclist"] == dict.fromkeys(("bbox", "bev", "3d", "aos"))
    assert mine.mean_ap("3d", "easy") == mine.curves["Car", "3d", "easy"].r40
    mine = results([], [hit()], ([DONT_CARE], []))
    curve = mine.curve("Car", "3d", "hard")
    assert curve is not None and (curve.counted, curve.r40, curve.r11, curve.r40_cap) == (0, 0, 0, 0)
    assert len(curve.thresholds) == len(curve.fp) == 0
    # An average over classes leaves out a class of which nothing could be found.
    assert mine.mean_ap("3d", "hard") is None
    assert results([], []).curves == {}
    assert evaluate([], []).overall.frames == 0
    assert results([CAR], [], ([DONT_CARE], [])).curves == {}
    (truth,), (found,) = as_frames([[CAR]], [[hit()]])
    with pytest.raises(ValueError, match="same frames"):
        evaluate([truth], [replace(found, frame_id="1")])
    with pytest.raises(ValueError, match="same frames"):
        evaluate([truth, replace(truth, frame_id="1")], [found])


@pytest.mark.parametrize(("name", "limit"), [("Car", 0.7), ("Cyclist", 0.5)])
def test_dont_care_areas_excuse_by_the_share_of_the_detection(name: str, limit: float) -> None:
    """However large the area; and the shares of two areas do not add up."""
    label = replace(CAR, type=name)
    x1, y1, x2, y2 = beside(CAR, 4).bbox

    def false(*shares: float) -> int:
        areas = [replace(DONT_CARE, bbox=(x1 - 200, y1 - 50, x1 + s * (x2 - x1), y2 + 50)) for s in shares]
        return counts([label, *areas], [hit(label), hit(beside(label, 4))], name=name)[2]

    assert [false(limit + 0.01), false(limit - 0.01), false(limit - 0.01, limit - 0.01), false()] == [0, 1, 1, 1]


def test_precision_by_hand() -> None:
    """Three objects, false positives between them: 1/1, 2/4 and 3/5 at entries 0, 1, 2, then nothing."""
    truth = [beside(CAR, place) for place in range(3)]
    false = [hit(beside(CAR, place), score) for place, score in ((4, 0.8), (5, 0.7))]
    found = [*(hit(item, score) for item, score in zip(truth, (0.9, 0.6, 0.3), strict=True)), *false]
    for metric in EVERY:
        curve = results(truth, found).curve("Car", metric, "moderate")
        assert curve is not None and curve.thresholds.tolist() == [0.9, 0.6, 0.3]
        # The running maximum lifts 2/4 to 3/5.
        assert curve.precision.tolist() == [1.0, 0.6, 0.6, *[0.0] * 38]
        assert (curve.tp.tolist(), curve.fp.tolist(), curve.fn.tolist()) == ([1, 2, 3], [0, 2, 2], [2, 1, 0])
        # Entry 0 alone of 0, 4 .. 40; entries 1 and 2 of 1 .. 40.
        assert curve.r11 == pytest.approx(100 / 11) and curve.r40 == pytest.approx(120 / 40)
        assert curve.r40_cap == 100 * 2 / 40 and curve.r11_cap == 100 / 11


def test_a_band_ignores_what_stands_outside() -> None:
    """Distances 5, 10 and 15 m; the low end belongs to a band, the high end does not."""
    truth = [beside(CAR, n, x_m=3.0 * (n + 1), z_m=4.0 * (n + 1)) for n in range(3)]
    found = [hit(item, 0.9 - 0.1 * n) for n, item in enumerate(truth)]
    alone = hit(beside(CAR, 5, x_m=0.0, z_m=12.0), 0.95)
    bands = [(0.0, 10.0), (10.0, 15.0), (15.0, 99.0), (99.0, 100.0)]
    evaluation = evaluate(*as_frames([truth], [[alone, *found]]), CLASSES, bands_m=bands)
    assert list(evaluation.bands) == bands
    for metric in (*EVERY, "aos"):
        curves = [evaluation.bands[band].curves["Car", metric, "easy"] for band in bands]
        assert [curve.counted for curve in curves] == [1, 1, 1, 0]
        assert [curve.tp.tolist() for curve in curves] == [[1], [1], [1], []]
        assert [curve.fp.tolist() for curve in curves] == [[0], [1], [0], []]
    assert evaluation.overall.curves["Car", "3d", "easy"].counted == 3
