"""Export of trajectories as C3D, the format of motion capture, through ezc3d. Gaps are marked by residual -1."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.formats.trc import read_grid


def write_c3d(source: Path, out: Path, units: str) -> None:
    """Write a trajectory.csv or track.csv as a C3D file at its constant rate. Raises InputError.

    units: of the trajectory; C3D files are in millimetres.
    """
    try:
        import ezc3d
    except ImportError:
        raise InputError("C3D files need ezc3d, which is not installed", remedy="pip install 'syncline[c3d]'") from None
    grid = read_grid(source, units, "mm")
    count, labels = len(grid.cells), len(grid.labels)
    points = np.full((4, labels, count), np.nan)
    points[:3] = grid.cells.reshape(count, labels, 3).transpose(2, 1, 0)
    missing = np.isnan(points[0])
    points[3] = np.where(missing, -1.0, 1.0)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [grid.rate]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(grid.labels)
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)[None]
    try:
        with completed_file(out) as part:
            file.write(str(part))
    except (OSError, RuntimeError) as error:
        raise InputError(f"cannot be written: {error}", file=out, remedy="choose another --out") from None
