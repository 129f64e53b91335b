"""Reader of trajectory.csv."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.session.calibration import TrajectoryTable
from protocols.session.observations import DEFAULT_LABEL

_COLUMNS = ("time", "x", "y", "z", "std")


def read_trajectory(file: Path) -> tuple[TrajectoryTable, ...]:
    """The trajectories in a trajectory.csv, by label in order of appearance. Raises InputError."""
    remedy = "calibrate again"
    rows: dict[str, list[list[float]]] = {}
    try:
        for number, row in enumerate(csv.DictReader(io.StringIO(read_text(file, "trajectory"))), 2):
            try:
                values = [float(row[key]) for key in _COLUMNS]
            except (KeyError, TypeError, ValueError):
                what = f"{', '.join(_COLUMNS)} are not all numbers"
                raise InputError(what, file=file, line=number, remedy=remedy) from None
            if not np.isfinite(values).all():
                raise InputError("a number is not finite", file=file, line=number, remedy=remedy)
            rows.setdefault(row.get("label") or DEFAULT_LABEL, []).append(values)
    except csv.Error as error:
        raise InputError(f"cannot be read: {error}", file=file, remedy=remedy) from None
    tables = []
    for label, listed in rows.items():
        table = np.array(sorted(listed), dtype=np.float64)
        tables.append(TrajectoryTable(label, table[:, 0], table[:, 1:4], table[:, 4]))
    return tuple(tables)
