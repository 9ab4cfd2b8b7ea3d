"""Columns of numbers written as CSV or Parquet, in parts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from difffilter.errors import InputError

__all__ = ["Columns", "CsvParts", "ParquetParts", "parts_for"]

#: By name: numbers, NaN where there is none; or texts.
Columns = Mapping[str, NDArray[Any] | list[str]]
#: Rows of a part from which on pyarrow writes it where it is installed: the same numbers, but
#: 1.0 as 1.
MANY = 100_000


class CsvParts:
    """A CSV file, part by part; an empty field where there is no number."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.begun = file, False

    def write(self, columns: Columns) -> None:
        """Append rows: all parts have the same columns."""
        if not self.begun:
            self.file.write((",".join(columns) + "\n").encode())
            self.begun = True
        arrow = _arrow() if len(next(iter(columns.values()))) >= MANY else None
        if arrow is not None:
            import pyarrow.csv as csv

            plain = csv.WriteOptions(include_header=False, quoting_style="none")
            csv.write_csv(_arrow_table(arrow, columns), self.file, plain)
            return
        texts = [_texts(column) for column in columns.values()]
        rows = map(",".join, zip(*texts, strict=True))
        self.file.write(("\n".join(rows) + "\n").encode())

    def close(self) -> None:
        """Nothing is left to write."""


class ParquetParts:
    """A Parquet file, part by part; null where there is no number."""

    def __init__(self, file: BinaryIO) -> None:
        arrow = _arrow()
        if arrow is None:
            raise InputError("Parquet: needs pyarrow: pip install 'difffilter[logs]'")
        self.arrow, self.file = arrow, file
        self.writer: Any = None

    def write(self, columns: Columns) -> None:
        """Append rows: all parts have the same columns."""
        import pyarrow.parquet as parquet

        table = _arrow_table(self.arrow, columns)
        if self.writer is None:
            self.writer = parquet.ParquetWriter(self.file, table.schema)
        self.writer.write_table(table)

    def close(self) -> None:
        """Write the end."""
        if self.writer is not None:
            self.writer.close()


def parts_for(path: str, file: BinaryIO) -> CsvParts | ParquetParts:
    """The writer for a name: Parquet for ``.parquet``, else CSV."""
    return ParquetParts(file) if path.lower().endswith(".parquet") else CsvParts(file)


def _texts(column: NDArray[Any] | list[str]) -> list[str]:
    if isinstance(column, list):
        return column
    return [repr(v) if math.isfinite(v) else "" for v in np.asarray(column).tolist()]


def _arrow() -> ModuleType | None:
    try:
        import pyarrow
    except ImportError:
        return None
    module: ModuleType = pyarrow
    return module


def _arrow_table(arrow: ModuleType, columns: Columns) -> Any:
    arrays = [
        arrow.array(c)
        if isinstance(c, list)
        else arrow.array(np.ascontiguousarray(c), mask=~np.isfinite(c))
        for c in columns.values()
    ]
    return arrow.table(arrays, names=list(columns))
