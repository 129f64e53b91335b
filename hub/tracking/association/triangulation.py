"""First state of a labelled marker from three rows of each of two cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hub.tracking.filter.jerk_model import POSITION, STATE_DIM
from hub.tracking.filter.marker_rows import MarkerRow
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats

ROWS_PER_CAMERA = 3
"""The fewest that determine position, velocity and acceleration and leave a test of the fit: 12 numbers for 9."""
_CHI2_PER_DOF = 16.3 / 3.0
"""The 99.9 % quantile for the three degrees of freedom."""
_MAX_NOISE_FACTOR = 9.0
"""The noise may be three times the calibration's, because clocks and poses drift after it."""
_MAX_RELATIVE_STD = 0.3
"""Of the position, as a fraction of the distance: beyond it, the linearisation does not hold."""
_GAUSS_NEWTON_STEPS = 4  # the linear point is near


def initial_motion(rows: Sequence[MarkerRow]) -> tuple[Floats, Floats, float] | None:
    """Mean (9,) and covariance (9, 9) at the newest row's time, and the factor by which the noise exceeds its model.

    Gauss–Newton on the reprojection error of a constant acceleration. None if the rows do not fit it, or do not
    determine it.
    """
    times = np.array([row.reference_ns - rows[-1].reference_ns for row in rows]) / NANOSECONDS
    span = float(np.ptp(times))
    if not span > 0.0:
        return None
    # Times in units of the span: columns of equal size.
    powers = np.stack([np.ones(len(times)), times / span, 0.5 * (times / span) ** 2], axis=1)
    rotation = np.array([row.camera.pose.rotation for row in rows])
    centre = np.array([row.camera.pose.position for row in rows])
    point = np.array([row.point for row in rows])
    weight = np.linalg.inv(np.linalg.cholesky([_noise(row, rows) for row in rows]))
    ray = rotation[:, :2] - point[:, :, None] * rotation[:, 2:]

    def design(by_position: Floats) -> Floats:
        return np.asarray(np.einsum("np,nij->nipj", powers, by_position).reshape(-1, STATE_DIM))

    motion, *_ = np.linalg.lstsq(design(ray), np.einsum("nij,nj->ni", ray, centre).ravel(), rcond=None)
    for _ in range(_GAUSS_NEWTON_STEPS):
        local = np.einsum("nij,nj->ni", rotation, powers @ motion.reshape(3, 3) - centre)
        depth = local[:, 2]
        if not depth.min() > 0.0:
            return None
        seen = local[:, :2] / depth[:, None]
        jacobian = design(weight @ ((rotation[:, :2] - seen[:, :, None] * rotation[:, 2:]) / depth[:, None, None]))
        residual = np.einsum("nij,nj->ni", weight, point - seen).ravel()
        step, _, rank, _ = np.linalg.lstsq(jacobian, residual, rcond=None)
        if rank < STATE_DIM:
            return None
        motion = motion + step
    factor = float(residual @ residual) / (len(residual) - STATE_DIM)
    if not factor < _CHI2_PER_DOF * _MAX_NOISE_FACTOR:
        return None
    units = np.repeat([1.0, 1.0 / span, 1.0 / span**2], 3)
    factor = max(factor / _CHI2_PER_DOF, 1.0)
    covariance = factor * np.linalg.inv(jacobian.T @ jacobian) * units[:, None] * units
    if not np.trace(covariance[POSITION, POSITION]) < (_MAX_RELATIVE_STD * depth.min()) ** 2:
        return None
    return motion * units, covariance, factor


def _noise(row: MarkerRow, rows: Sequence[MarkerRow]) -> Floats:
    """Covariance (2, 2) of a row's point, with the uncertainty of its time from the image speed."""
    own = [other for other in rows if other.camera.name == row.camera.name]
    elapsed = max(own[-1].reference_ns - own[0].reference_ns, 1) / NANOSECONDS
    moved = (np.array(own[-1].point) - np.array(own[0].point)) * (row.camera.time_std / elapsed)
    return np.array([row.noise[:2], row.noise[1:]]) + np.outer(moved, moved)
