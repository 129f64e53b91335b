"""Constant-acceleration motion with white-noise jerk, and the Rauch–Tung–Striebel smoother for it.

State vectors are (9,): position, velocity, acceleration, in world units and seconds.
"""

from __future__ import annotations

import numpy as np

from protocols.geometry.types import Floats

STATE_DIM = 9
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
    both = (elapsed**_POWERS @ _BASIS).reshape(2 * STATE_DIM, STATE_DIM)
    return both[:STATE_DIM], both[STATE_DIM:]


def rts_smooth(time: Floats, mean: Floats, covariance: Floats, psd: Floats) -> tuple[Floats, Floats]:
    """Smoothed means (n, 9) and covariances (n, 9, 9) from filtered ones (Rauch, Tung, Striebel 1965).

    time: (n,) [s], in order. psd: (n,) spectral density [unit²/s⁵] of the jerk before each state; the first is unused.
    """
    both = ((np.diff(time)[:, None] ** _POWERS) @ _BASIS).reshape(-1, 2 * STATE_DIM, STATE_DIM)
    step, noise = both[:, :STATE_DIM], psd[1:, None, None] * both[:, STATE_DIM:]
    ahead = step @ mean[:-1, :, None]
    cross = step @ covariance[:-1]
    predicted = cross @ step.transpose(0, 2, 1) + noise
    # Scaled to a unit diagonal: accelerations and positions differ by the square of a frame interval.
    scale = 1.0 / np.sqrt(np.einsum("nii->ni", predicted))
    gain = np.linalg.solve(predicted * scale[:, :, None] * scale[:, None, :], cross * scale[:, :, None])
    gain = (gain * scale[:, :, None]).transpose(0, 2, 1)
    means, covariances = mean.copy(), covariance.copy()
    for k in range(len(time) - 2, -1, -1):
        means[k] += gain[k] @ (means[k + 1] - ahead[k, :, 0])
        covariances[k] += gain[k] @ (covariances[k + 1] - predicted[k]) @ gain[k].T
    return means, covariances
