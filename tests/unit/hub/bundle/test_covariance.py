"""Published stds against actual errors: Monte Carlo consistency of the covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from edge.scenes.common.base import look_at_pose
from hub.bundle import covariance as cov
from hub.bundle.adjustment import adjust
from hub.bundle.block_matrix import BlockSum, DenseCovariance
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, CameraState, Column, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.calibration.pipeline import calibrate
from protocols.geometry.types import Floats
from tests.support.bundles import observed, spline_of
from tests.support.rigs import random_lens, random_path, random_poses, simulate
from tests.unit.hub.bundle.test_adjustment import simulated_problem

RUNS, SECONDS = 40, 12.0


@dataclass(frozen=True)
class Errors:
    """(runs, n) normalised errors: errors divided by their published stds."""

    offset: Floats
    position: Floats
    path: Floats


@pytest.fixture(scope="module")
def errors() -> Errors:
    """Three cameras, each run with new noise and another rig, adjusted from near the truth.

    Gauge as published: the first camera and the first baseline fixed.
    """
    offset, position, path_errors = [], [], []
    for run in range(RUNS):
        rng = np.random.default_rng(1000 + run)
        lenses = [random_lens(rng) for _ in range(3)]
        cameras = tuple(
            CameraState(lens, pose, 1.0, rng.normal(0, 0.2) + SECONDS / 2, SECONDS / 2)
            for lens, pose in zip(lenses, random_poses(rng, 3), strict=True)
        )
        path = spline_of(random_path(rng), -1.0, SECONDS + 1, 0.25)
        problem, truth = observed(
            cameras,
            path,
            lambda _, rng=rng: np.sort(rng.uniform(0, SECONDS, 300)),
            lambda time, rng=rng: rng.normal(0, 0.5, (len(time), 2)),
        )
        problem, state, prior = adjust(problem, truth, rounds=2, iterations=8)
        found = cov.covariance(problem, state, prior)
        for i in (1, 2):
            std = cov.time_map_std(found, state, i, 0)
            offset.append((state.cameras[i].offset - cameras[i].offset) / std)
        std3 = cov.position_std(found, 2)
        position.append((state.cameras[2].pose.position - cameras[2].pose.position) / std3)
        at = np.array([3.1, 6.0, 8.7])
        std1 = cov.path_std(found, state, 0, at)
        path_errors.append(((state.trajectories[0].at(at) - path.at(at)) / std1[:, None]).ravel())
    return Errors(np.array(offset), np.array(position).ravel(), np.array(path_errors).ravel())


@pytest.mark.parametrize("what", ["offset", "position", "path"])
def test_normalised_errors_have_unit_variance(errors: Errors, what: str) -> None:
    z = getattr(errors, what)
    assert np.isfinite(z).all()
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4
    assert np.mean(np.abs(z) > 4) < 0.02


@pytest.mark.parametrize("what", ["offset", "position"])
def test_errors_are_unbiased(errors: Errors, what: str) -> None:
    z = getattr(errors, what)
    assert abs(z.mean()) < 4 / np.sqrt(len(z) / 2)


@pytest.fixture(scope="module")
def solved() -> tuple[Problem, AdjustmentState, SmoothnessPrior]:
    rng = np.random.default_rng(7)
    lenses = [random_lens(rng) for _ in range(3)]
    cameras = tuple(
        CameraState(lens, pose, 1.0, 3.0, 3.0) for lens, pose in zip(lenses, random_poses(rng, 3), strict=True)
    )
    path = spline_of(random_path(rng), 0.0, 6.0, 0.3)
    times, errors = lambda _: np.sort(rng.uniform(0, 6, 150)), lambda time: rng.normal(0, 0.5, (len(time), 2))
    return adjust(*observed(cameras, path, times, errors))


def test_parameters_fixed_by_the_gauge_have_no_variance(
    solved: tuple[Problem, AdjustmentState, SmoothnessPrior],
) -> None:
    found = cov.covariance(*solved)
    np.testing.assert_allclose(found.variances[0, :6], 0, atol=1e-12)
    assert cov.time_map_std(found, solved[1], 0, 0) == 0.0
    apart = solved[1].cameras[1].pose.position - solved[1].cameras[0].pose.position
    apart /= np.linalg.norm(apart)
    block = found.of(CAMERA_PARAMETERS + np.arange(3, 6))
    assert apart @ block @ apart < 1e-12


def test_twice_the_noise_is_twice_the_std(solved: tuple[Problem, AdjustmentState, SmoothnessPrior]) -> None:
    problem, state, prior = solved
    quarter = SmoothnessPrior(tuple(0.25 * w for w in prior.weights))
    loose = replace(
        problem, free_parameters=replace(problem.free_parameters, rate_std=2 * problem.free_parameters.rate_std)
    )
    one = cov.covariance(problem, state, prior)
    two = cov.covariance(loose, replace(state, sigma=2 * state.sigma), quarter)
    np.testing.assert_allclose(cov.position_std(two, 2), 2 * cov.position_std(one, 2), rtol=1e-3)
    assert cov.time_map_std(two, state, 1, 0) == pytest.approx(2 * cov.time_map_std(one, state, 1, 0), rel=1e-3)


def test_the_std_between_two_cameras_is_the_same_both_ways(
    solved: tuple[Problem, AdjustmentState, SmoothnessPrior],
) -> None:
    found = cov.covariance(*solved)
    there, back = (cov.time_map_std(found, solved[1], *pair) for pair in ((1, 2), (2, 1)))
    assert there == pytest.approx(back, rel=0.05)


def test_control_points_of_every_camera_bound_every_std(
    solved: tuple[Problem, AdjustmentState, SmoothnessPrior],
) -> None:
    problem, state, prior = solved
    known = np.zeros((3, CAMERA_PARAMETERS))
    known[:, 3:6] = 1.0 / 0.01**2
    found = cov.covariance(problem, state, prior, BlockSum(known.ravel()))
    stds = np.array([cov.position_std(found, i) for i in range(3)])
    assert (stds <= 0.0101).all()
    assert (stds > 1e-4).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_stds_of_a_whole_calibration_are_plausible(seed: int) -> None:
    session = simulate(700 + seed, 3, 20)
    found = calibrate(session.rig, session.observations())
    for name, camera in list(found.cameras.items())[1:]:
        error = abs(session.clock_error(name, found.reference, camera.time_map))
        assert 2e-5 < camera.time_offset_std < 1e-3
        assert error < 4.5 * camera.time_offset_std


def test_the_path_is_less_certain_at_its_ends(solved: tuple[Problem, AdjustmentState, SmoothnessPrior]) -> None:
    problem, state, prior = solved
    found = cov.covariance(problem, state, prior)
    stds = cov.path_std(found, state, 0, np.array([0.02, 3.0, 5.98]))
    assert stds[1] < stds[0]
    assert stds[1] < stds[2]


def test_relative_clock_stds_are_those_in_the_middle_of_the_common_span(
    solved: tuple[Problem, AdjustmentState, SmoothnessPrior],
) -> None:
    """Spans 0 to 10 s and 8 to 30 s: at 9 s, although uncertain rates increase the std elsewhere. By hand."""
    problem, state, _ = solved
    spans = ((0.0, 10.0), (8.0, 30.0), (40.0, 50.0))
    cameras = tuple(
        replace(camera, rate=1.0, offset=sum(span) / 2, centre=0.0)
        for camera, span in zip(state.cameras, spans, strict=True)
    )
    rows = tuple(
        replace(part, time=np.linspace(span[0], span[1], 150) - sum(span) / 2)
        for part, span in zip(problem.rows, spans, strict=True)
    )
    variance = np.zeros(3 * CAMERA_PARAMETERS)
    variance[Column.OFFSET :: CAMERA_PARAMETERS] = [0.0, 1e-6, 4e-6]
    variance[Column.RATE :: CAMERA_PARAMETERS] = [1e-8, 4e-8, 0.0]
    found = cov.CameraCovariance(np.arange(len(variance)), 3, DenseCovariance(np.diag(variance)))
    stds = cov.relative_clock_stds(found, replace(problem, rows=rows), replace(state, cameras=cameras))
    assert stds[0, 1] == pytest.approx(np.sqrt(1e-6 + 4.0**2 * 1e-8 + 10.0**2 * 4e-8))
    assert stds[0, 2] == pytest.approx(np.sqrt(4e-6 + 20.0**2 * 1e-8))  # no common span: middle of the gap
    np.testing.assert_array_equal(stds, stds.T)
    assert not np.diag(stds).any()


def test_the_smoothness_of_a_path_does_not_hold_its_depth() -> None:
    """A pair with a baseline of 4 % of the distance: what little the rows tell of the depth is all there is."""
    rng = np.random.default_rng(3)
    lenses = [random_lens(rng) for _ in range(2)]
    places = (np.array([5.0, 0.0, 0.0]), np.array([5.0, 0.2, 0.0]))
    cameras = tuple(
        CameraState(lens, look_at_pose(place, np.zeros(3)), 1.0, 10.0, 10.0)
        for lens, place in zip(lenses, places, strict=True)
    )
    path = spline_of(random_path(rng), 0.0, 20.0, 0.3)
    problem, state = observed(cameras, path, lambda _: np.arange(0, 20, 0.035), lambda time: np.zeros((len(time), 2)))
    prior = estimate_smoothness(problem, state)
    with_prior, without = (
        cov.relative_rotation_stds(cov.covariance(problem, state, one), state)[1, 0]
        for one in (prior, replace(prior, weights=tuple(1e-4 * weight for weight in prior.weights)))
    )
    assert with_prior > 0.6 * without


def test_of_a_large_network_stds_are_among_cameras_that_share_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    """All against all takes the whole covariance, of a thousand cameras a tenth of a gigabyte and seconds."""
    problem, state, prior = simulated_problem(4, lens=False)
    found = cov.covariance(problem, state, prior)
    every = cov.smallest_relative_stds(found, problem, state)
    monkeypatch.setattr(cov, "LARGE_NETWORK", 2)
    np.testing.assert_allclose(cov.smallest_relative_stds(found, problem, state), every)
    apart = replace(problem, rows=tuple(part for part in problem.rows if part.camera != 0 or part.label))
    apart = replace(apart, rows=tuple(part for part in apart.rows if part.camera != 2 or not part.label))
    rotations, _ = cov.smallest_relative_stds(found, apart, state)
    between = cov.relative_rotation_stds(found, state)
    np.testing.assert_allclose(rotations, [between[0, 1], min(between[0, 1], between[1, 2]), between[1, 2]])
