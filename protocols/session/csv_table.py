"""CSV files of numbers with named columns, mistakes with file, line and remedy; tables for notebooks."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.geometry.types import Bools, Floats, Ints

if TYPE_CHECKING:
    import pandas


_LARGEST_WHOLE = 2.0**53
"""Up to here a float represents every whole number."""


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """The n rows of a CSV file. columns: n cells by name. line: n line numbers in the file."""

    file: Path
    columns: dict[str, list[str]]
    line: list[int]

    def __len__(self) -> int:
        return len(self.line)

    def select(self, rows: Bools) -> CsvTable:
        """The rows of a mask (n,)."""
        kept = np.flatnonzero(rows)
        columns = {name: [cells[row] for row in kept] for name, cells in self.columns.items()}
        return CsvTable(self.file, columns, [self.line[row] for row in kept])

    def text(self, name: str) -> list[str]:
        """A column of n stripped cells."""
        return [cell.strip() for cell in self.columns[name]]

    def numbers(self, name: str, limit: float) -> Floats:
        """A column (n,) of numbers within ±limit. Raises InputError."""
        cells = self.columns[name]
        values = _numbers(cells)
        self.refuse(
            ~(np.abs(values) <= limit),
            lambda row: f"{name} {cells[row].strip()[:40]!r} is not a number up to {limit:g}",
        )
        return values

    def numbers_or_gaps(self, name: str) -> Floats:
        """A column (n,) of numbers, NaN where a cell is empty or says so. Raises InputError."""
        cells = self.columns[name]
        values = _numbers([cell if cell.strip() else "nan" for cell in cells])
        wrong = np.isnan(values)
        wrong[wrong] = [cells[row].strip().lower().lstrip("+-") not in ("", "nan") for row in np.flatnonzero(wrong)]
        self.refuse(wrong, lambda row: f"{name} {cells[row]!r} is not a number", "give a number, or leave it empty")
        return values

    def finite(self, name: str) -> Floats:
        """A column (n,) of finite numbers. Raises InputError."""
        values = _numbers(cells := self.text(name))
        remedy = "give one, or remove the row of a point that was not seen"
        self.refuse(~np.isfinite(values), lambda row: f"{name} {cells[row][:40]!r} is not a finite number", remedy)
        return values

    def whole(self, name: str) -> Ints:
        """A column (n,) of whole numbers. Raises InputError."""
        values = self.numbers(name, _LARGEST_WHOLE)
        self.refuse(values != np.round(values), lambda row: f"{name} {values[row]:g} is not a whole number")
        return values.astype(np.int64)

    def refuse(
        self, bad: Bools | np.bool_, what: Callable[[int], str], remedy: str = "correct or remove the row"
    ) -> None:
        """Raise InputError with the line of the first row (n,) that is ``bad``."""
        rows = np.flatnonzero(bad)
        if len(rows):
            row = int(rows[0])
            raise InputError(what(row), file=self.file, line=self.line[row], remedy=remedy)


def read_csv_header(file: Path, what: str) -> list[str]:
    """The names in the first line of a CSV file. Raises InputError. what: the file's purpose, for messages."""
    return [cell.strip() for cell in _read(file, what, 1)[0][0]]


def read_csv_table(
    file: Path, what: str, required: Sequence[str], optional: Sequence[str] = (), further: str = ""
) -> CsvTable:
    """Read the named columns; others are ignored. further: "[,size]" and the like, of which a missing required one is
    reminded. Raises InputError: file, line, what, remedy."""
    (header, *rows), (_, *lines) = _read(file, what)
    header = [cell.strip() for cell in header]
    used = (*required, *optional)
    twice = [name for name in used if header.count(name) > 1]
    if twice:
        raise InputError(f"column {twice[0]} is named twice", file=file, line=1, remedy="keep one")
    _check_columns(header, required, file, further)
    place = {name: header.index(name) for name in used if name in header}
    for row, line in zip(rows, lines, strict=True):
        _check_width(row, line, len(header), max(place.values()), file)
    if not rows:
        raise InputError("no rows below its first line", file=file, line=1, remedy=f"give the rows of the {what}")
    return CsvTable(file, {name: [row[at] for row in rows] for name, at in place.items()}, lines)


def _read(file: Path, what: str, most: int | None = None) -> tuple[list[list[str]], list[int]]:
    """The rows that are not empty, and their line numbers; at least one row."""
    rows: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(io.StringIO(read_text(file, f"{what} file")), strict=True)
    try:
        for row in reader:
            if "".join(row).strip():
                rows.append(row)
                lines.append(reader.line_num)
            if len(rows) == most:
                break
    except csv.Error as error:
        raise InputError(f"not CSV: {error}", file=file, line=reader.line_num, remedy="correct this row") from None
    if not rows:
        raise InputError("this file is empty", file=file, line=1, remedy=f"give the rows of the {what}")
    return rows, lines


def _check_columns(header: Sequence[str], required: Sequence[str], file: Path, optional: str) -> None:
    """Raise InputError if a required column is missing in the first line of a CSV file."""
    missing = [name for name in required if name not in header]
    if missing:
        remedy = f"the first line must name {','.join(required)}{optional}"
        if len(header) == 1 and (found := [sign for sign in (";", "\t", "|") if sign in header[0]]):
            remedy = f"its columns are separated by {found[0]!r}: separate them by commas, and decimals by points"
        raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)


def _check_width(row: Sequence[str], line: int, width: int, last: int, file: Path) -> None:
    """Raise InputError for a row without its column ``last``, or with cells beyond the ``width`` of the first line."""
    if len(row) <= last or (len(row) > width and any(cell.strip() for cell in row[width:])):
        remedy = "complete the row" if len(row) <= last else "name every column; quote text with commas; decimal points"
        raise InputError(f"{len(row)} columns where the first line has {width}", file=file, line=line, remedy=remedy)


def _numbers(cells: list[str]) -> Floats:
    """(n,) numbers, NaN where a cell is none."""
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        return np.array([_number(cell) for cell in cells])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan


def dataframe(columns: Mapping[str, Any]) -> pandas.DataFrame:
    """A pandas DataFrame of columns of equal length. Raises InputError where pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise InputError("pandas is not installed", remedy="pip install pandas") from None
    return pandas.DataFrame(dict(columns))
