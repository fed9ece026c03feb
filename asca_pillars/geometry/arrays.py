"""Aliases of NumPy array types; shapes are given in the docstrings."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Floating = NDArray[np.floating[Any]]
"""Any floating-point type."""
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
