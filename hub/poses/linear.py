"""The linear algebra of the adjustment: a banded trajectory block with a dense border of camera parameters.

    [ A  B ] [ control points ]   [ g ]
    [ Bᵀ C ] [ cameras        ] = [ h ]

A is banded because a time touches four control points; eliminating it costs time linear in the length of
the recording (Schur complement C - Bᵀ A⁻¹ B).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array

from hub.points import PointBasis
from hub.splines import SUPPORT, SplineBasis
from protocols.geometry.types import Floats, Ints

BAND = 3 * SUPPORT
"""Upper bands kept: four control points of three coordinates."""


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


def add_path_blocks(band: Floats, index: Ints, weights: Floats, blocks: Floats) -> None:
    """Add sum over rows of (w wᵀ) ⊗ block to the band; index (n,), weights (n, 4), blocks (n, 3, 3) symmetric."""
    size = band.shape[1]
    for a in range(SUPPORT):
        for b in range(a, SUPPORT):
            product = weights[:, a] * weights[:, b]
            for i in range(3):
                for j in range(3):
                    distance = 3 * (b - a) + j - i
                    if distance < 0 or (a == b and j < i):
                        continue
                    column = 3 * (index + b) + j
                    values = np.bincount(column, product * blocks[:, i, j], minlength=size)
                    band[BAND - 1 - distance] += values


def path_gradient(index: Ints, weights: Floats, values: Floats, size: int) -> Floats:
    """Sum over rows of w ⊗ value: (3 n,) of values (m, 3)."""
    out = np.zeros(size)
    for a in range(SUPPORT):
        for i in range(3):
            out += np.bincount(3 * (index + a) + i, weights[:, a] * values[:, i], minlength=size)
    return out


def border_block(index: Ints, weights: Floats, blocks: Floats, size: int) -> Floats:
    """Sum over rows of w ⊗ block: (3 n, p) of blocks (m, 3, p)."""
    rows, _, width = blocks.shape
    columns = (index[:, None] + np.arange(SUPPORT)).ravel()
    shape = (rows, size // 3 + SUPPORT)
    spread = csr_array((weights.ravel(), columns, SUPPORT * np.arange(rows + 1)), shape=shape)
    return np.asarray((spread.T @ blocks.reshape(rows, -1)).reshape(-1, width)[:size])


def third_difference_band(basis: SplineBasis | PointBasis, weight: Floats) -> Floats:
    """Band of the motion prior sum weight_i |third difference_i|² over knot intervals; weight (m,)."""
    band = np.zeros((BAND, 3 * basis.size))
    index = basis.interval_starts()
    rows = np.tile(THIRD_DIFFERENCE, (len(index), 1))
    add_path_blocks(band, index, rows, weight[:, None, None] * np.eye(3))
    return band


THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])


def third_differences(basis: SplineBasis | PointBasis, control: Floats) -> Floats:
    """(m, 3) third differences of the control points of every knot interval."""
    index = basis.interval_starts()
    return np.asarray(sum(coefficient * control[index + k] for k, coefficient in enumerate(THIRD_DIFFERENCE)))


@dataclass(slots=True, eq=False)
class Elimination:
    """The path block factored and the cameras' reduced system. factor: Cholesky band of A.

    carried: (3 n, p) A⁻¹ B. reduced: (p, p) Schur complement.
    """

    factor: Floats
    carried: Floats
    reduced: Floats


def eliminate(system: BorderedSystem, damping: float = 0.0) -> Elimination:
    """Factor A (damped on its diagonal) and form the Schur complement. Raises LinAlgError if not definite."""
    band = system.band.copy()
    band[-1] += damping * band[-1] + 1e-12 * float(band[-1].max(initial=1.0))
    factor = cholesky_banded(band, check_finite=False)
    carried = cho_solve_banded((factor, False), system.border, check_finite=False)
    reduced = system.corner - system.border.T @ carried
    return Elimination(factor, np.asarray(carried), np.asarray(0.5 * (reduced + reduced.T)))


def cho_solve_path(parts: Elimination, right: Floats) -> Floats:
    """A⁻¹ right, (3 n,) of (3 n,)."""
    return np.asarray(cho_solve_banded((parts.factor, False), right, check_finite=False))


def solve(system: BorderedSystem, damping: float, tangent: Floats | None) -> tuple[Floats, Floats]:
    """Damped step (path (3 n,), cameras (p,)) that lowers the cost.

    tangent: (p, q) orthonormal directions that the cameras may move in (the gauge is held); None = all.
    """
    parts = eliminate(system, damping)
    path = cho_solve_path(parts, system.gradient_path)
    right = -(system.gradient_cameras - system.border.T @ path)
    matrix = parts.reduced + damping * np.diag(np.diag(system.corner)) + 1e-12 * np.eye(len(right))
    if len(right) == 0:
        return -np.asarray(path), right
    if tangent is None:
        cameras = np.linalg.solve(matrix, right)
    else:
        cameras = tangent @ np.linalg.solve(tangent.T @ matrix @ tangent, tangent.T @ right)
    return np.asarray(-path - parts.carried @ cameras), np.asarray(cameras)
