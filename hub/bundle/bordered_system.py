"""Linear solver of the adjustment: banded trajectory block with a dense border of camera parameters (Schur complement).

    [ A  B ] [ control points ]   [ g ]
    [ Bᵀ C ] [ cameras        ] = [ h ]

A is banded because the spline at one time depends on four control points; eliminating it costs time linear in the
length of the recording (Schur complement C - Bᵀ A⁻¹ B).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csc_array

from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SUPPORT, SplineBasis
from protocols.geometry.types import Floats, Ints

BAND = 3 * SUPPORT
"""Upper bands stored: four control points of three coordinates."""


@dataclass(slots=True, eq=False)
class BorderedSystem:
    """Normal equations. band: (12, 3 n) upper band of A. border: (3 n, p) B. corner: (p, p) C.

    gradient_path: (3 n,), gradient_cameras: (p,).
    """

    band: Floats
    border: Floats
    corner: Floats
    gradient_path: Floats
    gradient_cameras: Floats


class PathBlocks:
    """Accumulates rows into the band and the border of the trajectory block; size: number of control points.

    A row depends on four control points. Sums over rows are products with a sparse matrix of their weights; the band is
    assembled once, from sums for each first control point.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._sums: Floats = np.zeros((size + SUPPORT, len(_PAIRS), 6))

    def add(self, index: Ints, weights: Floats, upper: Floats) -> None:
        """Add (w wᵀ) ⊗ block of every row; index (n,), weights (n, 4), upper (6, n): 00, 01, 02, 11, 12, 22 of it."""
        products = np.empty((len(index), len(_PAIRS)))
        for p, (a, b) in enumerate(_PAIRS):
            products[:, p] = weights[:, a] * weights[:, b]
        columns = len(_PAIRS) * index[:, None] + np.arange(len(_PAIRS))
        sums = sparse_row_sums(products, columns, np.ascontiguousarray(upper.T), self._sums.shape[0] * len(_PAIRS))
        self._sums += sums.reshape(self._sums.shape)

    def add_rows(self, index: Ints, weights: Floats, terms: Floats, weighted: Floats) -> tuple[Floats, Floats]:
        """Add the rows' normal matrix; returns its path-by-others block (3 size, p) and others-by-others block (p, p).

        terms: (2, 3 + p, n) derivatives of both image axes by the point and by p other columns (the residual may be
        one); weighted: the same times the rows' weights. index (n,), weights (n, 4): control points of each row.
        """
        # The point's three rows of the normal matrix, over the point's and the other columns.
        products = weighted[0, :3, None] * terms[0] + weighted[1, :3, None] * terms[1]
        self.add(index, weights, products[_ROWS, _COLUMNS])
        scatter = self.scatter(index, weights, products[:, 3:])
        return scatter, weighted[0, 3:] @ terms[0, 3:].T + weighted[1, 3:] @ terms[1, 3:].T

    def scatter(self, index: Ints, weights: Floats, values: Floats) -> Floats:
        """Sum over rows of w ⊗ value: (3 size, p) of values (3, p, n)."""
        return border_block(index, weights, values, 3 * self.size)

    def band(self) -> Floats:
        """The band (12, 3 size) of the sum of all rows."""
        out = np.zeros((BAND, 3 * self.size))
        for p, (a, b) in enumerate(_PAIRS):
            for i in range(3):
                for j in range(i if a == b else 0, 3):
                    values = self._sums[: self.size - b, p, _UPPER[i][j]]
                    out[BAND - 1 - 3 * (b - a) - j + i, 3 * b + j :: 3] += values
        return out


