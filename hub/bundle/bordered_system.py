"""Linear solver of the adjustment: banded trajectory block with a border of camera parameters (Schur complement).

    [ A  B ] [ control points ]   [ g ]
    [ Bᵀ C ] [ cameras        ] = [ h ]

A is banded because the spline at one time depends on four control points; eliminating it costs time linear in the
length of the recording (Schur complement C - Bᵀ A⁻¹ B). A label's path meets only the cameras that observe it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from hub.bundle.block_matrix import BlockSum
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SUPPORT, SplineBasis, cho_solve_banded, cholesky_banded, solve_upper_transposed
from protocols.geometry import kernels
from protocols.geometry.types import Floats, Ints

try:  # what a product of scipy's sparse matrices ends in; here without its checks, and added in place
    from scipy.sparse import _sparsetools

    _csc_matvecs: Callable[..., None] | None = _sparsetools.csc_matvecs
except (ImportError, AttributeError):
    _csc_matvecs = None

_ROWS_AT_ONCE = 1001  # products of so many fit a core's cache; no power of two, whose columns displace each other there

_CAMERA_REGULARISATION = 1e-12  # of the cameras' normal matrix: parameters that nothing determines stay

BAND = 3 * SUPPORT
"""Upper bands stored: four control points of three coordinates."""
_SUPPORT = np.arange(SUPPORT, dtype=np.int32)
_PAIRS = tuple((a, b) for a in range(SUPPORT) for b in range(a, SUPPORT))
_UPPER = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # index of (i, j) in the stored upper triangle
_PAIR_FIRST, _PAIR_SECOND = (np.array(one) for one in zip(*_PAIRS, strict=True))
_PAIR_COLUMNS = np.arange(len(_PAIRS), dtype=np.int32)
_ROWS, _COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class PathByCameras:
    """A matrix (3 n, p) of all paths by all camera parameters, zero where a camera does not observe a label.

    parts: of each label its rows, the columns (k,) of its cameras and the block (rows, k). width: p.
    """

    parts: tuple[tuple[slice, Ints, Floats], ...]
    width: int

    def __matmul__(self, cameras: Floats) -> Floats:
        """(3 n,) of (p,)."""
        return np.concatenate([np.zeros(0), *(block @ cameras[columns] for _, columns, block in self.parts)])

    def transposed_times(self, path: Floats) -> Floats:
        """(p,) of (3 n,), (p, k) of (3 n, k)."""
        out = np.zeros((self.width, *path.shape[1:]))
        for rows, columns, block in self.parts:
            out[columns] += block.T @ path[rows]
        return out


@dataclass(slots=True, eq=False)
class BorderedSystem:
    """Normal equations. band: (12, 3 n) upper band of A. border: (3 n, p) B. corner: (p, p) C, camera by camera.

    gradient_path: (3 n,), gradient_cameras: (p,).
    """

    band: Floats
    border: PathByCameras
    corner: BlockSum
    gradient_path: Floats
    gradient_cameras: Floats


class PathBlocks:
    """Accumulates rows of one label into the band of the trajectory block; size: number of control points.

    A row depends on four control points. Sums over rows are products with a sparse matrix of their weights; the band is
    assembled once, from sums for each first control point.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.sums: Floats = np.zeros(((size + SUPPORT) * len(_PAIRS), 6))

    def add(self, index: Ints, weights: Floats, terms: Floats, crossed: tuple[int, Floats], gram: Floats) -> None:
        """Add rows (n,) of this label; ``crossed``: from a control point on (k, 3 p), and ``gram`` (p, p)."""
        for first in range(0, len(index), _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            u, v = terms[:, :, rows]
            # The point's three rows of the normal matrix, over the point's and the other columns.
            products = u[:3, None] * u
            products += v[:3, None] * v
            add_row_sums(
                crossed[1],
                weights[rows],
                index[rows, None] - crossed[0] + _SUPPORT,
                products[:, 3:].reshape(-1, u.shape[1]).T,
            )
            pairs = weights[rows].T[_PAIR_FIRST] * weights[rows].T[_PAIR_SECOND]
            columns = len(_PAIRS) * index[rows, None] + _PAIR_COLUMNS
            add_row_sums(self.sums, pairs.T, columns, products[_ROWS, _COLUMNS].T)
            gram += u[3:] @ u[3:].T + v[3:] @ v[3:].T

    def band(self) -> Floats:
        """The band (12, 3 size) of the sum of all rows."""
        out, all_sums = np.zeros((BAND, 3 * self.size)), self.sums.reshape(-1, len(_PAIRS), 6)
        for p, (a, b) in enumerate(_PAIRS):
            for i in range(3):
                for j in range(i if a == b else 0, 3):
                    values = all_sums[: self.size - b, p, _UPPER[i][j]]
                    out[BAND - 1 - 3 * (b - a) - j + i, 3 * b + j :: 3] += values
        return out


def add_rows(
    to: Sequence[tuple[int, PathBlocks]], ends: Ints, index: Ints, weights: Floats, terms: Floats
) -> tuple[list[tuple[int, Floats]], Floats]:
    """Add rows (n,) to the normal matrix; returns others-by-others (p, p), and path-by-others of each label: the first
    control point that it observes, and the block (3 k, p) from there to the last one.

    to: of each label its first control point and what accumulates it. ends: where its rows end. terms: (2, 3 + p, n)
    derivatives of both image axes by the point and by p other columns (the residual may be one), times the root of the
    rows' weights. index (n,), weights (n, 4): control points of each row.
    """
    others, parts = terms.shape[1] - 3, list[tuple[int, Floats]]()
    bounds = [(int(begin), int(end)) for begin, end in zip((0, *ends[:-1]), ends, strict=True)]
    for (first, _), (begin, end) in zip(to, bounds, strict=True):
        seen = index[begin:end] if end > begin else np.array([first])
        low = int(seen.min())
        parts.append((low, np.zeros((int(seen.max()) - low + SUPPORT, 3 * others))))
    gram = np.zeros((others, others))
    if kernels.AVAILABLE and others <= kernels.MOST_TERMS:
        sums = [(first, one.sums, *part) for (first, one), part in zip(to, parts, strict=True)]
        kernels.add_rows(ends, index, weights.T, terms, sums, gram)
    else:
        for (first, one), (low, block), (begin, end) in zip(to, parts, bounds, strict=True):
            rows = slice(begin, end)
            one.add(index[rows] - first, weights[rows], terms[:, :, rows], (low - first, block), gram)
    return [(low, block.reshape(-1, others)) for low, block in parts], gram


def border_block(index: Ints, weights: Floats, values: Floats, size: int) -> Floats:
    """Sum over rows of w ⊗ value: (size, p) of values (3, p, n); size: three times the control points."""
    _, width, rows = values.shape
    out = np.zeros((size // 3 + SUPPORT, 3 * width))
    add_row_sums(out, weights, index[:, None] + _SUPPORT, values.reshape(-1, rows).T)
    return out.reshape(-1, width)[:size]


def add_row_sums(out: Floats, weights: Floats, columns: Ints, values: Floats) -> None:
    """Add to out (size, p) the sums over rows of weights (n, k) at columns (n, k) times values (n, p)."""
    rows, each = weights.shape
    starts, places = np.arange(0, each * rows + 1, each, dtype=np.int32), columns.astype(np.int32).ravel()
    if _csc_matvecs is None:
        out += np.asarray(csc_array((weights.ravel(), places, starts), shape=(len(out), rows)) @ values)
    else:
        flat = np.ascontiguousarray(values).ravel()
        _csc_matvecs(len(out), rows, values.shape[1], starts, places, weights.ravel(), flat, out.reshape(-1))


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
    """(k n,): what pulls (m, k) on the third differences are to the control points."""
    out = np.zeros((basis.size, gradients.shape[1]))
    index = basis.interval_starts()
    for k, coefficient in enumerate(THIRD_DIFFERENCE):
        out[index + k] += coefficient * gradients
    return out.ravel()


def third_differences(basis: SplineBasis | PointBasis, control: Floats) -> Floats:
    """(m, k) third differences of the control points (n, k) of every knot interval."""
    index = basis.interval_starts()
    return np.asarray(sum(coefficient * control[index + k] for k, coefficient in enumerate(THIRD_DIFFERENCE)))


@dataclass(slots=True, eq=False)
class Elimination:
    """The factored path block and the reduced camera system. factor: Cholesky band of A.

    a_inv_b: (3 n, p) A⁻¹ B. reduced: (p, p) Schur complement.
    """

    factor: Floats
    a_inv_b: PathByCameras
    reduced: BlockSum


def eliminate(system: BorderedSystem) -> Elimination:
    """Factor A and form the Schur complement. Raises LinAlgError if not positive definite."""
    factor = _damped_cholesky(system.band, 0.0)
    parts, grams = [], []
    for rows, columns, block in system.border.parts:
        parts.append((rows, columns, cho_solve_banded(factor[:, rows], block)))
        gram = block.T @ parts[-1][2]
        grams.append((columns, -0.5 * (gram + gram.T)))
    schur = BlockSum(np.zeros(system.corner.size), tuple(grams))
    return Elimination(factor, replace(system.border, parts=tuple(parts)), system.corner + schur)


def solve(system: BorderedSystem, damping: float, fixed: Floats) -> tuple[Floats, Floats]:
    """Levenberg-Marquardt step (path (3 n,), cameras (p,)). Raises LinAlgError.

    fixed: (q, p) orthonormal directions in which the cameras do not move (the gauge).
    """
    factor = _damped_cholesky(system.band, damping)
    diagonal, rhs, parts = system.corner.diagonal(), -system.gradient_cameras, []
    for rows, columns, block in system.border.parts:
        # Half of the work of `eliminate` is enough: with A = Uᵀ U and H = U⁻ᵀ [B g], Hᵀ H holds Bᵀ A⁻¹ B and Bᵀ A⁻¹ g.
        half_solved = np.empty((len(block), len(columns) + 1), order="F")
        half_solved[:, :-1], half_solved[:, -1] = block, system.gradient_path[rows]
        half_solved = solve_upper_transposed(factor[:, rows], half_solved)
        gram = half_solved.T @ half_solved
        rhs[columns] += gram[:-1, -1]
        parts.append((columns, -gram[:-1, :-1]))
    # Where ``fixed`` x = 0, adding its squares to the matrix changes nothing, and the matrix is then definite.
    for row in fixed:
        touched = np.flatnonzero(row)
        parts.append((touched, float(row**2 @ diagonal) * np.outer(row[touched], row[touched])))
    matrix = system.corner + BlockSum(damping * diagonal + _CAMERA_REGULARISATION, tuple(parts))
    right, factored = np.column_stack([rhs, fixed.T]), matrix.factored()
    solved = np.linalg.solve(matrix.dense(), right) if factored is None else factored.solve(right)
    moved = solved[:, 1:]
    cameras = np.asarray(solved[:, 0] - moved @ np.linalg.solve(fixed @ moved, fixed @ solved[:, 0]))
    path = cho_solve_banded(factor, system.gradient_path + system.border @ cameras)
    return -path, cameras


def _damped_cholesky(band: Floats, damping: float) -> Floats:
    """Cholesky band of A, damped on its diagonal. Raises LinAlgError if not positive definite."""
    band = band.copy()
    band[-1] += damping * band[-1] + regularisation(band[-1])
    return cholesky_banded(band)


def regularisation(diagonal: Floats) -> Floats:
    """(n,) 1e-12 of each entry of A's diagonal: of a path past a camera's centre the largest is 1e19 and holds all."""
    return np.asarray(1e-12 * np.where(diagonal > 0.0, diagonal, diagonal.max(initial=1.0)))
