"""Intervals of medians and ratios from frames that resemble their neighbors: the bootstrap over blocks of frames.

Neighboring frames of a drive show the same objects, so that single frames are no independent sample. Blocks of
BLOCK_FRAMES neighbors are drawn instead (Künsch, Annals of Statistics 1989). Where a dataset has parts (drives), parts
are drawn first, and blocks within each: the interval then tells what another set of drives may show.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BLOCK_FRAMES = 10
MIN_BLOCKS = 5
"""Values of fewer blocks have no interval: they may be of one object."""
DRAWS = 300
SHARE = 0.95
_SEED = 0

_Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Resamples:
    """How often each frame is drawn.

    Attributes:
        weights: (DRAWS, F) whole numbers.
        blocks: (F,) number of the block that each frame belongs to.
    """

    weights: _Doubles
    blocks: NDArray[np.int64]

    def median_interval(self, values: _Doubles, frames: NDArray[np.int64]) -> tuple[float, float] | None:
        """Interval of the median of values (N,), in their unit; None of too few blocks.

        Args:
            values: numbers.
            frames: index of the frame that each is from.
        """
        if len(np.unique(self.blocks[frames])) < MIN_BLOCKS:
            return None
        order = np.argsort(values, kind="stable")
        heaped = np.cumsum(self.weights[:, frames[order]], axis=1)
        total = heaped[:, -1]
        drawn = total > 0
        middle = (heaped[drawn] >= total[drawn, None] / 2).argmax(axis=1)
        return _interval(values[order][middle])

    def ratio_interval(self, parts: _Doubles, wholes: _Doubles) -> tuple[float, float] | None:
        """Interval of the ratio sum(parts) / sum(wholes), counts (F,) by frame; None of too few blocks."""
        if len(np.unique(self.blocks[wholes > 0])) < MIN_BLOCKS:
            return None
        whole = self.weights @ wholes
        drawn = whole > 0
        return _interval((self.weights @ parts)[drawn] / whole[drawn])


def resamples(parts: Sequence[NDArray[np.int64]], frames: int) -> Resamples:
    """Draw blocks of neighboring frames; the same draws for the same frames.

    Args:
        parts: indices of the frames of each part, in order; frames that are in none of them are drawn never.
        frames: how many there are.
    """
    generator = np.random.default_rng(_SEED)
    groups = [np.array_split(part, max(round(len(part) / BLOCK_FRAMES), 1)) for part in parts if len(part)]
    weights, number_of = np.zeros((DRAWS, frames)), np.full(frames, -1)
    for number, block in enumerate(block for group in groups for block in group):
        number_of[block] = number
    for row in weights:
        for part in generator.integers(len(groups), size=len(groups)):
            for block in generator.integers(len(groups[part]), size=len(groups[part])):
                row[groups[part][block]] += 1
    return Resamples(weights, number_of)


def _interval(drawn: _Doubles) -> tuple[float, float]:
    low, high = np.quantile(drawn, [(1 - SHARE) / 2, (1 + SHARE) / 2])
    return float(low), float(high)