_PAIRS = tuple((a, b) for a in range(SUPPORT) for b in range(a, SUPPORT))
_UPPER = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # index of (i, j) in the stored upper triangle
_ROWS, _COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def border_block(index: Ints, weights: Floats, values: Floats, size: int) -> Floats:
    """Sum over rows of w ⊗ value: (size, p) of values (3, p, n); size: three times the control points."""
    width = values.shape[1]
    columns = index[:, None] + np.arange(SUPPORT)
    rows_first = np.ascontiguousarray(values.transpose(2, 0, 1)).reshape(-1, 3 * width)
    return sparse_row_sums(weights, columns, rows_first, size // 3 + SUPPORT).reshape(-1, width)[:size]


def sparse_row_sums(weights: Floats, columns: Ints, values: Floats, size: int) -> Floats:
    """Sums (size, p) over rows of weights (n, k) at columns (n, k) times values (n, p)."""
    rows, each = weights.shape
    scatter = csc_array((weights.ravel(), columns.ravel(), each * np.arange(rows + 1)), shape=(size, rows))
    return np.asarray(scatter @ values)


def third_difference_band(basis: SplineBasis | PointBasis, weight: Floats, metric: Floats) -> Floats:
    """Band of the motion prior sum weight_i dᵢᵀ metric dᵢ over knot intervals with third differences dᵢ.

    weight: (m,). metric: (3, 3), symmetric.
    """
    size = basis.size
    starting_weight = np.zeros(size)  # weight of the interval that begins at a control point
    starting_weight[basis.interval_starts()] = weight
    sums = np.zeros((SUPPORT, size))  # by distance of two control points, at the later one
    for a, b in _PAIRS:
        sums[b - a, b:] += THIRD_DIFFERENCE[a] * THIRD_DIFFERENCE[b] * starting_weight[: size - b]
    band = np.zeros((BAND, 3 * size))
    for distance in range(SUPPORT):
        for j in range(3):
            top = BAND - 1 - 3 * distance - j
            upper_metric = metric[: 3 if distance else j + 1, j, None]
            band[top : top + len(upper_metric), 3 * distance + j :: 3] = upper_metric * sums[distance, distance:]
    return band


def third_difference_gradient(basis: SplineBasis | PointBasis, gradients: Floats) -> Floats:
    """(3 n,): what pulls (m, 3) on the third differences are to the control points."""
    out = np.zeros((basis.size, 3))
    index = basis.interval_starts()
    for k, coefficient in enumerate(THIRD_DIFFERENCE):
        out[index + k] += coefficient * gradients
    return out.ravel()


THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])


def third_differences(basis: SplineBasis | PointBasis, control: Floats) -> Floats:
    """(m, 3) third differences of the control points of every knot interval."""
    index = basis.interval_starts()
    return np.asarray(sum(coefficient * control[index + k] for k, coefficient in enumerate(THIRD_DIFFERENCE)))


@dataclass(slots=True, eq=False)
class Elimination:
    """The factored path block and the reduced camera system. factor: Cholesky band of A.

    carried: (3 n, p) A⁻¹ B. reduced: (p, p) Schur complement.
    """

    factor: Floats
    a_inv_b: Floats
    reduced: Floats


def eliminate(system: BorderedSystem, damping: float = 0.0) -> Elimination:
    """Factor A (damped on its diagonal) and form the Schur complement. Raises LinAlgError if not positive definite."""
    factor = _damped_cholesky(system.band, damping)
    a_inv_b = cho_solve_banded((factor, False), system.border, check_finite=False)
    reduced = system.corner - system.border.T @ a_inv_b
    return Elimination(factor, np.asarray(a_inv_b), np.asarray(0.5 * (reduced + reduced.T)))


def cho_solve_path(parts: Elimination, rhs: Floats) -> Floats:
    """A⁻¹ right, (3 n,) of (3 n,)."""
    return np.asarray(cho_solve_banded((parts.factor, False), rhs, check_finite=False))


def solve(system: BorderedSystem, damping: float, tangent: Floats | None) -> tuple[Floats, Floats]:
    """Levenberg-Marquardt step (path (3 n,), cameras (p,)).

    tangent: (p, q) orthonormal directions in which the cameras may move (the gauge is fixed); None = all.
    """
    factor = _damped_cholesky(system.band, damping)
    # Half of the work of `eliminate` is enough: with A = Uᵀ U and H = U⁻ᵀ [B g], Hᵀ H holds Bᵀ A⁻¹ B and Bᵀ A⁻¹ g.
    half_solved = np.empty((factor.shape[1], len(system.gradient_cameras) + 1), order="F")
    half_solved[:, :-1], half_solved[:, -1] = system.border, system.gradient_path
    half_solved, _ = dtbtrs(
        factor, half_solved, trans="T", overwrite_b=True
    )  # fails only on a zero diagonal, which the factor never has
    gram = half_solved.T @ half_solved
    rhs = gram[:-1, -1] - system.gradient_cameras
    matrix = system.corner - gram[:-1, :-1] + damping * np.diag(np.diag(system.corner)) + 1e-12 * np.eye(len(rhs))
    if tangent is None:
        cameras = np.linalg.solve(matrix, rhs)
    else:
        cameras = tangent @ np.linalg.solve(tangent.T @ matrix @ tangent, tangent.T @ rhs)
    path = cho_solve_banded((factor, False), system.gradient_path + system.border @ cameras, check_finite=False)
    return -np.asarray(path), np.asarray(cameras)


def _damped_cholesky(band: Floats, damping: float) -> Floats:
    """Cholesky band of A, damped on its diagonal. Raises LinAlgError if not positive definite."""
    band = band.copy()
    band[-1] += damping * band[-1] + 1e-12 * float(band[-1].max(initial=1.0))
    return np.asarray(cholesky_banded(band, check_finite=False))
