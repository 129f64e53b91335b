"""Reader of trajectory.csv and of what is like it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.geometry.types import Floats
from protocols.session.calibration import TrajectoryTable
from protocols.session.observations import DEFAULT_LABEL

_COLUMNS = ("time", "x", "y", "z", "std")


def read_trajectory(file: Path) -> tuple[TrajectoryTable, ...]:
    """The trajectories in a trajectory.csv, by label in order of appearance. Raises InputError."""
    tables = []
    for label, rows in read_labelled_rows(file, _COLUMNS, "calibrate again").items():
        table = rows[np.lexsort(rows.T[::-1])]
        tables.append(TrajectoryTable(label, table[:, 0], table[:, 1:4], table[:, 4]))
    return tuple(tables)


def read_labelled_rows(file: Path, columns: Sequence[str], remedy: str) -> dict[str, Floats]:
    """The numbers (n, columns) of each label of a trajectory. Raises InputError: file, line, what, remedy."""
    reader = csv.DictReader(io.StringIO(read_text(file, "trajectory")))
    rows: dict[str, list[list[float]]] = {}
    try:
        missing = [key for key in columns if key not in (reader.fieldnames or [])]
        if missing:
            raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)
        for row in reader:
            try:
                values = [float(row[key]) for key in columns]
            except (TypeError, ValueError):
                what = f"{', '.join(columns)} are not all numbers"
                raise InputError(what, file=file, line=reader.line_num, remedy=remedy) from None
            if not np.isfinite(values).all():
                raise InputError("a number is not finite", file=file, line=reader.line_num, remedy=remedy)
            rows.setdefault(row.get("label") or DEFAULT_LABEL, []).append(values)
    except csv.Error as error:
        raise InputError(f"cannot be read: {error}", file=file, remedy=remedy) from None
    return {label: np.array(listed) for label, listed in rows.items()}
