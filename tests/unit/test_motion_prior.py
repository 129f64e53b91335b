"""The motion prior smooths the path and does not shrink it; one std for three axes covers what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.adjustment import adjust
from hub.bundle.covariance import one_std
from hub.bundle.problem import CameraState, Problem, Rows, State, Trajectory
from hub.trajectory.smoothness_prior import MotionPrior, motion_prior, motion_terms
from hub.trajectory.splines import SplineBasis, fit_spline
from protocols.geometry.types import Floats
from tests.rigs import random_lens, random_path, random_poses

SECONDS = 12.0


def two_cameras(seed: int, until: float = SECONDS, noise: float = 0.5) -> tuple[Problem, State]:
    """Two cameras, the second one's rows up to ``until``; the state is the truth."""
    rng = np.random.default_rng([seed, 77])
    lenses = [random_lens(rng) for _ in range(2)]
    middle = 0.5 * SECONDS
    poses = random_poses(rng, 2)
    cameras = tuple(CameraState(lens, pose, 1.0, middle, middle) for lens, pose in zip(lenses, poses, strict=True))
    basis = SplineBasis.over(np.array([-0.5]), np.array([SECONDS + 0.5]), 0.25)
    grid = np.arange(-0.5, SECONDS + 0.5, 0.02)
    path = Trajectory(basis, fit_spline(basis, grid, random_path(rng).at(grid), np.ones(len(grid))))
    rows = []
    for i, camera in enumerate(cameras):
        time = np.sort(rng.uniform(0, until if i else SECONDS, 300))
        seen = camera.intrinsics.project(camera.pose.camera_from_world(path.at(camera.reference_time(time))))
        rows.append(Rows(i, 0, time, seen + rng.normal(0, noise, seen.shape), np.ones(300, dtype=bool)))
    return Problem(tuple(rows), tuple(lenses), 0, (0, 1)), State(cameras, (path,), np.full(2, noise))


def value(path: Trajectory, prior: MotionPrior, control: Floats) -> float:
    return motion_terms(replace(path, control=control), prior.weights[0], prior.sizes[0])[2]


def test_its_gradient_is_half_the_difference_of_its_value() -> None:
    problem, state = two_cameras(1)
    path, prior = state.trajectories[0], motion_prior(problem, state)
    rng = np.random.default_rng(2)
    along = rng.normal(size=path.control.shape)
    gradient = motion_terms(path, prior.weights[0], prior.sizes[0])[1]
    ahead, behind = (value(path, prior, path.control + sign * 1e-5 * along) for sign in (1, -1))
    assert gradient @ along.ravel() == pytest.approx((ahead - behind) / 4e-5, rel=1e-6)


def test_it_does_not_care_for_the_paths_size() -> None:
    problem, state = two_cameras(3)
    path, prior = state.trajectories[0], motion_prior(problem, state)
    centre = path.control.mean(axis=0)
    at, larger = (value(path, prior, centre + factor * (path.control - centre)) for factor in (1.0, 1.0001))
    assert at > 10.0
    assert abs(larger - at) < 0.1 * 2e-4 * at  # beyond the rows' ends nothing is pulled
    plain = MotionPrior(prior.weights, ())
    gradient = motion_terms(path, plain.weights[0], None)[1]
    assert gradient @ (path.control - centre).ravel() == pytest.approx(at, rel=1e-6)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_does_not_care_whether_the_path_is_flatter_or_askew(seed: int) -> None:
    """Rows that err for seconds hold a rig loosely: a prior that prefers flat paths bent it by metres."""
    problem, state = two_cameras(3)
    path, prior = state.trajectories[0], motion_prior(problem, state)
    centre = path.control.mean(axis=0)
    size = prior.sizes[0]
    assert size is not None
    seen = MotionPrior((np.where(size.both, prior.weights[0], 0.0),), prior.sizes)
    picture = np.eye(3) + 0.3 * np.random.default_rng(seed).normal(size=(3, 3))
    at, other = (value(path, seen, centre + (path.control - centre) @ one) for one in (np.eye(3), picture))
    assert other == pytest.approx(at, rel=0.02)  # but for what keeps a flat path from having no size at all


@pytest.mark.parametrize("times", [-1e3, -10.0, -1.0, 1.0, 10.0, 1e3])
def test_no_path_gains_more_than_what_the_prior_cost(times: float) -> None:
    """An even acceleration has no third differences: with a pull that has no end, rows that hardly hold a path's depth
    (two cameras close together) lost to it."""
    problem, state = two_cameras(5)
    path, prior = state.trajectories[0], motion_prior(problem, state)
    bent = np.linspace(-1.0, 1.0, len(path.control))[:, None] ** 2 * np.array([0.0, 0.0, 1.0])
    assert value(path, prior, path.control + times * bent) >= 0.0


def test_nothing_pulls_where_only_one_camera_sees() -> None:
    problem, state = two_cameras(4, until=6.0)
    path, prior = state.trajectories[0], motion_prior(problem, state)
    terms = (motion_terms(path, prior.weights[0], size)[1] for size in (None, prior.sizes[0]))
    pull = np.subtract(*terms).reshape(-1, 3)
    assert np.abs(pull[4:20]).max(axis=1).min() > 0.0
    assert not pull[-20:].any()


def test_paths_before_two_cameras_come_out_as_large_as_they_are() -> None:
    """Mean of log(size found / true size): with a prior that shrinks it is 4.4 stds of the mean below 0."""
    found = []
    for seed in range(16):
        problem, truth = two_cameras(100 + seed, noise=1.5)
        _, state, _ = adjust(problem, truth, rounds=2, iterations=8)
        at = np.linspace(0.5, SECONDS - 0.5, 60)
        sizes = [
            np.linalg.norm(s.trajectories[0].at(at) - s.trajectories[0].at(at).mean(axis=0)) for s in (state, truth)
        ]
        found.append(np.log(sizes[0] / sizes[1]))
    values = np.array(found)
    assert abs(values.mean()) < 2.0 * values.std() / np.sqrt(len(values))


def test_one_std_of_three_covers_95_percent() -> None:
    rng = np.random.default_rng(5)
    axes = np.array([[1.0, 1.0, 1.0], [2.0, 0.5, 0.5], [3.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    told = one_std(axes)
    for stds, std in zip(axes, told, strict=True):
        errors = rng.normal(size=(200_000, 3)) * stds
        assert np.mean(np.abs(errors) < 1.96 * std) == pytest.approx(0.95, abs=0.002)
    assert told[0] == pytest.approx(1.0, rel=1e-4)
    assert one_std(np.zeros((2, 3))).tolist() == [0.0, 0.0]
    assert one_std(1e-9 * axes) == pytest.approx(1e-9 * told, rel=1e-6)
