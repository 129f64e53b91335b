"""The detections of observations.csv row by row, with all columns that `syncline detect` writes.

Where the identities are not known, several rows of one camera, time and label are several objects: tracking reads
these rows, synchronisation and calibration read ``observations.Observations``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import ObservationRows, read_rows

COLUMNS = (
    "score", "kind", "cov_uu", "cov_uv", "cov_vv", "head_u", "head_v", "foot_u", "foot_v",
    "box_x", "box_y", "box_w", "box_h",
)  # fmt: skip
"""The optional columns after ``camera,frame,time,u,v,size,label``; an empty cell = not measured."""
KINDS = ("", "marker", "person", "vehicle", "corner")
_MAX_VARIANCE = 1e12
"""[px²]: of a standard deviation of the largest pixel that is accepted."""
_SWAPPED = 0.9
"""Share of the heads below their feet in a table where the two are swapped; below a ceiling camera it is half."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectionRows:
    """n detections in the file's order; NaN = not measured.

    camera, label, kind: n texts, kind "" = not given. frame: (n,). time: (n,) [s] on the camera's clock. pixels: (n, 2)
    (u, v). size: (n,) [px]. score: (n,) 0..1. covariance: (n, 3) uu, uv, vv [px²]. head, foot: (n, 2) [px]. box: (n, 4)
    x, y, w, h [px], x and y of the top left. line: n line numbers of the file.
    """

    camera: list[str]
    label: list[str]
    kind: list[str]
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats
    score: Floats
    covariance: Floats
    head: Floats
    foot: Floats
    box: Floats
    line: list[int]

    def __len__(self) -> int:
        return len(self.time)


def read_detections(file: Path, sizes: Mapping[str, tuple[int, int]]) -> DetectionRows:
    """Read all detections of an observations.csv; the columns in ``COLUMNS`` may be absent, and their cells empty.

    sizes: (width, height) [px] of the images of each camera that the rig knows. Raises InputError (file, line, what,
    remedy) where a value is no number, out of range, or contradicts another one: a half-given point, box or covariance,
    a covariance that is not positive semi-definite, a box without area or outside the image, swapped heads and feet.
    """
    rows = read_rows(file, sizes, COLUMNS)
    score = rows.numbers("score", 1.0)
    rows.table.refuse(score < 0.0, lambda row: f"score {score[row]:g} is negative", "give 0 to 1")
    covariance = _together(rows, ("cov_uu", "cov_uv", "cov_vv"), _MAX_VARIANCE)
    uu, uv, vv = covariance.T
    # The tolerance lets a covariance of rank one pass after rounding, as on the bus.
    invalid = (uu < 0.0) | (vv < 0.0) | (uv * uv > uu * vv * (1.0 + 1e-9) + 1e-12)
    rows.table.refuse(invalid, lambda row: "cov_uu, cov_uv, cov_vv are no covariance")
    head, foot = _together(rows, ("head_u", "head_v")), _together(rows, ("foot_u", "foot_v"))
    remedy = "swap them, or turn the images upright"
    rows.table.refuse(swapped_ends(head, foot, rows.camera), lambda row: "the head is not above the foot", remedy)
    box = _together(rows, ("box_x", "box_y", "box_w", "box_h"))
    rows.table.refuse((box[:, 2:] <= 0.0).any(axis=1), lambda row: f"a box of {box[row, 2]:g} x {box[row, 3]:g} px")
    limit = np.array([sizes[name] for name in rows.camera], dtype=np.float64).reshape(-1, 2)
    outside = ((box[:, :2] >= limit) | (box[:, :2] + box[:, 2:] <= 0.0)).any(axis=1)
    rows.table.refuse(outside, lambda row: f"the box lies outside the {limit[row, 0]:g}x{limit[row, 1]:g} image")
    return DetectionRows(
        rows.camera,
        rows.label,
        _kinds(rows),
        rows.frame,
        rows.time,
        rows.pixels,
        rows.size,
        score,
        covariance,
        head,
        foot,
        box,
        rows.table.line,
    )


def swapped_ends(head: Floats, foot: Floats, camera: Sequence[str]) -> Bools:
    """Which heads (n, 2) [px] are below their feet, in cameras (n,) in which nearly all are; in others none.

    From the ceiling, heads point away from below the camera, to all sides. In a camera on its side they are beside the
    feet.
    """
    across, down = (foot - head).T
    along = np.abs(across) <= np.abs(down)
    below = along & (down <= 0.0)
    _, index = np.unique(np.asarray(camera), return_inverse=True)
    share = np.bincount(index, below) > _SWAPPED * np.bincount(index, along)
    return np.asarray(below & share[index])


def _together(rows: ObservationRows, names: tuple[str, ...], limit: float = 1e6) -> Floats:
    """Columns (n, k) of which a row has all or none."""
    values = np.column_stack([rows.numbers(name, limit) for name in names])
    given = np.isfinite(values)
    half = given.any(axis=1) & ~given.all(axis=1)

    def what(row: int) -> str:
        return f"{', '.join(name for name, there in zip(names, given[row], strict=True) if not there)} is empty"

    rows.table.refuse(half, what, f"give all of {', '.join(names)}, or none")
    return values


def _kinds(rows: ObservationRows) -> list[str]:
    if "kind" not in rows.table.columns:
        return [""] * len(rows.table)
    kinds = rows.table.text("kind")
    unknown = np.array([kind not in KINDS for kind in kinds])
    remedy = f"use one of {', '.join(KINDS[1:])}, or leave it empty"
    rows.table.refuse(unknown, lambda row: f"kind {kinds[row][:40]!r} is not known", remedy)
    return kinds
