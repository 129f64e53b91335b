"""The Kalman filter of many targets at once: white-acceleration motion, masked measurement rows.

A state is (n, 7): position, velocity, and the natural logarithm of the target's size, in world units and seconds.
"""

from __future__ import annotations

import numpy as np

from protocols.geometry.types import Bools, Floats

SIZE = 7
POSITION, VELOCITY, LOG_SIZE = slice(0, 3), slice(3, 6), 6


def predict(
    mean: Floats, covariance: Floats, elapsed: float, restlessness: Floats, growth: float
) -> tuple[Floats, Floats]:
    """States ``elapsed`` seconds later, which may be negative only for looking (nothing is then taken back).

    mean: (n, 7). covariance: (n, 7, 7). restlessness: (n,) density of the white acceleration [unit²/s³].
    growth: density of the size's random walk [1/s]. Bar-Shalom, Li, Kirubarajan (2001), eqs. 6.2.2-12 and -13: two
    steps are one step of their sum, so that it does not matter at which times other cameras fire.
    """
    step = np.eye(SIZE)
    step[POSITION, VELOCITY] = elapsed * np.eye(3)
    dt = abs(elapsed)
    noise = np.zeros_like(covariance)
    for axis in range(3):
        noise[:, axis, axis] = restlessness * (dt**3 / 3.0)
        noise[:, axis, axis + 3] = restlessness * (0.5 * dt * elapsed)
        noise[:, axis + 3, axis] = restlessness * (0.5 * dt * elapsed)
        noise[:, axis + 3, axis + 3] = restlessness * dt
    noise[:, LOG_SIZE, LOG_SIZE] = growth * dt
    return mean @ step.T, step @ covariance @ step.T + noise


def update(
    mean: Floats, covariance: Floats, innovation: Floats, slope: Floats, noise: Floats, used: Bools
) -> tuple[Floats, Floats]:
    """States after one measurement each.

    innovation: (n, m), measured minus predicted. slope: (n, m, 7), derivative of the prediction by the state. noise:
    (n, m, m). used: (n, m), rows that count; the others change nothing. Joseph's form keeps covariances symmetric
    and positive.
    """
    innovation, slope, noise = masked(innovation, slope, noise, used)
    cross = covariance @ slope.transpose(0, 2, 1)
    spread = slope @ cross + noise
    gain = np.linalg.solve(spread, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    rest = np.eye(SIZE) - gain @ slope
    new = rest @ covariance @ rest.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    moved = mean + (gain @ innovation[:, :, None])[:, :, 0]
    return moved, 0.5 * (new + new.transpose(0, 2, 1))


def misfit(covariance: Floats, innovation: Floats, slope: Floats, noise: Floats, used: Bools) -> Floats:
    """-2 log likelihood (n,) of one measurement each, without the constant of its rows; arguments as in `update`."""
    innovation, slope, noise = masked(innovation, slope, noise, used)
    spread = slope @ covariance @ slope.transpose(0, 2, 1) + noise
    solved = np.linalg.solve(spread, innovation[:, :, None])[:, :, 0]
    return np.asarray((innovation * solved).sum(axis=1) + np.linalg.slogdet(spread)[1])


def merged(one: tuple[Floats, Floats], other: tuple[Floats, Floats], share: Floats) -> tuple[Floats, Floats]:
    """The Gaussian with mean and covariance of a mixture of two. share: (n,) of the second."""
    off = other[0] - one[0]
    mean = one[0] + share[:, None] * off
    across = (share * (1.0 - share))[:, None, None] * off[:, :, None] * off[:, None, :]
    part = share[:, None, None]
    return mean, (1.0 - part) * one[1] + part * other[1] + across


def masked(innovation: Floats, slope: Floats, noise: Floats, used: Bools) -> tuple[Floats, Floats, Floats]:
    """The same measurement with the rows that don't count made void: no innovation, no slope, unit noise."""
    off = ~used
    both = used[:, :, None] & used[:, None, :]
    clear = np.where(both, noise, 0.0)
    row = np.arange(used.shape[1])
    clear[:, row, row] = np.where(off, 1.0, clear[:, row, row])
    return np.where(used, innovation, 0.0), np.where(used[:, :, None], slope, 0.0), clear
