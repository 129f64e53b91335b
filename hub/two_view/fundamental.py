"""Fundamental matrix of pixel correspondences: eight-point algorithm, maximum likelihood, epipolar lines.

``F = U diag(cos a, sin a, 0) Vᵀ`` with rotations U, V (7 degrees of freedom), so that rank 2 and norm 1 hold at every
step; convention ``m_aᵀ F m_b = 0`` (asynchronous calibration paper, eq. 5).
"""

from __future__ import annotations

import numpy as np

from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.types import Floats

_MIN_PAIRS = 8  # of the eight-point algorithm


def hartley_normalisation(points: Floats) -> Floats:
    """Hartley's normalising transform (3, 3): centres points (n, 2) and scales them to unit variance."""
    centre = points.mean(axis=0)
    spread = max(float(np.sqrt(((points - centre) ** 2).mean())), 1e-12)
    return np.array([[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1.0]])


def eight_point(a: Floats, b: Floats) -> Floats:
    """Normalised eight-point algorithm: rank-2 F (3, 3), norm 1, of n >= 8 point pairs a, b (n, 2).

    Raises Refused for fewer than 8 pairs.
    """
    if len(a) < _MIN_PAIRS:
        raise Refused(f"{len(a)} point pairs; a fundamental matrix needs {_MIN_PAIRS}")
    ta, tb = hartley_normalisation(a), hartley_normalisation(b)
    ha = np.column_stack([a, np.ones(len(a))]) @ ta.T
    hb = np.column_stack([b, np.ones(len(b))]) @ tb.T
    rows = (ha[:, :, None] * hb[:, None, :]).reshape(-1, 9)
    _, _, vt = np.linalg.svd(rows, full_matrices=len(a) < 9)
    u, d, wt = np.linalg.svd(vt[-1].reshape(3, 3))
    matrix = ta.T @ ((u * np.array([d[0], d[1], 0.0])) @ wt) @ tb
    return np.asarray(matrix / np.linalg.norm(matrix))


def maximum_likelihood_fundamental(a: Floats, b: Floats) -> Floats:
    """Maximum-likelihood F (3, 3), norm 1: minimises the Sampson distance of point pairs a, b (n, 2).

    It starts from the eight-point solution. Raises Refused for fewer than 8 pairs.
    """
    from scipy.optimize import least_squares  # slow to import, and needed by the papers' methods only

    # In normalised coordinates, with the ratio of scales kept so that the Sampson distance is in pixels of one size.
    ta, tb = hartley_normalisation(a), hartley_normalisation(b)
    inverse_scale = ta[0, 0] / tb[0, 0]
    ha = np.column_stack([a, np.ones(len(a))]) @ ta.T
    hb = np.column_stack([b, np.ones(len(b))]) @ tb.T
    u, d, vt = np.linalg.svd(np.linalg.inv(ta).T @ eight_point(a, b) @ np.linalg.inv(tb))
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    angle = np.arctan2(d[1], d[0])

    def compose(step: Floats) -> Floats:
        singular = np.array([np.cos(angle + step[6]), np.sin(angle + step[6]), 0.0])
        return np.asarray((so3.exp(step[:3]) @ u * singular) @ vt @ so3.exp(-step[3:6]))

    def residuals(step: Floats) -> Floats:
        la, lb = hb @ compose(step).T, ha @ compose(step)
        # The two images are scaled by different factors: weighted back to pixels of one size.
        variance = (la[:, :2] ** 2).sum(1) * inverse_scale**2 + (lb[:, :2] ** 2).sum(1)
        return np.asarray((ha * la).sum(1) / np.sqrt(np.maximum(variance, 1e-300)))

    found = least_squares(residuals, np.zeros(7), "3-point", xtol=1e-12, ftol=1e-12, gtol=None, max_nfev=50)
    matrix = ta.T @ compose(found.x) @ tb
    return np.asarray(matrix / np.linalg.norm(matrix))


def epipolar_lines(matrix: Floats, a: Floats) -> Floats:
    """Epipolar lines (n, 3) in image b, ``lᵀ m_b = 0``, of points a (n, 2); the first two entries are a unit normal."""
    lines = np.column_stack([a, np.ones(len(a))]) @ matrix
    return np.asarray(lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-300)[:, None])


def line_distances(lines: Floats, points: Floats) -> Floats:
    """Signed distances (n,) of points (n, 2) from unit-normal lines (n, 3) [px]."""
    return np.asarray((lines[:, :2] * points).sum(axis=1) + lines[:, 2])
