"""Noise model of a camera's residuals: white noise plus a first-order Gauss-Markov process, by maximum likelihood.

Errors of a detector's centre and of a lens depend on where the target is in the image, so they change as slowly as it
moves. For each camera and image axis: ``r(t) = white + correlated(t)``, where the correlated part has the covariance
``correlated_std² exp(-|dt| / time_constant)``. The three parameters are estimated by maximum likelihood; the precision
matrix of a first-order process is tridiagonal, so evaluating the likelihood costs time linear in the rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.problem import AdjustmentState, CorrelatedNoise, Problem, UsedRows
from hub.bundle.residuals import predict
from hub.trajectory.splines import solve_tridiagonal
from protocols.geometry.types import Floats

_MAX_ROWS = 6000
"""Most consecutive rows of one label from which a camera's noise is estimated."""
_MIN_ROWS = 50  # for the three parameters of a camera's noise
_MIN_STD_PX = 0.05  # a floor: noise of 0 has no likelihood
_CORRELATED_SHARE_RANGE = (1e-3, 0.999)
"""Smallest and largest share of the variance in the correlated part."""
_TIME_CONSTANT_RANGE_S = (0.1, 30.0)  # a few frames; a share of a recording
_FIRST_STEP, _LAST_STEP = 1.0, 0.1  # of the coordinate search, in the log parameters


@dataclass(frozen=True, slots=True, eq=False)
class GaussMarkov:
    """Samples of a Gauss-Markov process of unit variance at times (n,).

    correlation: (n - 1,) between neighbouring samples. innovation: (n,) innovation variance of each; the first's is 1.
    """

    correlation: Floats
    innovation: Floats

    @classmethod
    def sampled_at(cls, time: Floats, time_constant: float) -> GaussMarkov:
        """The process at sorted times (n,) [s]; time_constant [s]."""
        correlation = np.exp(-np.maximum(np.diff(time), 1e-6) / time_constant)
        return cls(correlation, np.r_[1.0, 1.0 - correlation**2])

    def precision(self) -> Floats:
        """(2, n) upper band of the inverse of the samples' covariance."""
        band = np.zeros((2, len(self.innovation)))
        band[1] = 1.0 / self.innovation
        band[1, :-1] += self.correlation**2 / self.innovation[1:]
        band[0, 1:] = -self.correlation / self.innovation[1:]
        return band


def estimate_correlated_noise(problem: Problem, state: AdjustmentState) -> CorrelatedNoise:
    """Noise model of every camera, estimated from the residuals of the rows in use.

    A camera with fewer than 50 of them gets white noise only. Labels with fewer than 8 are ignored.
    """
    count = len(state.cameras)
    out = CorrelatedNoise(state.sigma.copy(), np.full(count, _MIN_STD_PX), np.ones(count))
    for camera in range(count):
        parts = _residuals(problem, state, camera)
        if sum(len(time) for time, *_ in parts) >= _MIN_ROWS:
            out.white_std[camera], out.correlated_std[camera], out.time_constant[camera] = fit_maximum_likelihood(parts)
    return out


def fit_maximum_likelihood(parts: list[tuple[Floats, Floats, Floats]]) -> tuple[float, float, float]:
    """White std [px], correlated std [px] and time constant [s].

    parts: times (n,), residuals (n, 2) and relative variances of the white noise (n,) by label.
    """

    def minus_two_log_likelihood(share: float, time_constant: float) -> tuple[float, float]:
        """-2 log likelihood up to a constant at the optimal total variance, and that variance."""
        squares, logdet, count = 0.0, 0.0, 0
        for time, residual, relative in parts:
            white = (1.0 - share) * relative
            process = GaussMarkov.sampled_at(time, time_constant)
            band = process.precision() / share
            # log |white I + correlated| of n samples, by the matrix determinant lemma
            logdet -= 2.0 * float(np.log(1.0 / (share * process.innovation)).sum())
            band[1] += 1.0 / white
            weighted = residual / white[:, None]
            smooth, pivots = solve_tridiagonal(band[1], band[0, 1:], weighted)
            logdet += 2.0 * float(np.log(pivots * white).sum())
            squares += float((weighted * (residual - smooth)).sum())
            count += 2 * len(time)
        variance = squares / count
        return count * float(np.log(max(variance, 1e-300))) + logdet, variance

    def at(log_odds: float, log_time_constant: float) -> tuple[float, float, float, float]:
        share = float(np.clip(1.0 / (1.0 + np.exp(-log_odds)), *_CORRELATED_SHARE_RANGE))
        time_constant = float(np.clip(np.exp(log_time_constant), *_TIME_CONSTANT_RANGE_S))
        return (*minus_two_log_likelihood(share, time_constant), share, time_constant)

    position, best, step = np.zeros(2), at(0.0, 0.0), _FIRST_STEP
    while step > _LAST_STEP:
        for move in (np.array([step, 0.0]), np.array([-step, 0.0]), np.array([0.0, step]), np.array([0.0, -step])):
            candidate = at(*(position + move))
            if candidate[0] < best[0]:
                position, best = position + move, candidate
                break
        else:
            step *= 0.5
    _, variance, share, time_constant = best
    return (
        max(float(np.sqrt((1.0 - share) * variance)), _MIN_STD_PX),
        max(float(np.sqrt(share * variance)), _MIN_STD_PX),
        time_constant,
    )


def _residuals(problem: Problem, state: AdjustmentState, camera: int) -> list[tuple[Floats, Floats, Floats]]:
    """Times (n,), residuals (n, 2) and relative variances (n,) of each label's used rows, in order of time."""
    out = []
    for rows in problem.of_camera(camera):
        if np.count_nonzero(rows.use) < 8:
            continue
        residual = (predict(rows, state.cameras[camera], state.trajectories[rows.label]) - rows.pixels)[rows.use]
        good = np.isfinite(residual).all(axis=1)
        time, residual = rows.time[rows.use][good], residual[good]
        relative = 1.0 / UsedRows.of([rows]).relative_information[good]
        order = np.argsort(time, kind="stable")
        first = max(0, (len(order) - _MAX_ROWS) // 2)
        order = order[first : first + _MAX_ROWS]
        out.append((time[order], residual[order], relative[order]))
    return out
