"""CSV files of numbers with named columns; every mistake is reported with file, line and remedy."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import check_columns, check_width

_LARGEST_WHOLE = 2.0**53
"""Up to here a float represents every whole number."""


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """The n rows of a CSV file. columns: n stripped cells by name. line: n line numbers in the file."""

    file: Path
    columns: dict[str, list[str]]
    line: list[int]

    def __len__(self) -> int:
        return len(self.line)

    def numbers(self, name: str, limit: float) -> Floats:
        """A column (n,) of numbers within ±limit. Raises InputError."""
        cells = self.columns[name]
        try:
            values = np.array(cells, dtype=np.float64)
        except ValueError:
            values = np.array([_number(cell) for cell in cells])
        self.refuse(
            ~(np.abs(values) <= limit), lambda row: f"{name} {cells[row][:40]!r} is not a number up to {limit:g}"
        )
        return values

    def numbers_or_gaps(self, name: str) -> Floats:
        """A column (n,) of numbers, NaN where a cell is empty. Raises InputError."""
        cells = self.columns[name]
        values = np.array([_number(cell or "nan") for cell in cells])
        wrong = np.isnan(values) & [cell.lower().lstrip("+-") not in ("", "nan") for cell in cells]
        self.refuse(wrong, lambda row: f"{cells[row]!r} is not a number", "give a number, or leave it empty")
        return values

    def whole(self, name: str) -> Ints:
        """A column (n,) of whole numbers. Raises InputError."""
        values = self.numbers(name, _LARGEST_WHOLE)
        self.refuse(values != np.round(values), lambda row: f"{name} {values[row]:g} is not a whole number")
        return values.astype(np.int64)

    def refuse(self, bad: Bools, what: Callable[[int], str], remedy: str = "correct or remove the row") -> None:
        """Raise InputError with the line of the first row (n,) that is ``bad``."""
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(what(row), file=self.file, line=self.line[row], remedy=remedy)


def read_csv_header(file: Path, what: str) -> list[str]:
    """The names in the first line of a CSV file. Raises InputError. what: the file's purpose, for messages."""
    return _read(file, what, 1)[0][0]


def read_csv_table(file: Path, what: str, required: Sequence[str], optional: Sequence[str] = ()) -> CsvTable:
    """Read the named columns; others are ignored. Raises InputError: file, line, what, remedy."""
    rows, lines = _read(file, what)
    header = rows[0]
    twice = [name for name in (*required, *optional) if header.count(name) > 1]
    if twice:
        raise InputError(f"column {twice[0]} is named twice", file=file, line=1, remedy="keep one")
    check_columns(header, required, file)
    place = {name: header.index(name) for name in (*required, *optional) if name in header}
    for row, line in zip(rows[1:], lines[1:], strict=True):
        check_width(row, line, len(header), max(place.values()), file)
    if len(rows) == 1:
        raise InputError("no rows below its first line", file=file, line=1, remedy=f"give the rows of the {what}")
    return CsvTable(file, {name: [row[at] for row in rows[1:]] for name, at in place.items()}, lines[1:])


def _read(file: Path, what: str, most: int | None = None) -> tuple[list[list[str]], list[int]]:
    """The rows that are not empty, with stripped cells, and their line numbers; at least one row."""
    rows: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(io.StringIO(read_text(file, f"{what} file")), strict=True)
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append(cells)
                lines.append(reader.line_num)
            if len(rows) == most:
                break
    except csv.Error as error:
        raise InputError(f"not CSV: {error}", file=file, line=reader.line_num, remedy="correct this row") from None
    if not rows:
        raise InputError("this file is empty", file=file, line=1, remedy=f"give the rows of the {what}")
    return rows, lines


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan
