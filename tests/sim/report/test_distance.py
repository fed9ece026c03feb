"""Distances of histograms: values by hand, and what chance does."""

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from asca_pillars.sim.report.comparison import coarse, jensen_shannon, noise_of_points, noise_of_units


def test_distances_by_hand_and_zero_has_a_bin_of_its_own() -> None:
    assert jensen_shannon([1, 0], [0, 5]) == pytest.approx(1.0)
    assert jensen_shannon([3, 1, 0], [6, 2, 0]) == 0
    # p = (1/2, 1/2), q = (1, 0), middle (3/4, 1/4): half of log2(4/3) + (log2(2/3) + log2(2)) / 2.
    expected = np.sqrt((np.log2(4 / 3) + (np.log2(2 / 3) + 1) / 2) / 2)
    assert jensen_shannon([1, 1], [7, 0]) == pytest.approx(expected) == jensen_shannon([7, 0], [1, 1])
    rng = np.random.default_rng(0)
    p, q = rng.random((2, 30)) * rng.integers(0, 2, (2, 30))
    assert jensen_shannon(p, q) == pytest.approx(jensenshannon(p, q, base=2))
    counts = np.zeros(100)
    counts[[0, 1, 4, 5, 99]] = (7, 1, 2, 4, 8)
    merged = coarse(counts)
    assert merged.shape == (21,)
    assert merged[[0, 1, 2, 20]].tolist() == [7, 3, 4, 8] and merged.sum() == counts.sum()
    assert (coarse(np.stack([counts, counts])) == merged).all()


def test_noise_shrinks_with_the_sample_and_grows_with_what_differs() -> None:
    counts = np.arange(1, 22)
    few, many = noise_of_points(counts, 100), noise_of_points(counts, 10_000)
    assert 0.08 < few < 0.25
    assert few / many == pytest.approx(10, rel=0.2)
    # Half of the objects are black, half are white: four of them are rarely two and two.
    stack = np.zeros((40, 2))
    stack[:20, 0] = stack[20:, 1] = 1000
    assert noise_of_units(stack, 4) > 0.15 > noise_of_points(stack.sum(axis=0), 4000) * 10
    assert noise_of_units(np.ones((40, 5)), 4) == 0
