"""Sweeps of Argoverse 2: Apache Arrow feather files with the columns x, y, z and intensity, one row per point."""

from pathlib import Path
from typing import Any

import numpy as np

from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.base.files import require_content
from asca_pillars.base.installation import install_command
from asca_pillars.scans.records import StoredPoints

_FEW_ROWS = 2**23
"""Rows that a file of any size may have; a column of equal numbers is compressed to nearly nothing."""


def read_feather(path: Path) -> StoredPoints:
    """Read the points of a sweep, with the stored intensity.

    Raises:
        ScanError: not a feather file, or one without these columns.
        AscaError: pyarrow is not installed.
    """
    table = feather_table(path, ("x", "y", "z", "intensity"), (), ScanError)
    xyz = np.column_stack([table[name] for name in "xyz"]).astype(np.float32)
    return StoredPoints(xyz, table["intensity"], table["intensity"].dtype)


def feather_table(
    path: Path, numbers: tuple[str, ...], texts: tuple[str, ...], error: type[AscaError]
) -> dict[str, Any]:
    """Read columns of numbers and of texts of a feather file, each as an array (N,).

    Missing values are -1 in columns of integers, NaN in those of other numbers and None in those of texts.

    Raises:
        AscaError: pyarrow is not installed.
        error: not a feather file, or a column is missing or of another type.
    """
    try:
        import pyarrow
        from pyarrow import compute, dataset, feather
    except ModuleNotFoundError:
        raise AscaError(f"{path}: pyarrow not installed: {install_command('import')}") from None
    try:
        require_content(path, error)
        rows, most = dataset.dataset(path, format="feather").count_rows(), max(_FEW_ROWS, 2 * path.stat().st_size)
        if rows > most:
            raise error(f"{path}: {rows} rows, at most {most} are read of a file of its size; copy or export it again")
        table = feather.read_table(path, memory_map=False)
    except (pyarrow.ArrowException, OSError) as reason:
        raise error(
            f"{path}: not a readable feather file ({' '.join(str(reason).split())[:100]}); copy it again"
        ) from None
    if missing := [name for name in (*numbers, *texts) if name not in table.column_names]:
        raise error(
            f"{path}: no column `{missing[0]}` (there are: {', '.join(table.column_names)}); give a file of Argoverse 2"
        )
    arrays = {}
    for name in (*numbers, *texts):
        try:
            column = table[name]
            column = compute.fill_null(column, -1) if pyarrow.types.is_signed_integer(column.type) else column
            arrays[name] = column.to_numpy()
        except (pyarrow.ArrowException, KeyError, ValueError):  # a duplicate name, or a column that is not text
            arrays[name] = np.zeros(0, bool)
        of_texts = arrays[name].dtype.kind == "O" and all(isinstance(value, str | None) for value in arrays[name])
        if not (of_texts if name in texts else arrays[name].dtype.kind in "iuf"):
            raise error(f"{path}: column `{name}` is not what Argoverse 2 has there; copy the file again")
    return arrays
