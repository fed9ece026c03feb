"""Real objects beside simulated ones: made-up records with a known gap."""

import numpy as np
import pytest

from asca_pillars.sim.report.like_for_like import (
    ALL,
    NEIGHBORS,
    LikeRow,
    ObjectRecord,
    compare_objects,
    look_alikes,
    percentiles,
)


def objects(name: str, count: int, seed: int, *, more: float = 1.0, score: float = 0.0) -> list[ObjectRecord]:
    """Objects whose returns follow distance, view and occlusion; `more` times as many, and scored `score` higher."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        distance, view, occluded = rng.uniform(8, 50), rng.uniform(0, 90), int(rng.integers(0, 3))
        points = more * 60_000 * distance**-2 * (1 + np.sin(np.deg2rad(view))) / (1 + occluded) * rng.uniform(0.8, 1.25)
        lowest, wheels, middle, bright = rng.uniform(0.05, 0.15, 4)
        parts = (lowest, wheels, middle, 2.0, bright, points / 3, rng.uniform(0.2, 0.8) + score)
        made.append(ObjectRecord(name, distance, view, occluded, points, *parts))
    return made


def row(rows: list[LikeRow], name: str, measure: str) -> LikeRow:
    (found,) = [row for row in rows if (row.class_name, row.measure) == (name, measure)]
    return found


def test_gaps_are_measured_and_found_nowhere_else() -> None:
    rows = compare_objects(objects("Car", 60, 1), objects("Car", 3000, 2))
    for measure in ("points", "pillars", "lowest", "wheels", "middle", "bright", "score"):
        found = row(rows, "Car", measure)
        assert found.objects == 60
        assert found.ratio == pytest.approx(1.0, abs=0.12)
        assert abs(found.percentile - 0.5) < 3 * found.percentile_error
        assert found.ratio_interval[0] < 1.0 < found.ratio_interval[1]
    assert row(rows, "Car", "length_m").percentile == 0.5  # ties count half
    real = objects("Cyclist", 40, 3, more=1.6, score=-0.3)
    rows = compare_objects(real, objects("Cyclist", 3000, 4))
    points = row(rows, "Cyclist", "points")
    assert points.ratio == pytest.approx(1.6, rel=0.1)
    assert points.ratio_interval[0] < points.ratio < points.ratio_interval[1] and points.ratio_interval[0] > 1.3
    assert points.percentile > 0.85
    assert row(rows, "Cyclist", "score").percentile < 0.25


def test_look_alikes_are_alike_and_classes_with_few_objects_left_out() -> None:
    real, simulated = objects("Car", 20, 5), objects("Car", 4000, 6)
    for like_points in (False, True):
        for index, chosen in enumerate(look_alikes(real, simulated, like_points=like_points)):
            assert len(set(chosen)) == NEIGHBORS
            for other in (simulated[i] for i in chosen):
                assert other.occluded == real[index].occluded
                assert abs(np.log(other.distance_m / real[index].distance_m)) < 0.25
                assert abs(other.view_deg - real[index].view_deg) < 25
    among = np.array([[1.0, 2.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]])
    np.testing.assert_allclose(percentiles(np.array([2.0, 9.0]), among), [0.5, 1.0])
    real = objects("Car", 5, 1) + objects("Pedestrian", 4, 2) + objects("Cyclist", 3, 3)
    simulated = objects("Car", 200, 4) + objects("Pedestrian", 200, 5) + objects("Cyclist", NEIGHBORS - 1, 6)
    rows = compare_objects(real, simulated)
    assert {found.class_name for found in rows} == {"Car", "Pedestrian", ALL}
    assert row(rows, ALL, "score").objects == 9
    unscored = [record._replace(score=float("nan")) for record in simulated]
    assert not [found for found in compare_objects(real, unscored) if found.measure == "score"]
