"""Tables of several frames as one: rows of one frame after those of the other, the row of zeros behind the last."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def stack_rows(tables: Sequence[NDArray[np.int32]], rows: Sequence[int]) -> NDArray[np.int32]:
    """Tables (M_i, ...) of indices into features of `rows[i]` rows each -> one into all of them, (sum of M_i, ...).

    What is missing, row rows[i], becomes row sum(rows).
    """
    starts, total = np.concatenate([[0], np.cumsum(rows)]).astype(np.int32), sum(rows)
    moved = [
        np.where(table == count, np.int32(total), table + start)
        for table, count, start in zip(tables, rows, starts[:-1], strict=True)
    ]
    return np.concatenate(moved)


def stack_cells(cells: Sequence[NDArray[np.int32]], cells_per_frame: int) -> NDArray[np.int32]:
    """Flat indices (M_i,) on each frame's map -> (sum of M_i,) on the maps of all frames, one after the other."""
    return np.concatenate([each + np.int32(frame * cells_per_frame) for frame, each in enumerate(cells)])
