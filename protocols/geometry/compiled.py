"""Compiled routines of scipy without the packages around them, whose import takes a tenth of a second."""

from __future__ import annotations

try:
    from scipy.linalg._flapack import dgesv, dpbsv, dpbtrf, dpbtrs, dptsv, dtbtrs
    from scipy.sparse._sparsetools import csc_matvecs
    from scipy.special._ufuncs import chdtri, erf, fdtri, gammainc, gammaln
except ImportError:  # another version of scipy
    from scipy.linalg.lapack import dgesv, dpbsv, dpbtrf, dpbtrs, dptsv, dtbtrs
    from scipy.sparse import csc_array
    from scipy.special import chdtri, erf, fdtri, gammainc, gammaln

    def csc_matvecs(rows, columns, vectors, starts, places, weights, values, out) -> None:  # type: ignore[misc, no-untyped-def]
        """Add a sparse matrix (rows, columns), by columns, times values (columns * vectors,) to out."""
        matrix = csc_array((weights, places, starts), shape=(rows, columns))
        out += (matrix @ values.reshape(columns, vectors)).ravel()


__all__ = [
    "chdtri",
    "csc_matvecs",
    "dgesv",
    "dpbsv",
    "dpbtrf",
    "dpbtrs",
    "dptsv",
    "dtbtrs",
    "erf",
    "fdtri",
    "gammainc",
    "gammaln",
]
