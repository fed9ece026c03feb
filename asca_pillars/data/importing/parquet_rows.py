"""Rows of Apache Parquet files, for selected columns; lists are returned as arrays."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from asca_pillars.base.errors import AscaError, DatasetError
from asca_pillars.base.input_files import require_content
from asca_pillars.base.installation import install_command

_BATCH = 8  # rows in memory at once: a range image has millions of numbers


def parquet_rows(path: Path, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file by column: numbers and texts unchanged, lists as NumPy arrays, missing values as None.

    None also stands for a value that Python cannot represent, such as a date in the year 300,000.

    Raises:
        DatasetError: not a parquet file, or one without these columns.
        AscaError: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise AscaError(f"{path}: pyarrow not installed: {install_command('import')}") from None
    try:
        require_content(path, DatasetError)
        with parquet.ParquetFile(path) as file:
            names = file.schema_arrow.names
            if missing := [name for name in columns if name not in names]:
                raise DatasetError(f"{path}: no column `{missing[0]}`; give a file of Waymo's parquet form")
            for batch in file.iter_batches(_BATCH, columns=list(columns)):
                for row in range(batch.num_rows):
                    yield {name: _plain(batch.column(name)[row]) for name in columns}
    except (pyarrow.ArrowException, OSError, KeyError) as reason:  # KeyError: two columns of one name
        text = " ".join(str(reason).split())[:100]
        raise DatasetError(f"{path}: no readable parquet file ({text}); copy it again") from None


def _plain(value: Any) -> Any:
    items: Any = getattr(value, "values", None)  # of a list; None for a null list
    try:
        return value.as_py() if not hasattr(items, "to_numpy") else items.to_numpy(zero_copy_only=False)
    except (ValueError, TypeError, LookupError, OverflowError, NotImplementedError):  # includes Arrow's own
        return None
