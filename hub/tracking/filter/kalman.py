"""Vectorised Kalman filter for many targets: white-noise-acceleration motion model, masked measurement rows.

State vectors are (n, 7): position, velocity, natural logarithm of the target's size, in world units and seconds.
"""

from __future__ import annotations

import numpy as np

from protocols.geometry.types import Bools, Floats

STATE_DIM = 7  # position, velocity, log size
POSITION, VELOCITY, LOG_SIZE = slice(0, 3), slice(3, 6), 6


def predict(
    mean: Floats,
    covariance: Floats,
    elapsed: Floats | float,
    acceleration_psd: Floats,
    log_size_psd: float,
    velocity_psd: Floats | float = 0.0,
) -> tuple[Floats, Floats]:
    """Predict states by ``elapsed`` seconds, each or all. Negative: extrapolated backwards, process noise still adds.

    mean: (n, 7). covariance: (n, 7, 7). acceleration_psd: (n,) spectral density of the white acceleration [unit²/s³].
    velocity_psd: (n,) that of the white velocity beside it [unit²/s]. log_size_psd: that of the random walk of log size
    [1/s]. Discretisation of Bar-Shalom, Li,
    Kirubarajan (2001), eqs. 6.2.2-12 and -13: two steps equal one step of their sum, so the result does not depend
    on the times at which other cameras capture.
    """
    dt, time = np.abs(elapsed), np.reshape(elapsed, (-1, 1))
    mean, covariance, axis = mean.copy(), covariance.copy(), np.arange(3)
    mean[:, POSITION] += time * mean[:, VELOCITY]
    covariance[:, POSITION] += time[:, :, None] * covariance[:, VELOCITY]
    covariance[:, :, POSITION] += time[:, :, None] * covariance[:, :, VELOCITY]
    across = (acceleration_psd * (0.5 * dt * elapsed))[:, None]
    covariance[:, axis, axis] += (acceleration_psd * (dt**3 / 3.0) + velocity_psd * dt)[:, None]
    covariance[:, axis, axis + 3] += across
    covariance[:, axis + 3, axis] += across
    covariance[:, axis + 3, axis + 3] += (acceleration_psd * dt)[:, None]
    covariance[:, LOG_SIZE, LOG_SIZE] += log_size_psd * dt
    return mean, covariance


def update(
    mean: Floats, covariance: Floats, innovation: Floats, jacobian: Floats, noise: Floats, used: Bools
) -> tuple[Floats, Floats]:
    """Kalman update of each state with one measurement.

    innovation: (n, m), measured minus predicted. jacobian: (n, m, 7), derivative of the predicted measurement by the
    state. noise: (n, m, m) measurement covariance. used: (n, m) mask of valid rows; the others have no effect. The
    Joseph form keeps covariances symmetric and positive definite.
    """
    innovation, jacobian, noise = mask_rows(innovation, jacobian, noise, used)
    cross = covariance @ jacobian.transpose(0, 2, 1)
    innovation_covariance = jacobian @ cross + noise
    gain = np.linalg.solve(innovation_covariance, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    i_minus_kh = np.eye(STATE_DIM) - gain @ jacobian
    new = i_minus_kh @ covariance @ i_minus_kh.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    moved = mean + (gain @ innovation[:, :, None])[:, :, 0]
    return moved, 0.5 * (new + new.transpose(0, 2, 1))


def minus_two_log_likelihood(
    covariance: Floats, innovation: Floats, jacobian: Floats, noise: Floats, used: Bools
) -> Floats:
    """-2 log likelihood (n,) of one measurement each, without the constant term; arguments as in `update`."""
    squared, innovation_covariance = _innovation(covariance, innovation, jacobian, noise, used)
    return np.asarray(squared + np.linalg.slogdet(innovation_covariance)[1])


def normalised_innovation_squared(
    covariance: Floats, innovation: Floats, jacobian: Floats, noise: Floats, used: Bools
) -> Floats:
    """Squared Mahalanobis distances (n,) of one measurement each; arguments as in `update`."""
    return _innovation(covariance, innovation, jacobian, noise, used)[0]


def _innovation(
    covariance: Floats, innovation: Floats, jacobian: Floats, noise: Floats, used: Bools
) -> tuple[Floats, Floats]:
    innovation, jacobian, noise = mask_rows(innovation, jacobian, noise, used)
    innovation_covariance = jacobian @ covariance @ jacobian.transpose(0, 2, 1) + noise
    solved = np.linalg.solve(innovation_covariance, innovation[:, :, None])[:, :, 0]
    return np.asarray((innovation * solved).sum(axis=1)), innovation_covariance


def moment_match(one: tuple[Floats, Floats], other: tuple[Floats, Floats], weight: Floats) -> tuple[Floats, Floats]:
    """The Gaussian with the mean and covariance of a mixture of two Gaussians. weight: (n,) of the second."""
    off = other[0] - one[0]
    mean = one[0] + weight[:, None] * off
    across = (weight * (1.0 - weight))[:, None, None] * off[:, :, None] * off[:, None, :]
    part = weight[:, None, None]
    return mean, (1.0 - part) * one[1] + part * other[1] + across


def mask_rows(innovation: Floats, jacobian: Floats, noise: Floats, used: Bools) -> tuple[Floats, Floats, Floats]:
    """Neutralise the unused rows of a measurement: zero innovation, zero Jacobian, unit noise."""
    off = ~used
    both = used[:, :, None] & used[:, None, :]
    clear = np.where(both, noise, 0.0)
    row = np.arange(used.shape[1])
    clear[:, row, row] = np.where(off, 1.0, clear[:, row, row])
    return np.where(used, innovation, 0.0), np.where(used[:, :, None], jacobian, 0.0), clear


def log_density(off: Floats, covariance: Floats) -> Floats:
    """Logarithm (n,) of Gaussian densities at ``off`` (n, d) from their means, without the constant term."""
    squared = (off * np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).sum(axis=1)
    return np.asarray(-0.5 * (squared + np.linalg.slogdet(covariance)[1]))


def fused(mean: Floats, covariance: Floats, other_mean: Floats, other_covariance: Floats) -> tuple[Floats, Floats]:
    """Two independent estimates (n, 7), (n, 7, 7) of the same states as one."""
    one, two = np.linalg.inv(covariance), np.linalg.inv(other_covariance)
    both = np.linalg.inv(one + two)
    both = 0.5 * (both + both.transpose(0, 2, 1))
    return (both @ (one @ mean[:, :, None] + two @ other_mean[:, :, None]))[:, :, 0], both
