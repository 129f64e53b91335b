"""The generic particle filter: properties that hold for every model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edge.uav.prediction import particle_filter as pf
from protocols.geometry.types import Floats

_LOGS = arrays(np.float64, st.integers(1, 60), elements=st.floats(-800.0, 800.0))


@given(_LOGS)
@settings(max_examples=60, deadline=None)
def test_normalised_weights_sum_to_one_and_keep_their_ratios(logs: Floats) -> None:
    normalised = pf.normalise(logs)
    assert np.exp(normalised).sum() == pytest.approx(1.0)
    np.testing.assert_allclose(normalised - normalised.max(), logs - logs.max(), atol=1e-9)


def test_an_observation_impossible_for_all_particles_gives_uniform_weights() -> None:
    np.testing.assert_allclose(np.exp(pf.normalise(np.full(4, -np.inf))), 0.25)
    np.testing.assert_allclose(np.exp(pf.normalise(np.array([np.nan, 0.0, -np.inf]))), [0.0, 1.0, 0.0])


@given(_LOGS)
@settings(max_examples=60, deadline=None)
def test_the_effective_sample_size_is_between_one_and_n(logs: Floats) -> None:
    size = pf.effective_sample_size(np.exp(pf.normalise(logs)))
    assert 1.0 - 1e-9 <= size <= len(logs) + 1e-9


def test_the_effective_sample_size_at_its_ends() -> None:
    assert pf.effective_sample_size(np.full(50, 0.02)) == pytest.approx(50.0)
    assert pf.effective_sample_size(np.array([1.0, 0.0, 0.0])) == pytest.approx(1.0)


@given(_LOGS, st.integers(1, 200), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_systematic_resampling_is_off_by_less_than_one_copy(logs: Floats, count: int, seed: int) -> None:
    weights = np.exp(pf.normalise(logs))
    chosen = pf.systematic_resample(weights, count, np.random.default_rng(seed))
    copies = np.bincount(chosen, minlength=len(weights))
    assert copies.sum() == count
    assert (np.abs(copies - count * weights) < 1.0 + 1e-6).all()


def test_systematic_resampling_is_unbiased() -> None:
    rng = np.random.default_rng(3)
    weights = rng.dirichlet(np.full(12, 0.4))
    copies = sum(np.bincount(pf.systematic_resample(weights, 7, rng), minlength=12) for _ in range(4000))
    np.testing.assert_allclose(copies / 4000.0, 7.0 * weights, atol=0.04)


def test_the_kld_number_grows_with_spread_confidence_and_precision() -> None:
    rng = np.random.default_rng(0)
    number = pf.KldSampleSize(cell=(10.0, 10.0), min_count=1, max_count=100_000)
    wanted = [number.size_for(rng.normal(0.0, std, (2000, 2))) for std in (0.01, 10.0, 40.0, 160.0)]
    assert wanted == sorted(wanted)
    assert wanted[-1] > 10 * wanted[1]
    assert pf.kld_sample_size(30, 0.05, 0.999) > pf.kld_sample_size(30, 0.05, 0.9) > pf.kld_sample_size(30, 0.1, 0.9)
    assert pf.kld_sample_size(1, 0.05, 0.99) == 1
    # Half the chi-square quantile of 29 degrees of freedom (49.588 at 0.99) over the error.
    assert pf.kld_sample_size(30, 0.05, 0.99) == pytest.approx(49.588 / 0.1, rel=0.005)


def test_a_coordinate_of_infinite_cell_width_is_ignored() -> None:
    states = np.column_stack([np.zeros(100), np.arange(100.0)])
    assert pf.occupied_cells(states, np.array([1.0, np.inf])) == 1
    assert pf.occupied_cells(states, np.array([1.0, 1.0])) == 100


class LinearGaussianModel:
    """x' = F x + noise of covariance Q, y = x[0] + noise of variance r: solved exactly by a Kalman filter."""

    move = np.array([[1.0, 1.0], [0.0, 0.9]])
    drive = np.diag([0.05, 0.2])
    noise = 0.5

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        return states @ self.move.T + rng.multivariate_normal(np.zeros(2), self.drive, len(states))

    def log_likelihood(self, states: Floats, observation: float) -> Floats:
        return -0.5 * (states[:, 0] - observation) ** 2 / self.noise


def test_the_particle_filter_agrees_with_the_kalman_filter_on_a_linear_gaussian_model() -> None:
    model, rng = LinearGaussianModel(), np.random.default_rng(3)
    truth = np.zeros(2)
    mean, covariance = np.zeros(2), np.eye(2)
    particles = pf.Particles.uniform(rng.multivariate_normal(mean, covariance, 20_000))
    for k in range(25):
        truth = model.move @ truth + rng.multivariate_normal(np.zeros(2), model.drive)
        seen = float(truth[0] + rng.normal(0.0, np.sqrt(model.noise)))
        observation = None if 10 <= k < 14 else seen
        mean, covariance = model.move @ mean, model.move @ covariance @ model.move.T + model.drive
        if observation is not None:
            gain = covariance[:, 0] / (covariance[0, 0] + model.noise)
            mean, covariance = mean + gain * (seen - mean[0]), covariance - np.outer(gain, covariance[0])
        particles = pf.step(particles, model, observation, rng)
        spread = np.sqrt(np.diag(covariance))
        assert (np.abs(pf.weighted_mean(particles.states, particles.weights) - mean) < 0.08 * spread).all()
        np.testing.assert_allclose(
            np.sqrt(np.diag(pf.weighted_covariance(particles.states, particles.weights))), spread, rtol=0.08
        )


def test_the_number_of_particles_follows_the_spread() -> None:
    rng, number = np.random.default_rng(2), pf.KldSampleSize(cell=(0.5, np.inf), min_count=50, max_count=5000)
    particles = pf.Particles.uniform(rng.normal(0.0, 30.0, (5000, 2)))
    for _ in range(5):
        particles = pf.step(particles, LinearGaussianModel(), 0.0, rng, number=number, resample_below=1.0)
    assert 50 <= len(particles.states) < 1500


def test_the_circular_mean_crosses_the_angle_wrap() -> None:
    assert abs(pf.circular_mean(np.radians([170.0, -170.0]), np.array([0.5, 0.5]))) == pytest.approx(np.pi)


def test_the_densest_cluster_is_the_heavier_of_two_modes() -> None:
    rng = np.random.default_rng(4)
    points = np.concatenate([rng.normal([-200.0, 50.0], 4.0, (300, 2)), rng.normal([400.0, -30.0], 4.0, (700, 2))])
    weights = np.full(1000, 0.001)
    found = pf.densest_cluster(points, weights, 20.0)
    np.testing.assert_allclose(found.centre, [400.0, -30.0], atol=1.0)
    assert found.weight == pytest.approx(0.7, abs=0.01)
    both = pf.clusters(points, weights, 20.0)
    assert [round(part.weight, 1) for part in both] == [0.7, 0.3]
    np.testing.assert_allclose(both[1].centre, [-200.0, 50.0], atol=1.0)
    assert not (both[0].members & both[1].members).any()


def test_nothing_is_changed_in_place() -> None:
    states, rng = np.random.default_rng(0).normal(size=(50, 2)), np.random.default_rng(1)
    particles = pf.Particles.uniform(states.copy())
    pf.step(particles, LinearGaussianModel(), 1.0, rng, resample_below=1.0)
    np.testing.assert_array_equal(particles.states, states)
    np.testing.assert_allclose(particles.weights, 0.02)
