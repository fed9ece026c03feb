"""One-to-one matching: against hand-made cases, and the best one against trying everything."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from asca_pillars.detection.targets import UNMATCHED, best_assignments, match_by_overlap


def greatest_sum(overlap: NDArray[np.float64]) -> float:
    """The greatest total overlap: tries every way to give each object one detection or a stand-in for none."""
    rows, columns = overlap.shape
    padded = np.vstack([overlap, np.zeros((columns, columns))])
    ways = permutations(range(rows + columns), columns)
    return max(sum(padded[row, column] for column, row in enumerate(way)) for way in ways)


@settings(max_examples=60)
@given(st.integers(0, 4), st.integers(1, 3), st.data())
def test_best_assignment_of_every_prefix(rows: int, columns: int, data: st.DataObject) -> None:
    # Few different values, so that there are ties and objects that nothing overlaps.
    values = st.lists(st.sampled_from([0, 0, 0.5, 0.6, 0.61, 0.8, 1]), min_size=rows * columns, max_size=rows * columns)
    overlap = np.array(data.draw(values), dtype=np.float64).reshape(rows, columns)
    holders = best_assignments(overlap)
    assert holders.shape == (rows + 1, columns)
    for known, row in enumerate(holders):
        held = np.flatnonzero(row != UNMATCHED)
        assert len(set(row[held])) == len(held) and (row[held] < known).all()
        assert (overlap[row[held], held] > 0).all()
        np.testing.assert_allclose(overlap[row[held], held].sum(), greatest_sum(overlap[:known]), atol=1e-9)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1))
def test_crowds(seed: int, share: float) -> None:
    """Where many overlap many: the longest chains there are, against SciPy's solution."""
    optimize = pytest.importorskip("scipy.optimize")
    rng = np.random.default_rng(seed)
    overlap = rng.uniform(0.5, 1, (30, 15)) * (rng.random((30, 15)) < share)
    for known, row in enumerate(best_assignments(overlap)):
        held = np.flatnonzero(row != UNMATCHED)
        best = overlap[optimize.linear_sum_assignment(overlap[:known], maximize=True)].sum()
        np.testing.assert_allclose(overlap[row[held], held].sum(), best, atol=1e-9)


def test_matches_by_hand() -> None:
    assert best_assignments(np.array([[0.6], [0.9], [0.7]])).tolist() == [[UNMATCHED], [0], [1], [1]]
    assert best_assignments(np.empty((2, 0))).shape == (3, 0)
    assert best_assignments(np.empty((0, 2))).tolist() == [[UNMATCHED, UNMATCHED]]
    # The first takes the second object, so the second one gets the first; 0.5 is enough, the fourth has too little.
    overlap = np.array([[0.6, 0.8, 0.0], [0.5, 0.9, 0.0], [0.7, 0.7, 0.0], [0.0, 0.0, 0.4]])
    detections, objects = match_by_overlap(overlap, 0.5)
    assert (detections.tolist(), objects.tolist()) == ([0, 1], [1, 0])
    assert [part.tolist() for part in match_by_overlap(overlap[:0], 0.5)] == [[], []]
