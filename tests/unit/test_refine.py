"""Refinement of geometry, lag and rate: where a plain least-squares solver ends, and as sure as it says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from hub.two_view import relative_pose as two_view
from hub.two_view.refinement import NARROW, WIDE, Noise, PointPairs, Refined, refine
from hub.two_view.relative_pose import Geometry, RelativePose, Uncalibrated, relative_pose
from protocols.geometry import so3
from protocols.geometry.types import Floats
from tests.rigs import looking_at, random_path

SIGMA = 5e-4
LAG, DRIFT = 0.35, 1.0 + 3e-4
"""The truth: t_b = DRIFT * (t_a - LAG)."""


class Pair:
    """Two views of one path: a's noisy points, and b's at any time with a noise that belongs to the row."""

    def __init__(self, seed: int, count: int = 300, outliers: float = 0.0, sigma: float = SIGMA) -> None:
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0.6, 2.4)
        self.poses = (
            looking_at(np.array([5.0, 0.0, 1.0]), rng.normal(0, 0.1, 3)),
            looking_at(np.array([5 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-0.5, 2)]), rng.normal(0, 0.1, 3)),
        )
        self.path = random_path(rng)
        self.pose = relative_pose(*self.poses)
        self.time = np.sort(rng.uniform(0, 20, count))
        self.lever = self.time - 10.0
        self.a = self.view(0, self.time) + rng.normal(0, sigma, (count, 2))
        wrong = rng.random(count) < outliers
        self.a[wrong] = rng.uniform(-0.3, 0.3, (int(wrong.sum()), 2))
        self.noise_b = rng.normal(0, sigma, (count, 2))

    def view(self, camera: int, true: Floats) -> Floats:
        local = self.poses[camera].camera_from_world(self.path.at(true))
        return np.asarray(local[:, :2] / local[:, 2:])

    def __call__(self, slowness: float, middle: float) -> PointPairs:
        true = (slowness * self.lever + middle) / DRIFT + LAG
        h = 1e-4
        speed = (self.view(1, true + h) - self.view(1, true - h)) / (2 * h * DRIFT)
        return PointPairs(self.a, self.view(1, true) + self.noise_b, speed, self.lever)

    @property
    def middle(self) -> float:
        return DRIFT * (10.0 - LAG)

    def geometry(self, calibrated: bool) -> Geometry:
        return self.pose if calibrated else Uncalibrated.of(self.pose.essential)


def disturbed(pair: Pair, geometry: Geometry, seed: int) -> tuple[Geometry, float]:
    """A start some degrees and tens of milliseconds off."""
    rng = np.random.default_rng(seed)
    count = 5 if isinstance(geometry, RelativePose) else 7
    step = rng.normal(0, 0.01, count)
    return geometry.moved(step), pair.middle + 0.03 * float(rng.choice([-1, 1]))


def robust(pair: Pair, noise: Noise, width: float) -> Callable[[Geometry, float, float], Floats]:
    """The residuals whose squares sum to what is minimised."""

    def residuals(geometry: Geometry, middle: float, slowness: float) -> Floats:
        points = pair(slowness, middle)
        distance = two_view.sampson(geometry.matrix, points.a, points.b, noise.sigma_a, noise.sigma_b)
        squeezed = width * np.sqrt(np.log1p((distance / width) ** 2)) * np.sign(distance)
        return np.asarray(np.r_[squeezed, (slowness - 1.0) / noise.rate_std])

    return residuals


both = pytest.mark.parametrize("calibrated", [True, False])
seeds = pytest.mark.parametrize("seed", range(3))


@both
@seeds
@pytest.mark.parametrize("width", [NARROW, WIDE])
def test_it_ends_where_a_plain_solver_ends(seed: int, calibrated: bool, width: float) -> None:
    pair, noise = Pair(seed, outliers=0.05), Noise(SIGMA, SIGMA, 2e-3)
    truth = pair.geometry(calibrated)
    start, middle = disturbed(pair, truth, seed)
    found = refine(pair, start, middle, 30.0, noise, narrowest=width)
    assert found is not None
    residuals = robust(pair, noise, width)
    free = 5 if calibrated else 7

    def of_step(x: Floats) -> Floats:
        return residuals(truth.moved(x[:free]), pair.middle + x[free], 1.0 + x[free + 1])

    oracle = least_squares(of_step, np.zeros(free + 2), x_scale=np.r_[np.full(free, 1e-3), 1e-3, 1e-4])
    assert found.cost * len(pair.time) == pytest.approx(2 * oracle.cost, rel=2e-3)
    jacobian = np.asarray(oracle.jac, dtype=np.float64)
    std = float(np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[free, free]))
    assert found.middle == pytest.approx(pair.middle + oracle.x[free], abs=0.2 * std)
    assert found.slowness == pytest.approx(1.0 + oracle.x[free + 1], abs=2e-5)
    points = pair(found.slowness, found.middle)
    mine, plain = (
        two_view.sampson(geometry.matrix, points.a, points.b, SIGMA, SIGMA)
        for geometry in (found.geometry, truth.moved(oracle.x[:free]))
    )
    apart = np.minimum(np.linalg.norm(mine - plain), np.linalg.norm(mine + plain)) / np.sqrt(len(mine))
    assert apart < 0.2  # of the noise


@both
def test_its_normal_matrix_tells_the_error(calibrated: bool) -> None:
    """Errors of lag and rate over their stds are standard normal, give or take."""
    over = []
    for seed in range(24):
        pair = Pair(100 + seed, count=200)
        found = refine(
            pair, pair.geometry(calibrated), pair.middle, 1.0, Noise(SIGMA, SIGMA, 1.0), slowness=DRIFT, narrowest=WIDE
        )
        assert found is not None
        std = np.sqrt(np.diag(np.linalg.pinv(found.normal, hermitian=True))[-2:])
        over.append([(found.middle - pair.middle) / std[0], (found.slowness - DRIFT) / std[1]])
    rms = np.sqrt(np.mean(np.square(over), axis=0))
    assert (rms > 0.65).all()
    assert (rms < 1.4).all()


@both
def test_without_noise_the_truth_is_found(calibrated: bool) -> None:
    pair = Pair(5, sigma=0.0)
    start, middle = disturbed(pair, pair.geometry(calibrated), 5)
    found = refine(pair, start, middle, 30.0, Noise(SIGMA, SIGMA, 10.0), iterations=60)
    assert found is not None
    assert found.middle == pytest.approx(pair.middle, abs=1e-5)
    assert found.slowness == pytest.approx(DRIFT, abs=2e-6)


@both
def test_outliers_hardly_pull(calibrated: bool) -> None:
    pair = Pair(6, outliers=0.3)
    start, middle = disturbed(pair, pair.geometry(calibrated), 6)
    found = refine(pair, start, middle, 30.0, Noise(SIGMA, SIGMA, 2e-3))
    assert found is not None
    assert found.middle == pytest.approx(pair.middle, abs=2e-3)


def test_a_geometry_that_is_given_stays() -> None:
    pair = Pair(7)
    found = refine(pair, pair.pose, pair.middle + 0.03, 20.0, Noise(SIGMA, SIGMA, 2e-3), fixed_geometry=True)
    assert found is not None
    assert found.geometry is pair.pose
    assert found.normal.shape == (2, 2)
    assert found.middle == pytest.approx(pair.middle, abs=5e-4)


def test_the_essential_matrix_stays_one() -> None:
    pair = Pair(8)
    start, middle = disturbed(pair, pair.pose, 8)
    found = refine(pair, start, middle, 30.0, Noise(SIGMA, SIGMA, 2e-3))
    assert found is not None
    assert isinstance(found.geometry, RelativePose)
    np.testing.assert_allclose(np.linalg.svd(found.geometry.matrix, compute_uv=False), [1, 1, 0], atol=1e-9)
    assert so3.angle_between(found.geometry.rotation, pair.pose.rotation) < np.deg2rad(1.0)


def test_the_prior_holds_the_rate_where_the_times_tell_nothing() -> None:
    """Within a millisecond there is no telling a rate: it stays what clocks have."""
    pair = Pair(9)
    pair.lever = 1e-3 * pair.lever
    found = refine(pair, pair.pose, pair.middle, 1.0, Noise(SIGMA, SIGMA, 1e-4), fixed_geometry=True)
    assert found is None or abs(found.slowness - 1.0) < 1e-3


def empty(slowness: float, middle: float) -> PointPairs:
    nothing = np.zeros((0, 2))
    return PointPairs(nothing, nothing, nothing, np.zeros(0))


def test_no_overlap_has_no_answer() -> None:
    found: Refined | None = refine(empty, Pair(0).pose, 0.0, 1.0, Noise(SIGMA, SIGMA, 2e-3))
    assert found is None


def test_a_rate_that_runs_away_is_no_answer() -> None:
    pair = Pair(10)
    assert refine(pair, pair.pose, pair.middle, 1.0, Noise(SIGMA, SIGMA, 10.0), slowness=2.5, iterations=0) is None
