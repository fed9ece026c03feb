"""A random generator for streets, which take thousands of numbers one at a time.

NumPy's generator spends most of a single draw on finding out that it is one.
"""

from bisect import bisect_right
from itertools import accumulate
from typing import Any

import numpy as np


class ScalarDraws(np.random.Generator):
    """NumPy's generator with the same numbers in the same order; single ones come in half of the time or less."""

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """As of NumPy."""
        if size is None and isinstance(low, float) and isinstance(high, float) and low <= high:
            return low + (high - low) * self.random()
        return super().uniform(low, high, size)

    def choice(self, a: Any, size: Any = None, replace: bool = True, p: Any = None, axis: int = 0, **rest: Any) -> Any:  # type: ignore[override]
        """As of NumPy, but one of a list or a tuple is that item itself."""
        if size is not None or not isinstance(a, int | list | tuple):
            return super().choice(a, size, replace, p, axis, **rest)
        number = a if isinstance(a, int) else len(a)
        index = int(self.integers(number)) if p is None else self._index(p)
        return index if isinstance(a, int) else a[index]

    def _index(self, shares: Any) -> int:
        upto = list(accumulate(np.asarray(shares).tolist()))
        return bisect_right([share / upto[-1] for share in upto], self.random())


def draws_of(*seed: int) -> ScalarDraws:
    """The generator of numbers that name what it is for, as `np.random.default_rng(seed)` is."""
    return ScalarDraws(np.random.PCG64(seed))
