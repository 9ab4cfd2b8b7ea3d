"""Tables of text or numbers as files and data frames have them, each row with its line."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from difffilter.errors import LogError

__all__ = ["MARK", "Column", "Table", "read_table", "table_of"]

#: First words of a file that this library wrote for itself.
MARK = "# difffilter log"
#: Characters that are read at once: lines are cut nowhere else.
PART = 1 << 24
#: Bytes from which on pyarrow reads a file, where it is installed.
LARGE = 1 << 24

Column = NDArray[Any] | list[str]


@dataclass(frozen=True)
class Table:
    """Columns by name: texts, or numbers with NaN where there is none.

    Attributes:
        where: file name, for messages; lines: of each row.
        plain: whether this library wrote it: its names and units are the library's own.
    """

    where: str
    columns: dict[str, Column]
    lines: NDArray[np.int64]
    plain: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.columns)


def read_table(path: Path, separator: str = ",", decimal: str = ".") -> Table:
    """A file as a table, by the ending of its name: CSV, Parquet, Feather, MAT, npz.

    Raises:
        LogError: names the file and, of CSV, the line.
    """
    if path.suffix.lower() in FRAMES:
        return _from_library(path)
    large = _large(path, separator, decimal)
    if large is not None:
        return large
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read as CSV: {error}") from None
    plain, skipped = text.startswith(MARK), 0
    if plain:
        _, _, text = text.partition("\n")
        skipped, separator, decimal = 1, ",", "."
    if not text:
        raise LogError(f"{path}: found an empty file, expected a header line")
    head, _, body = text.partition("\n")
    body = body.replace("\r\n", "\n")
    if '"' not in head and decimal == "." and _even(body):
        header = _header(path, head.rstrip("\r").split(separator), 1 + skipped)
        numbers = _numbers(body, len(header), separator)
        if numbers is not None:
            lines = np.arange(len(numbers)) + 2 + skipped
            columns: dict[str, Column] = dict(zip(header, numbers.T, strict=True))
            return Table(str(path), columns, lines, plain)
    return _by_rows(path, text, (separator, decimal), plain)


def _large(path: Path, separator: str, decimal: str) -> Table | None:
    """A large table of numbers by pyarrow, where it is installed; None for all other files.

    What it refuses is read by rows, which says why: texts, quotes, blank lines, infinity.
    """
    try:
        if path.stat().st_size < LARGE:
            return None
        import pyarrow as arrow
        from pyarrow import csv as arrow_csv

        with path.open("rb") as file:
            head = file.readline(1 << 20)
            plain = head.decode("utf-8-sig").startswith(MARK)
            head = file.readline(1 << 20) if plain else head
    except (ImportError, OSError, UnicodeDecodeError):
        return None
    separator, decimal = (",", ".") if plain else (separator, decimal)
    line = head.decode("utf-8-sig").rstrip("\r\n")
    if line.count('"') % 2 or not line:
        return None
    names = _header(path, next(csv.reader([line], delimiter=separator)), 1 + plain)
    if "" in names:
        return None
    try:
        found = arrow_csv.read_csv(
            str(path),
            arrow_csv.ReadOptions(skip_rows=1 + plain, column_names=names, block_size=PART),
            arrow_csv.ParseOptions(delimiter=separator, quote_char=False, ignore_empty_lines=False),
            arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(names, arrow.float64()),
                null_values=["", "nan", "NaN"],
                decimal_point=decimal,
            ),
        )
    except (arrow.ArrowInvalid, arrow.ArrowKeyError):
        return None
    columns: dict[str, Column] = {}
    for name in names:
        column = found.column(name).to_numpy()
        if np.isinf(column).any():
            return None
        columns[name] = column
    if np.isnan(np.stack([columns[name] for name in names])).all(0).any():
        return None  # a blank line: lines and rows differ
    return Table(str(path), columns, np.arange(found.num_rows) + 2 + plain, plain)


def _header(path: Path, names: list[str], line: int) -> list[str]:
    names = [name.strip() for name in names]
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise LogError(f"{path}, line {line}: found column {min(repeated)!r} twice, expected once")
    return names


def _even(body: str) -> bool:
    """Whether lines are lines: no quote, no lone return, no blank one."""
    return bool(body) and not any(odd in body for odd in ('"', "\r", "\n\n")) and body[0] != "\n"


def _numbers(body: str, width: int, separator: str) -> NDArray[np.float64] | None:
    """All fields as numbers; None where some are not: the rows are then read one by one."""
    parts, at = [], 0
    while at < len(body):
        end = body.find("\n", at + PART)
        end = len(body) if end < 0 else end + 1
        part = body[at:end]
        at = end
        twice = separator * 2
        while twice in part:
            part = part.replace(twice, f"{separator}nan{separator}")
        part = part.replace(f"{separator}\n", f"{separator}nan\n")
        part = part.replace(f"\n{separator}", f"\nnan{separator}")
        part = f"nan{part}" if part.startswith(separator) else part
        part = f"{part}nan" if part.endswith(separator) else part
        try:
            read = np.loadtxt(
                io.StringIO(part), delimiter=separator, ndmin=2, comments=None, dtype=np.float64
            )
        except ValueError:
            return None
        if read.shape[1] != width or np.isinf(read).any():
            return None
        parts.append(read)
    return np.concatenate(parts) if parts else None


def _by_rows(path: Path, text: str, form: tuple[str, str], plain: bool) -> Table:
    """Rows one by one: texts, quotes, blank lines, and an error with its line."""
    separator, decimal = form
    skipped = 1 if plain else 0
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    rows: list[list[str]] = []
    lines: list[int] = []
    header: list[str] = []
    start = 1 + skipped
    try:
        for row in reader:
            line, start = start, reader.line_num + skipped + 1
            if not header:
                header = _header(path, row or [""], line)
                continue
            if not row:
                continue  # the blank line that many tools leave at the end
            if len(row) != len(header):
                raise LogError(
                    f"{path}, line {line}: found {len(row)} fields, expected {len(header)}"
                )
            rows.append(row)
            lines.append(line)
    except csv.Error as error:
        raise LogError(f"{path}: cannot be read as CSV: {error}") from None
    columns: dict[str, Column] = {}
    for name, fields in zip(header, zip(*rows, strict=True), strict=False) if rows else ():
        texts = [field.strip() for field in fields]
        columns[name] = [t.replace(",", ".") for t in texts] if decimal == "," else texts
    if not rows:
        columns = {name: [] for name in header}
    return Table(str(path), columns, np.array(lines, dtype=np.int64), plain)


#: How each kind of file is read, with the library that reads it.
FRAMES = {".parquet": "pandas", ".feather": "pandas", ".mat": "scipy", ".npz": "numpy"}


def _from_library(path: Path) -> Table:
    kind = path.suffix.lower()
    if not path.is_file():
        raise LogError(f"{path}: cannot be read: no such file")
    try:
        if kind == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                return table_of({name: stored[name] for name in stored.files}, str(path))
        if kind == ".mat":
            from scipy.io import loadmat

            stored = loadmat(path, squeeze_me=True)
            found = {k: np.atleast_1d(v) for k, v in stored.items() if not k.startswith("__")}
            return table_of(found, str(path))
        import pandas

        frame = pandas.read_parquet(path) if kind == ".parquet" else pandas.read_feather(path)
        return table_of(frame, str(path))
    except ImportError:
        raise LogError(
            f"{path}: needs {FRAMES[kind]}, expected it installed: pip install 'difffilter[logs]'"
        ) from None
    except (OSError, ValueError, TypeError, NotImplementedError) as error:
        raise LogError(f"{path}: cannot be read as {kind[1:]}: {error}") from None


def table_of(frame: Any, where: str = "frame") -> Table:
    """A table of a pandas or polars frame, or of a mapping of names to arrays.

    Raises:
        LogError: columns of different lengths, or none.
    """
    columns: dict[str, Column] = {}
    for name in frame.keys() if hasattr(frame, "keys") else frame.columns:
        values = frame[name]
        array = values.to_numpy() if hasattr(values, "to_numpy") else np.asarray(values)
        if array.ndim != 1:
            raise LogError(
                f"{where}: column {name!s:.80}: found {array.ndim} dimensions, expected 1"
            )
        if array.dtype.kind == "M":
            array = array.astype("datetime64[ns]").astype(np.int64)
        if array.dtype.kind not in "iufb":
            columns[str(name)] = ["" if v is None or v != v else str(v) for v in array.tolist()]
        else:
            columns[str(name)] = array
    lengths = {len(column) for column in columns.values()}
    if len(lengths) != 1:
        raise LogError(
            f"{where}: found columns of {sorted(lengths)} rows, expected as many in each"
        )
    return Table(where, columns, np.arange(1, lengths.pop() + 1))
