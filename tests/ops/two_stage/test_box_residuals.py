"""Residuals of a refinement: round trips, half a turn, and by hand."""

import math

import numpy as np
import pytest
from hypothesis import given

from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.ops.two_stage.rois import decode_refinement, encode_refinement
from tests.ops.points.boxes_near import CHANGES, PROPOSALS, changed


@given(PROPOSALS, CHANGES)
def test_round_trip(proposal: np.ndarray, change: tuple[np.ndarray, np.ndarray, float]) -> None:
    box = changed(proposal, change)
    residuals = encode_refinement(box[None], proposal[None])
    assert -math.pi / 2 <= residuals[0, 6] <= math.pi / 2
    (back,) = decode_refinement(residuals, proposal[None])
    np.testing.assert_allclose(back[:6], box[:6], rtol=1e-5, atol=2e-5)
    assert wrap_angle(float(back[6]) - box[6], math.pi) == pytest.approx(0, abs=1e-5)
    # Refinement does not turn the front to the back.
    assert abs(wrap_angle(float(back[6]) - proposal[6])) <= math.pi / 2 + 1e-5


@given(PROPOSALS, CHANGES)
def test_half_a_turn_of_the_box_changes_nothing(
    proposal: np.ndarray, change: tuple[np.ndarray, np.ndarray, float]
) -> None:
    box = changed(proposal, change)
    turned = box + np.array([0, 0, 0, 0, 0, 0, math.pi])
    one, other = encode_refinement(np.stack([box, turned]), np.stack([proposal, proposal]))
    np.testing.assert_allclose(one[:6], other[:6])
    assert wrap_angle(float(one[6]) - float(other[6]), math.pi) == pytest.approx(0, abs=1e-5)


def test_by_hand() -> None:
    # 3 by 4 m: the diagonal is 5. The heading is +y, so a box 1 m farther along y lies 1 m ahead.
    proposal = np.array([[10.0, 0, -1, 3, 4, 2, math.pi / 2]])
    box = np.array([[10.0, 1, -0.5, 6, 4, 1, math.pi / 2 + 0.1]])
    expected = [1 / 5, 0, 0.5 / 2, math.log(2), 0, -math.log(2), 0.1]
    assert encode_refinement(box, proposal)[0] == pytest.approx(expected, abs=1e-6)


def test_no_boxes() -> None:
    none = np.empty((0, 7), np.float32)
    assert encode_refinement(none, none).shape == decode_refinement(none, none).shape == (0, 7)
