"""Rotation matrices against scipy's, about every axis."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from asca_pillars.geometry.rotations import of_quaternions, of_roll_pitch_yaw

quaternions = st.tuples(*[st.floats(-2, 2)] * 4)
angles = st.tuples(*[st.floats(-7, 7)] * 3)


@given(st.lists(quaternions, min_size=1, max_size=4))
def test_quaternions_of_any_length_and_direction(drawn: list[tuple[float, ...]]) -> None:
    assume(all(np.linalg.norm(one) > 1e-3 for one in drawn))
    expected = Rotation.from_quat(np.array(drawn)[:, [1, 2, 3, 0]]).as_matrix()  # scipy has the real part last
    np.testing.assert_allclose(of_quaternions(np.array(drawn)), expected, atol=1e-12)
    np.testing.assert_allclose(of_quaternions(np.array(drawn[0])), expected[0], atol=1e-12)


@given(st.lists(angles, min_size=1, max_size=4))
def test_roll_comes_first_and_yaw_last_about_axes_that_stand_still(drawn: list[tuple[float, ...]]) -> None:
    expected = Rotation.from_euler("xyz", np.array(drawn)).as_matrix()
    np.testing.assert_allclose(of_roll_pitch_yaw(np.array(drawn)), expected, atol=1e-12)
    np.testing.assert_allclose(of_roll_pitch_yaw(np.array(drawn[0])), expected[0], atol=1e-12)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1), (1e200, 0, 0, 1e200)])
def test_what_is_no_rotation_does_not_look_like_one(quaternion: tuple[float, ...]) -> None:
    rotations = of_quaternions(np.array([quaternion, (1, 0, 0, 0)]))
    assert np.isnan(rotations[0]).all() and rotations[1].tolist() == np.eye(3).tolist()
