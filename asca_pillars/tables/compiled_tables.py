"""Whether numba runs the loops that build voxels and tables, or NumPy."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple


class TableKernels(NamedTuple):
    """The functions of these names in `table_kernels` and `voxel_kernels`."""

    clear_columns: Callable[..., None]
    enter_cells: Callable[..., None]
    mark_joined: Callable[..., int]
    list_cells: Callable[..., None]
    fill_table: Callable[..., None]
    fill_places: Callable[..., None]
    cells_of_points: Callable[..., None]
    mark_points: Callable[..., int]
    sum_points: Callable[..., None]


@cache
def load_table_kernels() -> TableKernels | None:
    """The compiled forms, or None where numba is missing; the first call on a machine compiles, some seconds.

    Apart from `geometry.kernels`, so that a detector without tables does not wait for them.
    """
    try:
        from asca_pillars.tables import table_kernels, voxel_kernels
    except ImportError:
        return None
    modules = table_kernels, voxel_kernels
    return TableKernels(*(next(getattr(m, name) for m in modules if hasattr(m, name)) for name in TableKernels._fields))
