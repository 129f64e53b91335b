"""Two-view refinement: it agrees with scipy's least squares, and its covariance with the errors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from edge.scenes.common.base import look_at_pose
from hub.two_view import relative_pose as two_view
from hub.two_view.refinement import FINAL_WIDTH, SEARCH_WIDTH, NoiseModel, PointPairs, RefinementResult, refine
from hub.two_view.relative_pose import FundamentalMatrix, RelativePose, TwoViewGeometry, relative_pose_between
from protocols.geometry import so3
from protocols.geometry.types import Floats
from tests.support.rigs import random_path

SIGMA = 5e-4
LAG, DRIFT = 0.35, 1.0 + 3e-4
"""The truth: t_b = DRIFT * (t_a - LAG)."""


class Pair:
    """Two views of one path: a's noisy points, and b's at any time, with one noise value per row."""

    def __init__(self, seed: int, count: int = 300, outliers: float = 0.0, sigma: float = SIGMA) -> None:
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0.6, 2.4)
        self.poses = (
            look_at_pose(np.array([5.0, 0.0, 1.0]), rng.normal(0, 0.1, 3)),
            look_at_pose(np.array([5 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-0.5, 2)]), rng.normal(0, 0.1, 3)),
        )
        self.path = random_path(rng)
        self.pose = relative_pose_between(*self.poses)
        self.time = np.sort(rng.uniform(0, 20, count))
        self.centred_time = self.time - 10.0
        self.a = self.view(0, self.time) + rng.normal(0, sigma, (count, 2))
        wrong = rng.random(count) < outliers
        self.a[wrong] = rng.uniform(-0.3, 0.3, (int(wrong.sum()), 2))
        self.noise_b = rng.normal(0, sigma, (count, 2))

    def view(self, camera: int, true: Floats) -> Floats:
        local = self.poses[camera].camera_from_world(self.path.at(true))
        return np.asarray(local[:, :2] / local[:, 2:])

    def __call__(self, inverse_rate: float, intercept: float) -> PointPairs:
        true = (inverse_rate * self.centred_time + intercept) / DRIFT + LAG
        h = 1e-4
        speed = (self.view(1, true + h) - self.view(1, true - h)) / (2 * h * DRIFT)
        return PointPairs(self.a, self.view(1, true) + self.noise_b, speed, self.centred_time)

    @property
    def intercept(self) -> float:
        return DRIFT * (10.0 - LAG)

    def geometry(self, calibrated: bool) -> TwoViewGeometry:
        return self.pose if calibrated else FundamentalMatrix.of(self.pose.essential)


def disturbed(pair: Pair, geometry: TwoViewGeometry, seed: int) -> tuple[TwoViewGeometry, float]:
    """An initial guess some degrees and tens of milliseconds off."""
    rng = np.random.default_rng(seed)
    count = 5 if isinstance(geometry, RelativePose) else 7
    step = rng.normal(0, 0.01, count)
    return geometry.retract(step), pair.intercept + 0.03 * float(rng.choice([-1, 1]))


def robust(pair: Pair, noise: NoiseModel, width: float) -> Callable[[TwoViewGeometry, float, float], Floats]:
    """Residuals whose sum of squares is the robust cost."""

    def residuals(geometry: TwoViewGeometry, intercept: float, inverse_rate: float) -> Floats:
        points = pair(inverse_rate, intercept)
        distance = two_view.sampson(geometry.matrix, points.a, points.b, noise.sigma_a, noise.sigma_b)
        robustified = width * np.sqrt(np.log1p((distance / width) ** 2)) * np.sign(distance)
        return np.asarray(np.r_[robustified, (inverse_rate - 1.0) / noise.rate_prior_std])

    return residuals


both = pytest.mark.parametrize("calibrated", [True, False])
seeds = pytest.mark.parametrize("seed", range(3))


@both
@seeds
@pytest.mark.parametrize("width", [SEARCH_WIDTH, FINAL_WIDTH])
def test_it_converges_to_the_least_squares_optimum(seed: int, calibrated: bool, width: float) -> None:
    pair, noise = Pair(seed, outliers=0.05), NoiseModel(SIGMA, SIGMA, 2e-3)
    truth = pair.geometry(calibrated)
    start, intercept = disturbed(pair, truth, seed)
    found = refine(pair, start, intercept, 30.0, noise, final_width=width)
    assert found is not None
    residuals = robust(pair, noise, width)
    free = 5 if calibrated else 7

    def of_step(x: Floats) -> Floats:
        return residuals(truth.retract(x[:free]), pair.intercept + x[free], 1.0 + x[free + 1])

    oracle = least_squares(of_step, np.zeros(free + 2), x_scale=np.r_[np.full(free, 1e-3), 1e-3, 1e-4])
    assert found.cost * len(pair.time) == pytest.approx(2 * oracle.cost, rel=2e-3)
    jacobian = np.asarray(oracle.jac, dtype=np.float64)
    std = float(np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[free, free]))
    assert found.intercept == pytest.approx(pair.intercept + oracle.x[free], abs=0.2 * std)
    assert found.inverse_rate == pytest.approx(1.0 + oracle.x[free + 1], abs=2e-5)
    points = pair(found.inverse_rate, found.intercept)
    residuals_here, residuals_oracle = (
        two_view.sampson(geometry.matrix, points.a, points.b, SIGMA, SIGMA)
        for geometry in (found.geometry, truth.retract(oracle.x[:free]))
    )
    difference = np.minimum(
        np.linalg.norm(residuals_here - residuals_oracle), np.linalg.norm(residuals_here + residuals_oracle)
    ) / np.sqrt(len(residuals_here))
    assert difference < 0.2  # of the noise std


@both
def test_its_covariance_is_calibrated(calibrated: bool) -> None:
    """Errors of lag and rate over their stds are about standard normal."""
    errors_over_std = []
    for seed in range(24):
        pair = Pair(100 + seed, count=200)
        found = refine(
            pair,
            pair.geometry(calibrated),
            pair.intercept,
            1.0,
            NoiseModel(SIGMA, SIGMA, 1.0),
            inverse_rate=DRIFT,
            final_width=FINAL_WIDTH,
        )
        assert found is not None
        std = np.sqrt(np.diag(np.linalg.pinv(found.normal, hermitian=True))[-2:])
        errors_over_std.append([(found.intercept - pair.intercept) / std[0], (found.inverse_rate - DRIFT) / std[1]])
    rms = np.sqrt(np.mean(np.square(errors_over_std), axis=0))
    assert (rms > 0.65).all()
    assert (rms < 1.4).all()


@both
def test_it_is_exact_without_noise(calibrated: bool) -> None:
    pair = Pair(5, sigma=0.0)
    start, intercept = disturbed(pair, pair.geometry(calibrated), 5)
    found = refine(pair, start, intercept, 30.0, NoiseModel(SIGMA, SIGMA, 10.0), iterations=60)
    assert found is not None
    assert found.intercept == pytest.approx(pair.intercept, abs=1e-5)
    assert found.inverse_rate == pytest.approx(DRIFT, abs=2e-6)


@both
def test_outliers_hardly_bias_the_lag(calibrated: bool) -> None:
    pair = Pair(6, outliers=0.3)
    start, intercept = disturbed(pair, pair.geometry(calibrated), 6)
    found = refine(pair, start, intercept, 30.0, NoiseModel(SIGMA, SIGMA, 2e-3))
    assert found is not None
    assert found.intercept == pytest.approx(pair.intercept, abs=2e-3)


def test_a_fixed_geometry_is_not_changed() -> None:
    pair = Pair(7)
    found = refine(pair, pair.pose, pair.intercept + 0.03, 20.0, NoiseModel(SIGMA, SIGMA, 2e-3), fixed_geometry=True)
    assert found is not None
    assert found.geometry is pair.pose
    assert found.normal.shape == (2, 2)
    assert found.intercept == pytest.approx(pair.intercept, abs=5e-4)


def test_an_essential_matrix_keeps_its_singular_values() -> None:
    pair = Pair(8)
    start, intercept = disturbed(pair, pair.pose, 8)
    found = refine(pair, start, intercept, 30.0, NoiseModel(SIGMA, SIGMA, 2e-3))
    assert found is not None
    assert isinstance(found.geometry, RelativePose)
    np.testing.assert_allclose(np.linalg.svd(found.geometry.matrix, compute_uv=False), [1, 1, 0], atol=1e-9)
    assert so3.angle_between(found.geometry.rotation, pair.pose.rotation) < np.deg2rad(1.0)


def test_an_unobservable_rate_follows_its_prior() -> None:
    """Over a few milliseconds the rate is not observable."""
    pair = Pair(9)
    pair.centred_time = 1e-3 * pair.centred_time
    found = refine(pair, pair.pose, pair.intercept, 1.0, NoiseModel(SIGMA, SIGMA, 1e-4), fixed_geometry=True)
    assert found is None or abs(found.inverse_rate - 1.0) < 1e-3


def empty(inverse_rate: float, intercept: float) -> PointPairs:
    nothing = np.zeros((0, 2))
    return PointPairs(nothing, nothing, nothing, np.zeros(0))


def test_without_overlap_there_is_no_result() -> None:
    found: RefinementResult | None = refine(empty, Pair(0).pose, 0.0, 1.0, NoiseModel(SIGMA, SIGMA, 2e-3))
    assert found is None


def test_a_diverging_rate_gives_no_result() -> None:
    pair = Pair(10)
    assert (
        refine(pair, pair.pose, pair.intercept, 1.0, NoiseModel(SIGMA, SIGMA, 10.0), inverse_rate=2.5, iterations=0)
        is None
    )
