"""Constant-acceleration motion with white-noise jerk, and the Rauch–Tung–Striebel smoother for it.

State vectors are (9,): position, velocity, acceleration, in world units and seconds.
"""

from __future__ import annotations

import numpy as np

from protocols.geometry import kernels
from protocols.geometry.types import Floats

STATE_DIM = 9  # position, velocity, acceleration
POSITION, VELOCITY = slice(0, 3), slice(3, 6)
_POWERS = np.arange(6)
_STEP = np.zeros((6, STATE_DIM, STATE_DIM))
"""The transition over dt is the sum of dt^k _STEP[k], the noise of a unit density that of dt^k _NOISE[k]."""
_NOISE = np.zeros((6, STATE_DIM, STATE_DIM))
for _power, _row, _column, _factor in [
    (0, 0, 0, 1),
    (0, 1, 1, 1),
    (0, 2, 2, 1),
    (1, 0, 1, 1),
    (1, 1, 2, 1),
    (2, 0, 2, 2),
]:
    _STEP[_power] += np.kron(np.eye(3)[:, [_row]] * np.eye(3)[[_column]], np.eye(3)) / _factor
for _power, _row, _column, _factor in [
    (5, 0, 0, 20),
    (4, 0, 1, 8),
    (3, 0, 2, 6),
    (3, 1, 1, 3),
    (2, 1, 2, 2),
    (1, 2, 2, 1),
]:
    _pair = np.eye(3)[:, [_row]] * np.eye(3)[[_column]]
    _NOISE[_power] += np.kron(np.maximum(_pair, _pair.T), np.eye(3)) / _factor
_BASIS = np.concatenate([_STEP, _NOISE], axis=1).reshape(6, -1)


def jerk_model(elapsed: float) -> tuple[Floats, Floats]:
    """Transition (9, 9) over ``elapsed`` >= 0 [s], and its noise (9, 9) for a jerk of unit power spectral density.

    Bar-Shalom, Li, Kirubarajan (2001), section 6.2.3 (white-noise jerk): two steps equal one step of their sum.
    """
    square = elapsed * elapsed
    powers = (1.0, elapsed, square, square * elapsed, square * square, square * square * elapsed)
    both = (powers @ _BASIS).reshape(2 * STATE_DIM, STATE_DIM)
    return both[:STATE_DIM], both[STATE_DIM:]


def rts_smooth(time: Floats, mean: Floats, covariance: Floats, psd: Floats, wanted: int) -> tuple[Floats, Floats]:
    """The first ``wanted`` smoothed means (n, 9) and covariances (n, 9, 9) from filtered ones.

    Rauch, Tung, Striebel (1965); the later rows are combined in pairs (Särkkä and García-Fernández 2021). time: (n,)
    [s], in order. psd: (n,) spectral density [unit²/s⁵] of the jerk before each state; the first is unused.
    """
    if kernels.AVAILABLE:
        smoothed = np.empty((wanted, STATE_DIM)), np.empty((wanted, STATE_DIM, STATE_DIM))
        if kernels.call("smooth_jerk", len(time), wanted, time, psd, mean, covariance, *smoothed):
            return smoothed
    both = ((np.diff(time)[:, None] ** _POWERS) @ _BASIS).reshape(-1, 2 * STATE_DIM, STATE_DIM)
    step, noise = both[:, :STATE_DIM], psd[1:, None, None] * both[:, STATE_DIM:]
    cross = step @ covariance[:-1]
    predicted = cross @ step.transpose(0, 2, 1) + noise
    # Scaled to a unit diagonal: accelerations and positions differ by the square of a frame interval.
    scale = 1.0 / np.sqrt(np.einsum("nii->ni", predicted))
    gain = np.linalg.solve(predicted * scale[:, :, None] * scale[:, None, :], cross * scale[:, :, None])
    gain = (gain * scale[:, :, None]).transpose(0, 2, 1)
    # Smoothed state = gain · next smoothed state + shift, with a covariance of its own.
    shift = mean[:-1, :, None] - gain @ (step @ mean[:-1, :, None])
    own = covariance[:-1] - gain @ predicted @ gain.transpose(0, 2, 1)
    tail: tuple[Floats, ...] = gain[wanted:], shift[wanted:], own[wanted:]
    while len(tail[0]) > 1:
        even = len(tail[0]) // 2 * 2
        (g, s, c), (later, s_later, c_later) = (tuple(part[k:even:2] for part in tail) for k in (0, 1))
        pairs = g @ later, g @ s_later + s, g @ c_later @ g.transpose(0, 2, 1) + c
        tail = tuple(np.concatenate([pair, part[even:]]) for pair, part in zip(pairs, tail, strict=True))
    one, spread = mean[-1, :, None], covariance[-1]
    parts = [*zip(gain[:wanted], shift[:wanted], own[:wanted], strict=True), *zip(*tail, strict=True)]
    means, covariances = [one], [spread]
    for g, s, c in reversed(parts):
        one, spread = g @ one + s, g @ spread @ g.T + c
        means.append(one)
        covariances.append(spread)
    return np.array(means)[::-1][:wanted, :, 0], np.array(covariances)[::-1][:wanted]
