"""The Jensen-Shannon distance of two histograms, and how much of it chance alone would give."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_DRAWS = 200
_GROUP = 5


def jensen_shannon(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Distance (...) of histograms (..., B) of any positive sums: 0 for equal shapes, 1 where they share nothing.

    The square root of the divergence in bits, so that it is a metric and ends at 1; `jensenshannon` of SciPy gives
    the same with `base=2`, and 0.83 of it with its default, natural logarithms.
    """
    p, q = np.asarray(first, np.float64), np.asarray(second, np.float64)
    p, q = p / p.sum(axis=-1, keepdims=True), q / q.sum(axis=-1, keepdims=True)
    middle = (p + q) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(p > 0, p * np.log2(p / middle), 0.0) + np.where(q > 0, q * np.log2(q / middle), 0.0)
    return np.asarray(np.sqrt(np.maximum(terms.sum(axis=-1) / 2, 0.0)))


def coarse(counts: ArrayLike) -> NDArray[np.float64]:
    """Reflectances (..., 100) in steps of 0.01 as (..., 21): exactly 0, then 20 bins of 0.05.

    A real histogram of a few hundred points has most of its hundred bins empty or nearly so: compared bin by bin with
    any other it would be far away. What is reported as 0 is a kind of its own, no dark shade.
    """
    fine = np.asarray(counts, np.float64)
    groups = fine.reshape(*fine.shape[:-1], -1, _GROUP).sum(axis=-1)
    groups[..., 0] -= fine[..., 0]
    return np.concatenate([fine[..., :1], groups], axis=-1)


def noise_of_points(counts: ArrayLike, size: int) -> float:
    """Mean distance of a histogram (B,) from `size` points drawn from it."""
    shares = np.asarray(counts, np.float64) / np.sum(counts)
    draws = np.random.default_rng(0).multinomial(size, shares, _DRAWS)
    return float(jensen_shannon(draws, shares).mean())


def noise_of_units(stack: NDArray[np.float64], units: int) -> float:
    """Mean distance of the sum of histograms (U, B) from that of `units` of them drawn at random.

    The points of one object share its paint or its clothes: a few objects differ from many by more than as many
    independent points would.
    """
    rng = np.random.default_rng(0)
    draws = np.stack([stack[rng.integers(len(stack), size=units)].sum(axis=0) for _ in range(_DRAWS)])
    return float(jensen_shannon(draws, stack.sum(axis=0)).mean())
