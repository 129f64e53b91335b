"""How a camera's errors are alike in time: white noise, and a Gauss-Markov process that lasts for seconds.

What a detector takes for the middle of a thing, and what a lens does to it, changes with where the thing is, and so as
slowly as it moves. Of each camera and image axis: ``r(t) = white + lasting(t)``, with the covariance
``lasting² exp(-|dt| / seconds)``. The three numbers are those of maximum likelihood; the precision of a first-order
process is tridiagonal, so that a likelihood costs time linear in the rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from hub.bundle.problem import Coloured, Problem, State
from hub.bundle.residuals import predict
from protocols.geometry.types import Floats

_MOST_ROWS = 6000
"""Rows of one label from which a camera's noise is told, in a row."""
_LEAST_ROWS = 50
_LEAST_PX = 0.05
_SHARES = (1e-3, 0.999)
"""Least and largest share of the variance that lasts."""
_SECONDS = (0.1, 30.0)
_STEP, _FINEST = 1.0, 0.1  # of the logarithms that are searched


@dataclass(frozen=True, slots=True, eq=False)
class Markov:
    """Samples of a Gauss-Markov process of unit variance at times (n,).

    kept: (n - 1,) correlation of neighbours. fresh: (n,) variance of what is new in each; the first's is 1.
    """

    kept: Floats
    fresh: Floats

    @classmethod
    def over(cls, time: Floats, seconds: float) -> Markov:
        """Of sorted times (n,) [s]; seconds: the time constant."""
        kept = np.exp(-np.maximum(np.diff(time), 1e-6) / seconds)
        return cls(kept, np.r_[1.0, 1.0 - kept**2])

    def precision(self) -> Floats:
        """(2, n) upper band of the inverse of the samples' covariance."""
        band = np.zeros((2, len(self.fresh)))
        band[1] = 1.0 / self.fresh
        band[1, :-1] += self.kept**2 / self.fresh[1:]
        band[0, 1:] = -self.kept / self.fresh[1:]
        return band


def coloured(problem: Problem, state: State) -> Coloured:
    """The noise of every camera, from the residuals of the rows in use.

    Of a camera with fewer than 50 of them: all white. Labels with fewer than 8 are not looked at.
    """
    count = len(state.cameras)
    out = Coloured(state.sigma.copy(), np.full(count, _LEAST_PX), np.ones(count))
    for camera in range(count):
        parts = _residuals(problem, state, camera)
        if sum(len(time) for time, _ in parts) >= _LEAST_ROWS:
            out.white[camera], out.lasting[camera], out.seconds[camera] = likeliest(parts)
    return out


def likeliest(parts: list[tuple[Floats, Floats]]) -> tuple[float, float, float]:
    """White and lasting std [px] and the time constant [s] of residuals: (times (n,), (n, 2)) of each label."""

    def misfit(share: float, seconds: float) -> tuple[float, float]:
        """-2 log likelihood but for constants, at the best variance; that variance."""
        white, squares, logdet, count = 1.0 - share, 0.0, 0.0, 0
        for time, off in parts:
            process = Markov.over(time, seconds)
            band = process.precision() / share
            # log |white I + lasting| of n samples, by the determinant lemma
            logdet -= 2.0 * float(np.log(1.0 / (share * process.fresh)).sum())
            band[1] += 1.0 / white
            factor = cholesky_banded(band, check_finite=False)
            logdet += 4.0 * float(np.log(factor[1]).sum()) + 2.0 * len(time) * np.log(white)
            smooth = cho_solve_banded((factor, False), off / white, check_finite=False)
            squares += float((off * (off - smooth)).sum()) / white
            count += 2 * len(time)
        variance = squares / count
        return count * float(np.log(max(variance, 1e-300))) + logdet, variance

    def at(odds: float, log_seconds: float) -> tuple[float, float, float, float]:
        share = float(np.clip(1.0 / (1.0 + np.exp(-odds)), *_SHARES))
        seconds = float(np.clip(np.exp(log_seconds), *_SECONDS))
        return (*misfit(share, seconds), share, seconds)

    here, best, step = np.zeros(2), at(0.0, 0.0), _STEP
    while step > _FINEST:
        for move in (np.array([step, 0.0]), np.array([-step, 0.0]), np.array([0.0, step]), np.array([0.0, -step])):
            there = at(*(here + move))
            if there[0] < best[0]:
                here, best = here + move, there
                break
        else:
            step *= 0.5
    _, variance, share, seconds = best
    return (
        max(float(np.sqrt((1.0 - share) * variance)), _LEAST_PX),
        max(float(np.sqrt(share * variance)), _LEAST_PX),
        seconds,
    )


def _residuals(problem: Problem, state: State, camera: int) -> list[tuple[Floats, Floats]]:
    """Times (n,) and residuals (n, 2) of each label's used rows, in order of time."""
    out = []
    for rows in problem.rows:
        if rows.camera != camera or np.count_nonzero(rows.use) < 8:
            continue
        off = (predict(rows, state.cameras[camera], state.trajectories[rows.label]) - rows.pixels)[rows.use]
        good = np.isfinite(off).all(axis=1)
        time, off = rows.time[rows.use][good], off[good]
        order = np.argsort(time, kind="stable")
        first = max(0, (len(order) - _MOST_ROWS) // 2)
        order = order[first : first + _MOST_ROWS]
        out.append((time[order], off[order]))
    return out
