"""The smoothness prior neither shrinks nor flattens the path; one std for three axes has the stated coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.adjustment import adjust
from hub.bundle.bordered_system import BAND, THIRD_DIFFERENCE
from hub.bundle.covariance import equivalent_std
from hub.bundle.noise.noise_scale import with_noise
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import AdjustmentState, CameraState, FreeParameters, Problem, Trajectory
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness, smoothness_terms
from protocols.geometry.types import Floats
from tests.support.bundles import observed, spline_of
from tests.support.rigs import random_lens, random_path, random_poses

SECONDS = 12.0


def two_cameras(seed: int, until: float = SECONDS, noise: float = 0.5) -> tuple[Problem, AdjustmentState]:
    """Two cameras, the second one's rows up to ``until``; the state is the truth."""
    rng = np.random.default_rng([seed, 77])
    lenses = [random_lens(rng) for _ in range(2)]
    middle = 0.5 * SECONDS
    poses = random_poses(rng, 2)
    cameras = tuple(CameraState(lens, pose, 1.0, middle, middle) for lens, pose in zip(lenses, poses, strict=True))
    path = spline_of(random_path(rng), -0.5, SECONDS + 0.5, 0.25)
    return observed(
        cameras,
        path,
        lambda i: np.sort(rng.uniform(0, until if i else SECONDS, 300)),
        lambda time: rng.normal(0, noise, (len(time), 2)),
        noise,
    )


def value(path: Trajectory, prior: SmoothnessPrior, control: Floats) -> float:
    return smoothness_terms(replace(path, control=control), prior.weights[0], prior.scatters[0])[2]


def test_the_gradient_is_half_the_finite_difference_of_the_cost() -> None:
    problem, state = two_cameras(1)
    path, prior = state.trajectories[0], estimate_smoothness(problem, state)
    rng = np.random.default_rng(2)
    along = rng.normal(size=path.control.shape)
    gradient = smoothness_terms(path, prior.weights[0], prior.scatters[0])[1]
    ahead, behind = (value(path, prior, path.control + sign * 1e-5 * along) for sign in (1, -1))
    assert gradient @ along.ravel() == pytest.approx((ahead - behind) / 4e-5, rel=1e-6)


def test_the_cost_is_invariant_under_the_paths_scale() -> None:
    problem, state = two_cameras(3)
    path, prior = state.trajectories[0], estimate_smoothness(problem, state)
    centre = path.control.mean(axis=0)
    at, larger = (value(path, prior, centre + factor * (path.control - centre)) for factor in (1.0, 1.0001))
    assert at > 10.0
    assert abs(larger - at) < 0.1 * 2e-4 * at
    size = prior.scatters[0]
    assert size is not None
    inner = size.seen & np.r_[False, size.seen[:-1]] & np.r_[size.seen[1:], False]
    held = SmoothnessPrior((np.where(inner, prior.weights[0], 0.0),), prior.scatters)
    gradient = smoothness_terms(path, held.weights[0], None)[1]
    assert gradient @ (path.control - centre).ravel() == pytest.approx(value(path, held, path.control), rel=1e-6)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_cost_is_invariant_under_affine_maps_of_the_path(seed: int) -> None:
    """Noise correlated over seconds constrains a rig weakly: a prior that favours flat paths bent it by metres."""
    problem, state = two_cameras(3)
    path, prior = state.trajectories[0], estimate_smoothness(problem, state)
    centre = path.control.mean(axis=0)
    size = prior.scatters[0]
    assert size is not None
    seen = SmoothnessPrior((np.where(size.seen, prior.weights[0], 0.0),), prior.scatters)
    picture = np.eye(3) + 0.3 * np.random.default_rng(seed).normal(size=(3, 3))
    at, other = (value(path, seen, centre + (path.control - centre) @ one) for one in (np.eye(3), picture))
    assert other == pytest.approx(at, rel=0.02)  # except for the floor of the scatter


@pytest.mark.parametrize("times", [-1e3, -10.0, -1.0, 1.0, 10.0, 1e3])
def test_no_change_of_the_path_gains_more_than_the_priors_cost(times: float) -> None:
    """Constant acceleration has no third differences: an unbounded prior won against rows that constrain a path's depth
    weakly (two cameras close together)."""
    problem, state = two_cameras(5)
    path, prior = state.trajectories[0], estimate_smoothness(problem, state)
    bent = np.linspace(-1.0, 1.0, len(path.control))[:, None] ** 2 * np.array([0.0, 0.0, 1.0])
    assert value(path, prior, path.control + times * bent) >= 0.0


