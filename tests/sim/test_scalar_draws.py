"""The quicker generator draws what NumPy's does."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from asca_pillars.sim.world.streets import draws_of

numbers = st.floats(-1e3, 1e3)
shares = st.lists(st.floats(0.01, 1.0), min_size=1, max_size=9)


@example([0], 0.0, -0.0, [1.0])
@given(st.lists(st.integers(0, 2**62), min_size=1, max_size=4), numbers, numbers, shares)
def test_every_number_is_numpy_s(seed: list[int], low: float, high: float, weights: list[float]) -> None:
    low, high = sorted((low + 0.0, high + 0.0))  # NumPy refuses to draw between 0.0 and -0.0, which sorting leaves so
    ours, numpys = draws_of(*seed), np.random.default_rng(seed)
    items, p = [f"item {i}" for i in range(len(weights))], np.array(weights) / sum(weights)
    table = np.arange(6.0).reshape(2, 3)
    for draw in (
        lambda rng: rng.random(),
        lambda rng: rng.uniform(low, high),
        lambda rng: rng.uniform(),
        lambda rng: rng.uniform(low, high, 3).tolist(),
        lambda rng: rng.uniform((0.0, -1.0), (2, 4)).tolist(),
        lambda rng: rng.choice(items),
        lambda rng: rng.choice(tuple(items), p=p),
        lambda rng: rng.choice(len(items), p=p.tolist()),
        lambda rng: rng.choice(len(items)),
        lambda rng: rng.choice(items, 4).tolist(),
        lambda rng: rng.choice(table).tolist(),
        lambda rng: rng.normal(low, abs(high)),
    ):
        assert draw(ours) == draw(numpys)


def test_items_are_given_back_and_what_numpy_refuses_is_refused() -> None:
    item = object()
    assert draws_of(0).choice([item]) is item
    assert type(draws_of(0).uniform(0.0, 1.0)) is float
    with pytest.raises(ValueError, match="high - low"):
        draws_of(0).uniform(1.0, 0.0)
    with pytest.raises(ValueError, match="empty"):
        draws_of(0).choice(np.zeros(0))
