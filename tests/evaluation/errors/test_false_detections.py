"""What is said of things whose shape is known."""

import numpy as np
import pytest

from asca_pillars.data.insertion.ground_fit import fit_ground
from asca_pillars.evaluation.errors.box_errors import Surroundings, describe
from tests.evaluation.errors.made_frames import GROUND_Z_M, column, ground

PERSON = np.array([15.0, 0.0, GROUND_Z_M + 0.9, 0.8, 0.6, 1.8, 0.3])
CAR = np.array([15.0, 0.0, GROUND_Z_M + 0.75, 4.0, 1.6, 1.5, 0.0])


def at(box: np.ndarray, *things: np.ndarray) -> Surroundings:
    points = np.concatenate([ground(), *things])
    (found,) = describe(points, fit_ground(points), [box])
    return found


def test_posts_that_go_on_and_bollards_in_a_row() -> None:
    found = at(PERSON, column(15, 0, 2.8, reflectance=0.9))
    assert found.traits == ("tall", "bright")
    assert found.top_m == pytest.approx(2.75, abs=0.06) and found.box_top_m == pytest.approx(1.8, abs=0.06)
    assert found.distance_m == pytest.approx(15) and found.reflectance == pytest.approx(0.9)
    assert found.points == pytest.approx(5 * (1.9 - 0.2) / 0.05, abs=11)
    assert at(PERSON, column(15, 0, 1.0)).traits == ("low",)
    row = [column(15, y, 1.0) for y in (-0.9, 0.0, 0.9)]
    assert at(PERSON, *row).traits == ("low", "beside")
    assert at(PERSON, *(column(15, y, 1.0) for y in (-2.5, 0, 2.5))).traits == ("low",), "none within a metre"


def test_the_end_of_a_wall_and_four_posts_that_outline_a_car() -> None:
    wall = [column(15, y, 1.9) for y in np.arange(0, 8, 0.2)]
    found = at(PERSON, *wall)
    assert found.traits == ("beside", "attached")
    assert found.cluster_length_m == pytest.approx(7.8 + 0.2, abs=0.1) and found.cluster_width_m < 0.3
    posts = [column(x, y, 1.3) for x in (13.2, 16.8) for y in (-0.7, 0.7)]
    found = at(CAR, *posts)
    assert found.traits == ("hollow",) and found.middle == 0
    assert at(CAR, *posts, *(column(x, 0, 1.3) for x in (14.5, 15.5))).traits == ()


def test_few_points_none_and_no_ground() -> None:
    few = at(PERSON, column(15, 0, 1.5)[::12])
    assert "few points" in few.traits and 0 < few.points < 20
    none = at(PERSON)
    assert none.points == 0 and none.traits == ("few points",) and np.isnan(none.top_m)
    (found,) = describe(column(15, 0, 1.0), None, [PERSON])
    assert found.top_m == pytest.approx(0.95, abs=0.01) and found.bottom_m == pytest.approx(0.25, abs=0.05)
    assert describe(column(15, 0, 1.0), None, []) == []
