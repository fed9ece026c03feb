"""Pairs of boxes: a proposal, and a box not far from it."""

import math

import numpy as np
from hypothesis import strategies as st

PROPOSALS = st.builds(
    lambda place, size, yaw: np.array([*place, *size, yaw]),
    st.tuples(st.floats(0, 70), st.floats(-40, 40), st.floats(-2, 1)),
    st.tuples(*[st.floats(0.4, 10)] * 3),
    st.floats(-7, 7) | st.sampled_from([k * math.pi / 4 for k in range(-4, 5)]),
)
CHANGES = st.builds(
    lambda shift, scale, turn: (np.array(shift), np.array(scale), turn),
    st.tuples(*[st.floats(-2, 2)] * 3),
    st.tuples(*[st.floats(0.5, 2)] * 3),
    st.floats(-7, 7),
)


def changed(proposal: np.ndarray, change: tuple[np.ndarray, np.ndarray, float]) -> np.ndarray:
    """The proposal shifted, scaled and turned."""
    shift, scale, turn = change
    return np.concatenate([proposal[:3] + shift, proposal[3:6] * scale, [proposal[6] + turn]])
