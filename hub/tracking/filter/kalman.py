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
) -> tuple[Floats, Floats, Floats, Floats]:
    """Kalman update of each state with one measurement, and what `fit` says of the measurements.

    innovation: (n, m), measured minus predicted. jacobian: (n, m, 7), derivative of the predicted measurement by the
    state. noise: (n, m, m) measurement covariance. used: (n, m) mask of valid rows; the others have no effect. The
    Joseph form keeps covariances symmetric and positive definite.
    """
    innovation, jacobian, noise = mask_rows(innovation, jacobian, noise, used)
    cross = covariance @ jacobian.transpose(0, 2, 1)
    total = jacobian @ cross + noise
    solved = np.linalg.solve(total, np.concatenate([cross.transpose(0, 2, 1), innovation[:, :, None]], axis=2))
    gain = solved[:, :, :STATE_DIM].transpose(0, 2, 1)
    i_minus_kh = np.eye(STATE_DIM) - gain @ jacobian
    new = i_minus_kh @ covariance @ i_minus_kh.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    moved = mean + (gain @ innovation[:, :, None])[:, :, 0]
    squared = (innovation * solved[:, :, STATE_DIM]).sum(axis=1)
    return moved, _symmetric(new), squared, np.linalg.slogdet(total)[1]


def fit(innovation: Floats, total: Floats, used: Bools) -> tuple[Floats, Floats]:
    """Squared Mahalanobis distances (n,) and the logarithms (n,) of the determinants of the used rows' covariances.

    innovation: (n, m). total: (n, m, m) its covariance. Their sum is -2 log likelihood, without the constant term.
    """
    total, innovation = _masked(total, used), np.where(used, innovation, 0.0)
    solved = np.linalg.solve(total, innovation[:, :, None])[:, :, 0]
    return (innovation * solved).sum(axis=1), np.linalg.slogdet(total)[1]


def moment_match(one: tuple[Floats, Floats], other: tuple[Floats, Floats], weight: Floats) -> tuple[Floats, Floats]:
    """The Gaussian with the mean and covariance of a mixture of two Gaussians. weight: (n,) of the second."""
    off = other[0] - one[0]
    mean = one[0] + weight[:, None] * off
    across = (weight * (1.0 - weight))[:, None, None] * off[:, :, None] * off[:, None, :]
    part = weight[:, None, None]
    return mean, (1.0 - part) * one[1] + part * other[1] + across


def mask_rows(innovation: Floats, jacobian: Floats, noise: Floats, used: Bools) -> tuple[Floats, Floats, Floats]:
    """Neutralise the unused rows of a measurement: zero innovation, zero Jacobian, unit noise."""
    return np.where(used, innovation, 0.0), np.where(used[:, :, None], jacobian, 0.0), _masked(noise, used)


def _masked(covariance: Floats, used: Bools) -> Floats:
    row, clear = np.arange(used.shape[1]), np.where(used[:, :, None] & used[:, None, :], covariance, 0.0)
    clear[:, row, row] = np.where(used, clear[:, row, row], 1.0)
    return clear


def log_density(off: Floats, covariance: Floats) -> Floats:
    """Logarithm (n,) of Gaussian densities at ``off`` (n, d) from their means, without the constant term."""
    squared = (off * np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).sum(axis=1)
    return np.asarray(-0.5 * (squared + np.linalg.slogdet(covariance)[1]))


def fused(mean: Floats, covariance: Floats, other_mean: Floats, other_covariance: Floats) -> tuple[Floats, Floats]:
    """Two independent estimates (n, 7), (n, 7, 7) of the same states as one."""
    right = np.concatenate([other_covariance, (other_mean - mean)[:, :, None]], axis=2)
    out = covariance @ np.linalg.solve(covariance + other_covariance, right)
    return mean + out[:, :, STATE_DIM], _symmetric(out[:, :, :STATE_DIM])


def with_information(
    mean: Floats, covariance: Floats, information: Floats, vector: Floats
) -> tuple[Floats, Floats, Floats]:
    """States (n, 7), (n, 7, 7) after measurements given by their information (n, 7, 7) and its vector (n, 7).

    Also the log likelihoods (n,) of the measurements, but for what does not depend on the state.
    """
    factor = np.eye(STATE_DIM) + covariance @ information
    right = np.concatenate([covariance, (mean + (covariance @ vector[:, :, None])[:, :, 0])[:, :, None]], axis=2)
    out = np.linalg.solve(factor, right)
    posterior = out[:, :, STATE_DIM]
    left = vector - (information @ posterior[:, :, None])[:, :, 0]
    likelihood = 0.5 * ((mean * left + vector * posterior).sum(axis=1) - np.linalg.slogdet(factor)[1])
    return posterior, _symmetric(out[:, :, :STATE_DIM]), likelihood


def _symmetric(covariance: Floats) -> Floats:
    return np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)))
