"""Solutions with symmetric banded matrices."""

from __future__ import annotations

import numpy as np
import pytest

from hub.trajectory.splines import (
    cho_solve_banded,
    cholesky_banded,
    solve_banded,
    solve_tridiagonal,
    solve_upper_transposed,
)
from protocols.geometry.types import Floats

_SIZE, _BANDS = 40, 4  # of a matrix like that of a spline


@pytest.fixture
def band() -> Floats:
    out = np.random.default_rng(3).normal(0.0, 1.0, (_BANDS, _SIZE))
    out[-1] = 10.0
    return np.asarray(out)


def dense(band: Floats) -> Floats:
    """The symmetric matrix of an upper band."""
    out = np.zeros((band.shape[1],) * 2)
    for i in range(len(band)):
        out += np.diag(band[len(band) - 1 - i, i:], i)
    return np.asarray(out + np.triu(out, 1).T)


def test_solutions_are_those_of_the_dense_matrix(band: Floats) -> None:
    right = np.random.default_rng(4).normal(0.0, 1.0, (_SIZE, 3))
    expected = np.linalg.solve(dense(band), right)
    factor = cholesky_banded(band)
    np.testing.assert_allclose(cho_solve_banded(factor, right), expected, atol=1e-12)
    np.testing.assert_allclose(cho_solve_banded(factor, right[:, 0]), expected[:, 0], atol=1e-12)
    half = solve_upper_transposed(factor, np.asfortranarray(right))
    np.testing.assert_allclose(half.T @ half, right.T @ expected, atol=1e-12)
    np.testing.assert_allclose(solve_banded(band.copy(), right.copy()), expected, atol=1e-12)


def test_a_tridiagonal_solution_comes_with_the_determinant(band: Floats) -> None:
    right = np.random.default_rng(5).normal(0.0, 1.0, (_SIZE, 2))
    solution, pivots = solve_tridiagonal(band[-1], band[-2, 1:], right)
    matrix = dense(band[-2:])
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), atol=1e-12)
    assert np.log(pivots).sum() == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_an_indefinite_matrix_is_an_error_and_an_empty_one_none(band: Floats) -> None:
    band[-1, _SIZE // 2] = -1.0
    for solve in (
        lambda: cholesky_banded(band),
        lambda: solve_banded(band, np.ones((_SIZE, 1))),
        lambda: solve_tridiagonal(band[-1], band[-2, 1:], np.ones((_SIZE, 1))),
    ):
        with pytest.raises(np.linalg.LinAlgError):
            solve()
    factor = cholesky_banded(np.zeros((_BANDS, 0)))
    assert cho_solve_banded(factor, np.zeros((0, 2))).shape == (0, 2)
