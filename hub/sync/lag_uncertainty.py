"""How far a pair's lag leans on lenses that are only about as told, and on any one part of the motion.

Where a path is nearly flat or slow, a focal length 1 % off or rows that are read one after another move the lag by
more than noise does, and residuals do not tell it. So both lenses' errors and readouts are parameters too, under
priors as wide as those errors usually are: consider parameters first (Schmidt's filter: they add to the covariance),
which is cheap, and freed where that leaves the lag in doubt. Residuals that are alike count as one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.sync.alignment import Samples, correlated
from hub.two_view.refinement import WIDE, Refined
from hub.two_view.relative_pose import RelativePose, homogeneous
from protocols.geometry.types import Bools, Floats

_LENS = (0.015, 0.012, 0.012, 0.02)
"""Std of what is told of a lens: log focal length, principal point (normalised), k1."""
_READOUT = 0.02
"""Std [s] of the time in which a shutter rolls over one unit of normalised height: 15 ms for most pictures."""
_TOLERANCE = np.array([*_LENS, *_LENS, _READOUT, _READOUT])
_POSE = 5
_MIDDLE, _SLOWNESS = _POSE, _POSE + 1
_PARTS = 5
_ITERATIONS = 20
_STILL = 1e-5  # relative fall of the cost at which a search ends
_GIVEN_UP = 1e6  # damping


@dataclass(frozen=True, slots=True, eq=False)
class Leaning:
    """The time map ``t_b = slowness * (t_a - centre) + middle`` in the samples' centre, and how firm it is.

    std [s]: of middle, lenses and readouts included. swing [s]: the most that it moves when a fifth of the samples, in
    a row, is left out; 0 where it was not looked at.
    """

    slowness: float
    middle: float
    std: float
    swing: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """lens: (10,) log focal length, centre (2) and k1 of a, then of b, then both readouts [s per unit of height]."""

    pose: RelativePose
    middle: float
    slowness: float
    lens: Floats

    def moved(self, step: Floats) -> _State:
        return _State(
            self.pose.moved(step[:_POSE]),
            self.middle + float(step[_MIDDLE]),
            self.slowness + float(step[_SLOWNESS]),
            self.lens + step[_SLOWNESS + 1 :],
        )


def leaning(samples: Samples, found: Refined, sigma: tuple[float, float], rate_std: float, sure: float) -> Leaning:
    """How firm the lag of ``found`` is; where it is less so than ``sure`` [s], with the lenses freed.

    found: with a relative pose, ``middle`` in the samples' centre. sigma: noise of normalised points of a and of b.
    rate_std: prior of the rate about 1. Raises TypeError for a fundamental matrix.
    """
    if not isinstance(found.geometry, RelativePose):
        raise TypeError("without lenses there are no lenses to free")
    state = _State(found.geometry, found.middle, found.slowness, np.zeros(len(_TOLERANCE)))
    every = np.ones(samples.count, dtype=np.bool_)
    residual, jacobian = _rows(samples, state, sigma, every)
    scale = max(float(np.median(np.abs(residual))) / 0.6745, 1e-9)
    prior = np.concatenate([np.zeros(_MIDDLE + 1), [rate_std**-2], _TOLERANCE**-2])
    weight = _robust(residual, WIDE * scale)
    over = _over_white(residual, jacobian[:, : _SLOWNESS + 1], weight, scale, prior[: _SLOWNESS + 1])
    std = _considered(jacobian / (scale * over), weight, prior)
    if std <= sure:
        return Leaning(found.slowness, found.middle, std)
    noise, width = (sigma[0] * scale * over, sigma[1] * scale * over), WIDE / over
    freed, std = _solve(samples, state, noise, width, prior, every)
    part = np.argsort(np.argsort(samples.time)) * _PARTS // samples.count
    without = [_solve(samples, freed, noise, width, prior, part != k)[0] for k in range(_PARTS)]
    swing = max(abs(one.middle - freed.middle) for one in without)
    return Leaning(freed.slowness, freed.middle, std, swing)


def _over_white(residual: Floats, jacobian: Floats, weight: Floats, scale: float, prior: Floats) -> float:
    """By how much residuals that are alike make the lag's std larger than as many separate ones (n,) would.

    A sandwich with the residuals' own correlations: what is alike for long the geometry takes up, and the lag is
    spared.
    """
    correlations = correlated(residual)
    spread = scale * np.sqrt(max(2.0 * float(correlations.sum()) - 1.0, 1.0))
    weighted = jacobian * weight[:, None]
    covariance = np.linalg.pinv(weighted.T @ jacobian / spread**2 + np.diag(prior), hermitian=True)[_MIDDLE]
    share = weighted @ covariance * (scale / spread**2)  # what a residual moves the lag by
    along = share @ share + 2.0 * sum(
        float(one) * float(share[lag:] @ share[:-lag]) for lag, one in enumerate(correlations[1:], start=1)
    )
    return float(max(spread / scale * np.sqrt(max(along, 0.0) / covariance[_MIDDLE]), 1.0))


def _considered(jacobian: Floats, weight: Floats, prior: Floats) -> float:
    """Std of the lag where the lenses stay as told: by noise, and by what their tolerance does to it."""
    own = _SLOWNESS + 1
    weighted = jacobian * weight[:, None]
    normal = weighted.T @ jacobian
    covariance = np.linalg.pinv(normal[:own, :own] + np.diag(prior[:own]), hermitian=True)
    leant = covariance[_MIDDLE] @ normal[:own, own:] * _TOLERANCE
    return float(np.sqrt(covariance[_MIDDLE, _MIDDLE] + leant @ leant))


def _solve(
    samples: Samples, state: _State, noise: tuple[float, float], width: float, prior: Floats, use: Bools
) -> tuple[_State, float]:
    """Levenberg-Marquardt over all parameters, and the std of the lag. use: (n,) the samples that count."""

    def system(at: _State) -> tuple[Floats, Floats, float]:
        residual, jacobian = _rows(samples, at, noise, use)
        weighted = jacobian * _robust(residual, width)[:, None]
        off = np.concatenate([np.zeros(_MIDDLE + 1), [at.slowness - 1.0], at.lens])
        cost = width**2 * float(np.log1p((residual / width) ** 2).sum()) + float((prior * off * off).sum())
        return weighted.T @ jacobian + np.diag(prior), weighted.T @ residual + prior * off, cost

    damping = 1e-3
    normal, gradient, cost = system(state)
    for _ in range(_ITERATIONS):
        step = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-12), -gradient)
        trial = state.moved(np.asarray(step, dtype=np.float64))
        there = system(trial)
        if there[2] < cost:
            done = cost - there[2] < _STILL * cost
            state, (normal, gradient, cost) = trial, there
            damping = max(damping / 5.0, 1e-9)
            if done:
                break
        else:
            damping *= 8.0
            if damping > _GIVEN_UP:
                break
    return state, float(np.sqrt(np.linalg.pinv(normal, hermitian=True)[_MIDDLE, _MIDDLE]))


def _rows(samples: Samples, state: _State, noise: tuple[float, float], use: Bools) -> tuple[Floats, Floats]:
    """Sampson distances over the noise (n,), and their derivatives (n, 17): pose, middle, slowness, lenses."""
    lever = samples.time - samples.centre
    time = state.slowness * lever + state.middle
    readout_a, readout_b = state.lens[-2:]
    # A row below the middle is read later; b's own one is known well enough at the time without that.
    height_b = np.nan_to_num(samples.of_b(time)[0][:, 1])
    b, speed = samples.of_b(time + readout_a * samples.points[:, 1] - readout_b * height_b)
    there = np.isfinite(b[:, 0]) & use
    a, b, speed, lever = samples.points[there], b[there], speed[there], lever[there]
    true_a, true_b = _freed(a, state.lens[:4]), _freed(b, state.lens[4:8])
    matrix = state.pose.matrix
    line_a, line_b = homogeneous(true_b) @ matrix, homogeneous(true_a) @ matrix.T
    variance = noise[0] ** 2 * (line_a[:, :2] ** 2).sum(axis=1) + noise[1] ** 2 * (line_b[:, :2] ** 2).sum(axis=1)
    over = 1.0 / np.sqrt(np.maximum(variance, 1e-30))
    jacobian = np.empty((len(a), _SLOWNESS + 1 + len(_TOLERANCE)))
    products = homogeneous(true_b)[:, :, None] * homogeneous(true_a)[:, None, :]
    jacobian[:, :_POSE] = products.reshape(-1, 9) @ state.pose.tangents().reshape(_POSE, 9).T
    jacobian[:, _MIDDLE] = (line_b[:, :2] * speed).sum(axis=1)
    jacobian[:, _SLOWNESS] = jacobian[:, _MIDDLE] * lever
    jacobian[:, 7:11] = _by_lens(a, line_a)
    jacobian[:, 11:15] = _by_lens(b, line_b)
    jacobian[:, 15] = jacobian[:, _MIDDLE] * a[:, 1]
    jacobian[:, 16] = -jacobian[:, _MIDDLE] * b[:, 1]
    return (homogeneous(true_b) * line_b).sum(axis=1) * over, jacobian * over[:, None]


def _freed(points: Floats, lens: Floats) -> Floats:
    """Normalised points (n, 2) under a lens that is off by ``lens`` (4,) from what they were made with."""
    moved = (points - lens[1:3]) * np.exp(-lens[0])
    return np.asarray(moved * (1.0 - lens[3] * (moved**2).sum(axis=1, keepdims=True)))


def _by_lens(points: Floats, line: Floats) -> Floats:
    """Derivatives (n, 4) of the distances from lines (n, 3) by the four numbers of a lens, to first order."""
    along = (points * line[:, :2]).sum(axis=1)
    return -np.column_stack([along, line[:, 0], line[:, 1], along * (points**2).sum(axis=1)])


def _robust(residual: Floats, width: float) -> Floats:
    return np.asarray(1.0 / (1.0 + (residual / width) ** 2))


def at_centre(found: Refined, centre: float, samples: Samples) -> Refined:
    """``found`` of samples with the centre ``centre``, in the centre of others."""
    return replace(found, middle=found.middle + found.slowness * (samples.centre - centre))


__all__ = ["Leaning", "at_centre", "leaning"]
