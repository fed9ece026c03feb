"""Sweeps of Argoverse 2: Apache Arrow feather files with the columns x, y, z and intensity, one row per point."""

from pathlib import Path
from typing import Any

import numpy as np

from asca_pillars.data.scans.records import StoredPoints
from asca_pillars.errors import AscaError, ScanError
from asca_pillars.installation import install_command


def read_feather(path: Path) -> StoredPoints:
    """The points of a sweep, intensity as it is stored.

    Raises:
        ScanError: no feather file, or one without these columns.
        AscaError: pyarrow is not installed.
    """
    table = feather_table(path, ("x", "y", "z", "intensity"), (), ScanError)
    xyz = np.column_stack([table[name] for name in "xyz"]).astype(np.float32)
    return StoredPoints(xyz, table["intensity"], table["intensity"].dtype)


def feather_table(
    path: Path, numbers: tuple[str, ...], texts: tuple[str, ...], error: type[AscaError]
) -> dict[str, Any]:
    """Columns of numbers and columns of texts of a feather file, each an array (N,).

    Raises:
        AscaError: pyarrow is not installed.
        error: no feather file, or a column is missing or of another kind.
    """
    try:
        import pyarrow
        from pyarrow import feather
    except ModuleNotFoundError:
        raise AscaError(f"{path}: pyarrow not installed: {install_command('import')}") from None
    try:
        table = feather.read_table(path, memory_map=False)
    except (pyarrow.ArrowException, OSError) as reason:
        raise error(
            f"{path}: no readable feather file ({' '.join(str(reason).split())[:100]}); copy it again"
        ) from None
    if missing := [name for name in (*numbers, *texts) if name not in table.column_names]:
        raise error(
            f"{path}: no column `{missing[0]}` (there are: {', '.join(table.column_names)}); give a file of Argoverse 2"
        )
    arrays = {name: table[name].to_numpy() for name in (*numbers, *texts)}
    wrong = [name for name in numbers if arrays[name].dtype.kind not in "iuf"]
    wrong += [name for name in texts if not all(isinstance(value, str) for value in arrays[name])]
    if wrong:
        raise error(f"{path}: column `{wrong[0]}` is not what Argoverse 2 has there; copy the file again")
    return arrays
