"""Cholesky factors of symmetric banded matrices, and solutions by them.

By LAPACK's routines, without the checks of scipy's wrappers, which take as long again.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpbsv, dpbtrf, dpbtrs, dptsv, dtbtrs

from protocols.geometry.types import Floats


def cholesky_banded(band: Floats) -> Floats:
    """Upper band (k, n) of the factor U, ``A = Uᵀ U``, of the upper band of A. Raises LinAlgError if not definite."""
    factor, info = dpbtrf(band) if band.size else (band, 0)
    if info:
        raise np.linalg.LinAlgError(f"the leading {info} rows of a banded matrix are not positive definite")
    return np.asarray(factor)


def cho_solve_banded(factor: Floats, right: Floats, *, overwrite: bool = False) -> Floats:
    """A⁻¹ right, (n,) or (n, p). factor: of A, by `cholesky_banded`. overwrite: right's memory, in Fortran's order."""
    solution = dpbtrs(factor, right, overwrite_b=overwrite)[0] if right.size else np.zeros_like(right)
    return np.asarray(solution).reshape(right.shape)


def solve_upper_transposed(factor: Floats, right: Floats) -> Floats:
    """U⁻ᵀ right (n, p), in right's memory, which is in Fortran's order."""
    return np.asarray(dtbtrs(factor, right, trans="T", overwrite_b=True)[0])  # a factor's diagonal is never zero


def solve_banded(band: Floats, right: Floats) -> Floats:
    """A⁻¹ right (n, p) of the upper band (k, n) of A; both are overwritten. Raises LinAlgError if not definite."""
    _, solution, info = dpbsv(band, right, overwrite_ab=1, overwrite_b=1)
    if info:
        raise np.linalg.LinAlgError("a banded matrix is not positive definite")
    return np.asarray(solution)


def solve_tridiagonal(diagonal: Floats, beside: Floats, right: Floats) -> tuple[Floats, Floats]:
    """A⁻¹ right (n, p), and the pivots (n,) of A, whose product is its determinant; diagonal (n,), beside (n - 1,).

    Raises LinAlgError if A is not positive definite.
    """
    pivots, _, solution, info = dptsv(diagonal, beside, right)
    if info:
        raise np.linalg.LinAlgError("a tridiagonal matrix is not positive definite")
    return np.asarray(solution), np.asarray(pivots)
