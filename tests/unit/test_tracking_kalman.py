"""The filter of the tracks against the batch solution of the same linear problem, and its small print."""

from __future__ import annotations

import numpy as np
import pytest

from hub.tracking.filter import kalman
from protocols.geometry.types import Floats

SIZE = kalman.SIZE


def prior() -> tuple[Floats, Floats]:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(SIZE, SIZE))
    return rng.normal(size=(1, SIZE)), (root @ root.T + np.eye(SIZE))[None]


def motion(elapsed: float, restless: float, growth: float) -> tuple[Floats, Floats]:
    """Transition and noise written out by their definition: the integral of F(s) G q Gᵀ F(s)ᵀ."""
    step = np.eye(SIZE)
    step[:3, 3:6] = elapsed * np.eye(3)
    noise = np.zeros((SIZE, SIZE))
    for s in (np.arange(2000) + 0.5) * elapsed / 2000:
        slope = np.zeros((SIZE, 4))
        slope[:3, :3], slope[3:6, :3], slope[6, 3] = s * np.eye(3), np.eye(3), 1.0
        noise += slope @ np.diag([restless] * 3 + [growth]) @ slope.T * elapsed / 2000
    return step, noise


def test_filtering_is_the_batch_least_squares_solution() -> None:
    """States at three times, all as unknowns of one linear problem with dense weights: same mean, same covariance."""
    rng = np.random.default_rng(2)
    mean, covariance = prior()
    steps, restless, growth = (0.11, 0.034, 0.3), 0.7, 0.02
    looks = [(rng.normal(size=(4, SIZE)), rng.normal(size=4), np.diag(rng.uniform(0.1, 2.0, 4))) for _ in steps]

    count = len(steps) + 1
    hessian, gradient = np.zeros((count * SIZE, count * SIZE)), np.zeros(count * SIZE)
    first = slice(0, SIZE)
    hessian[first, first] += np.linalg.inv(covariance[0])
    gradient[first] += np.linalg.inv(covariance[0]) @ mean[0]
    for k, (elapsed, (slope, seen, noise)) in enumerate(zip(steps, looks, strict=True)):
        here, then = slice(k * SIZE, (k + 1) * SIZE), slice((k + 1) * SIZE, (k + 2) * SIZE)
        step, drift = motion(elapsed, restless, growth)
        weight = np.linalg.inv(drift)
        hessian[then, then] += weight + slope.T @ np.linalg.inv(noise) @ slope
        hessian[here, here] += step.T @ weight @ step
        hessian[then, here] -= weight @ step
        hessian[here, then] -= step.T @ weight
        gradient[then] += slope.T @ np.linalg.inv(noise) @ seen
    batch = np.linalg.solve(hessian, gradient)[-SIZE:]
    spread = np.linalg.inv(hessian)[-SIZE:, -SIZE:]

    for elapsed, (slope, seen, noise) in zip(steps, looks, strict=True):
        mean, covariance = kalman.predict(mean, covariance, elapsed, np.array([restless]), growth)
        off = (seen - slope @ mean[0])[None]
        mean, covariance = kalman.update(mean, covariance, off, slope[None], noise[None], np.ones((1, 4), dtype=bool))
    np.testing.assert_allclose(mean[0], batch, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(covariance[0], spread, rtol=1e-3, atol=1e-5)


def test_two_steps_are_one_step_of_their_sum() -> None:
    mean, covariance = prior()
    restless = np.array([0.7])
    once = kalman.predict(mean, covariance, 0.5, restless, 0.1)
    half = kalman.predict(mean, covariance, 0.2, restless, 0.1)
    twice = kalman.predict(*half, 0.3, restless, 0.1)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_rows_that_do_not_count_change_nothing() -> None:
    """Not even where they hold NaN: the answer is that of the other rows alone."""
    rng = np.random.default_rng(3)
    mean, covariance = prior()
    slope, noise, off = rng.normal(size=(1, 4, SIZE)), np.diag([1.0, 2.0, 3.0, 4.0])[None], rng.normal(size=(1, 4))
    used = np.array([[True, False, True, False]])
    spoiled = np.where(used, off, np.nan)
    full = kalman.update(mean, covariance, spoiled, slope, noise, used)
    few = kalman.update(mean, covariance, off[:, ::2], slope[:, ::2], noise[:, ::2, ::2], np.ones((1, 2), dtype=bool))
    for a, b in zip(full, few, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("noise", [1e-12, 1e12])
def test_covariances_stay_covariances(noise: float) -> None:
    mean, covariance = prior()
    rng = np.random.default_rng(4)
    for _ in range(50):
        mean, covariance = kalman.predict(mean, covariance, 0.03, np.array([1.0]), 1e-4)
        slope = rng.normal(size=(1, 2, SIZE))
        mean, covariance = kalman.update(
            mean, covariance, rng.normal(size=(1, 2)), slope, noise * np.eye(2)[None], np.ones((1, 2), dtype=bool)
        )
    assert np.isfinite(covariance).all()
    np.testing.assert_array_equal(covariance[0], covariance[0].T)
    assert np.linalg.eigvalsh(covariance[0]).min() > -1e-9 * np.abs(covariance).max()
