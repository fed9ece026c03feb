"""Boxes drawn at random."""

import math

import numpy as np


def random_boxes(seed: int, count: int) -> np.ndarray:
    """(count, 7) float32."""
    rng = np.random.default_rng(seed)
    low, high = [1.0, -8.0, -2.0, 0.3, 0.3, 0.5, -math.pi], [30.0, 4.0, 0.0, 6.0, 3.0, 3.0, math.pi]
    return rng.uniform(low, high, (count, 7)).astype(np.float32)
