"""The Kalman filter against the batch solution of the same linear problem, and its invariants."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hub.tracking.filter import kalman
from protocols.geometry.types import Floats

STATE_DIM = kalman.STATE_DIM


def prior() -> tuple[Floats, Floats]:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(STATE_DIM, STATE_DIM))
    return rng.normal(size=(1, STATE_DIM)), (root @ root.T + np.eye(STATE_DIM))[None]


def motion(elapsed: float, acceleration_psd: float, log_size_psd: float, velocity_psd: float) -> tuple[Floats, Floats]:
    """Transition and noise by definition: the integral of F(s) G q Gᵀ F(s)ᵀ."""
    step = np.eye(STATE_DIM)
    step[:3, 3:6] = elapsed * np.eye(3)
    noise = np.zeros((STATE_DIM, STATE_DIM))
    for s in (np.arange(2000) + 0.5) * elapsed / 2000:
        jacobian = np.zeros((STATE_DIM, 4))
        jacobian[:3, :3], jacobian[3:6, :3], jacobian[6, 3] = s * np.eye(3), np.eye(3), 1.0
        noise += jacobian @ np.diag([acceleration_psd] * 3 + [log_size_psd]) @ jacobian.T * elapsed / 2000
    noise[:3, :3] += velocity_psd * elapsed * np.eye(3)
    return step, noise


def test_filtering_equals_the_batch_least_squares_solution() -> None:
    """States at three times, all as unknowns of one linear problem with dense weights: same mean, same covariance."""
    rng = np.random.default_rng(2)
    mean, covariance = prior()
    steps, psd = (0.11, 0.034, 0.3), (0.7, 0.02, 0.05)
    measurements = [
        (rng.normal(size=(4, STATE_DIM)), rng.normal(size=4), np.diag(rng.uniform(0.1, 2.0, 4))) for _ in steps
    ]

    count = len(steps) + 1
    hessian, gradient = np.zeros((count * STATE_DIM, count * STATE_DIM)), np.zeros(count * STATE_DIM)
    first = slice(0, STATE_DIM)
    hessian[first, first] += np.linalg.inv(covariance[0])
    gradient[first] += np.linalg.inv(covariance[0]) @ mean[0]
    for k, (elapsed, (jacobian, seen, noise)) in enumerate(zip(steps, measurements, strict=True)):
        here, then = slice(k * STATE_DIM, (k + 1) * STATE_DIM), slice((k + 1) * STATE_DIM, (k + 2) * STATE_DIM)
        step, drift = motion(elapsed, *psd)
        weight = np.linalg.inv(drift)
        hessian[then, then] += weight + jacobian.T @ np.linalg.inv(noise) @ jacobian
        hessian[here, here] += step.T @ weight @ step
        hessian[then, here] -= weight @ step
        hessian[here, then] -= step.T @ weight
        gradient[then] += jacobian.T @ np.linalg.inv(noise) @ seen
    batch = np.linalg.solve(hessian, gradient)[-STATE_DIM:]
    spread = np.linalg.inv(hessian)[-STATE_DIM:, -STATE_DIM:]

    for elapsed, (jacobian, seen, noise) in zip(steps, measurements, strict=True):
        mean, covariance = kalman.predict(mean, covariance, elapsed, np.array([psd[0]]), *psd[1:])
        off = (seen - jacobian @ mean[0])[None]
        mean, covariance, *_ = kalman.update(
            mean, covariance, off, jacobian[None], noise[None], np.ones((1, 4), dtype=bool)
        )
    np.testing.assert_allclose(mean[0], batch, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(covariance[0], spread, rtol=1e-3, atol=1e-5)


def test_two_predictions_equal_one_of_their_sum() -> None:
    mean, covariance = prior()
    noise = np.array([0.7]), 0.1, np.array([0.3])
    once = kalman.predict(mean, covariance, 0.5, *noise)
    twice = kalman.predict(*kalman.predict(mean, covariance, 0.2, *noise), 0.3, *noise)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_unused_rows_have_no_effect() -> None:
    """Even if they hold NaN: the result is that of the other rows alone."""
    rng = np.random.default_rng(3)
    mean, covariance = prior()
    jacobian, noise, off = (
        rng.normal(size=(1, 4, STATE_DIM)),
        np.diag([1.0, 2.0, 3.0, 4.0])[None],
        rng.normal(size=(1, 4)),
    )
    used = np.array([[True, False, True, False]])
    spoiled = np.where(used, off, np.nan)
    full = kalman.update(mean, covariance, spoiled, jacobian, noise, used)
    few = kalman.update(
        mean, covariance, off[:, ::2], jacobian[:, ::2], noise[:, ::2, ::2], np.ones((1, 2), dtype=bool)
    )
    for a, b in zip(full, few, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("noise", [1e-12, 1e12])
def test_covariances_stay_symmetric_and_positive(noise: float) -> None:
    mean, covariance = prior()
    rng = np.random.default_rng(4)
    for _ in range(50):
        mean, covariance = kalman.predict(mean, covariance, 0.03, np.array([1.0]), 1e-4)
        jacobian = rng.normal(size=(1, 2, STATE_DIM))
        mean, covariance, *_ = kalman.update(
            mean, covariance, rng.normal(size=(1, 2)), jacobian, noise * np.eye(2)[None], np.ones((1, 2), dtype=bool)
        )
    assert np.isfinite(covariance).all()
    np.testing.assert_array_equal(covariance[0], covariance[0].T)
    assert np.linalg.eigvalsh(covariance[0]).min() > -1e-9 * np.abs(covariance).max()


def test_information_of_measurements_against_marginal_densities() -> None:
    """Three rows measured by two states: posterior by inverses, likelihood by scipy's density of the measurement."""
    rng = np.random.default_rng(3)
    (mean, covariance), (other, spread) = prior(), prior()
    other = other + rng.normal(size=other.shape)
    jacobian, noise = rng.normal(size=(3, STATE_DIM)), np.diag([0.1, 0.4, 2.0])
    value = rng.normal(size=3)
    information = (jacobian.T @ np.linalg.solve(noise, jacobian))[None]
    vector = (jacobian.T @ np.linalg.solve(noise, value))[None]
    densities = []
    for at, around in ((mean, covariance), (other, 3.0 * spread)):
        total = jacobian @ around[0] @ jacobian.T + noise
        densities.append(multivariate_normal(jacobian @ at[0], total).logpdf(value))
    found = [
        kalman.with_information(*each, information, vector) for each in ((mean, covariance), (other, 3.0 * spread))
    ]
    assert found[0][2] - found[1][2] == pytest.approx(densities[0] - densities[1], abs=1e-9)
    inverse = np.linalg.inv(np.linalg.inv(covariance[0]) + information[0])
    assert found[0][1][0] == pytest.approx(inverse, abs=1e-9)
    assert found[0][0][0] == pytest.approx(inverse @ (np.linalg.solve(covariance[0], mean[0]) + vector[0]), abs=1e-9)
    both, variance = kalman.fused(mean, covariance, other, 3.0 * spread)
    inverse = np.linalg.inv(np.linalg.inv(covariance[0]) + np.linalg.inv(3.0 * spread[0]))
    assert variance[0] == pytest.approx(inverse, abs=1e-9)
    weighted = np.linalg.solve(covariance[0], mean[0]) + np.linalg.solve(3.0 * spread[0], other[0])
    assert both[0] == pytest.approx(inverse @ weighted, abs=1e-9)