def test_the_normalisation_has_no_gradient_where_only_one_camera_sees() -> None:
    problem, state = two_cameras(4, until=6.0)
    path, prior = state.trajectories[0], estimate_smoothness(problem, state)
    terms = (smoothness_terms(path, prior.weights[0], size)[1] for size in (None, prior.scatters[0]))
    pull = np.subtract(*terms).reshape(-1, 3)
    assert np.abs(pull[4:20]).max(axis=1).min() > 0.0
    assert not pull[-20:].any()


@pytest.mark.parametrize("end", [2, -3])
def test_an_end_that_no_row_holds_is_pulled_back(end: int) -> None:
    """As a part of the path's scatter it lowered its own cost, and its third difference was the path's strength: of
    walking people, ends flew by a metre, and clocks followed by 1000 ppm. end: a control point of one interval."""
    problem, state = two_cameras(6)
    path = state.trajectories[0]
    strength = estimate_smoothness(problem, state).weights[0][0]
    off = np.zeros_like(path.control)
    off[end, 0] = 1.0
    moved = replace(state, trajectories=(replace(path, control=path.control + 3.0 * off),))
    prior = estimate_smoothness(problem, moved)
    assert prior.weights[0][0] > 0.5 * strength
    at, near, far = (value(path, prior, path.control + metres * off) for metres in (0.0, 1.0, 3.0))
    assert far - at > 5.0 * (near - at)  # as its square, not less and less


def test_paths_seen_by_two_cameras_keep_their_size() -> None:
    """Mean of log(estimated size / true size): with a shrinking prior it is 4.4 stds of the mean below 0."""
    found = []
    for seed in range(16):
        problem, truth = two_cameras(100 + seed, noise=1.5)
        _, state, _ = adjust(problem, truth, rounds=2, iterations=8)
        at = np.linspace(0.5, SECONDS - 0.5, 60)
        scatters = [
            np.linalg.norm(s.trajectories[0].at(at) - s.trajectories[0].at(at).mean(axis=0)) for s in (state, truth)
        ]
        found.append(np.log(scatters[0] / scatters[1]))
    values = np.array(found)
    assert abs(values.mean()) < 2.0 * values.std() / np.sqrt(len(values))


def test_one_std_for_three_axes_covers_95_percent() -> None:
    rng = np.random.default_rng(5)
    axes = np.array([[1.0, 1.0, 1.0], [2.0, 0.5, 0.5], [3.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    stds_found = equivalent_std(axes)
    for stds, std in zip(axes, stds_found, strict=True):
        errors = rng.normal(size=(200_000, 3)) * stds
        assert np.mean(np.abs(errors) < 1.96 * std) == pytest.approx(0.95, abs=0.002)
    assert stds_found[0] == pytest.approx(1.0, rel=1e-4)
    assert equivalent_std(np.zeros((2, 3))).tolist() == [0.0, 0.0]
    assert equivalent_std(1e-9 * axes) == pytest.approx(1e-9 * stds_found, rel=1e-6)


def test_the_shares_that_observations_determine_are_those_of_a_dense_inverse() -> None:
    problem, state = two_cameras(1, until=6.0)
    prior = estimate_smoothness(problem, state)
    found = with_noise(problem, state, prior).trajectories[0].determined
    held_cameras = replace(problem, free_parameters=FreeParameters(pose=False, clock=False))
    band = build_system(held_cameras, state, prior, robust=False)[0].band
    size = band.shape[1]
    dense = np.zeros((size, size))
    for distance in range(BAND):
        column = np.arange(distance, size)
        dense[column - distance, column] = dense[column, column - distance] = band[BAND - 1 - distance, column]
    covariance = np.linalg.inv(dense)
    path, (weight, scatter) = state.trajectories[0], prior.of(0)
    assert scatter is not None
    control = path.control[scatter.control_mask] - path.control[scatter.control_mask].mean(axis=0)
    metric = scatter.scale * np.linalg.inv(control.T @ control / len(control) + scatter.floor * np.eye(3))
    left = []
    for start, one in zip(path.basis.interval_starts(), weight, strict=True):
        difference = np.zeros((3, size))
        for k, coefficient in enumerate(THIRD_DIFFERENCE):
            difference[range(3), range(3 * (start + k), 3 * (start + k) + 3)] = coefficient
        left.append(one * np.trace(metric @ difference @ covariance @ difference.T) / 3.0)
    assert found == pytest.approx(1.0 - np.array(left)[scatter.held].mean(), rel=1e-9)
    assert 0.0 < found < 1.0
    doubled = replace(state, trajectories=(replace(path, determined=0.5),))
    assert estimate_smoothness(problem, doubled).weights[0] == pytest.approx(0.5 * weight)
