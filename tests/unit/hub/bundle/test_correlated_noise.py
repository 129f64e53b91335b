"""Correlated noise: Gauss-Markov estimation, generalised least squares, and the choice of nominal lenses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hub.bundle import gls
from hub.bundle.adjustment import adjust, apply_step
from hub.bundle.block_matrix import DenseCovariance
from hub.bundle.covariance import CameraCovariance, covariance
from hub.bundle.gls import GlsSolution, SparseEntries, _cost, _noise_blocks, is_tractable, solve_gls
from hub.bundle.noise import correlated_noise
from hub.bundle.noise.correlated_noise import lens_tolerance, prefers_nominal_lenses, refit_with_correlated_noise
from hub.bundle.noise.gauss_markov import GaussMarkov, estimate_correlated_noise, fit_maximum_likelihood
from hub.bundle.noise.noise_scale import correlation_inflation, modelled_inflation, rescale_noise
from hub.bundle.problem import AdjustmentState, CameraState, Column, CorrelatedNoise, Problem
from hub.bundle.residuals import residual_norms
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from tests.support.bundles import observed, spline_of
from tests.support.rigs import random_lens, random_path, random_poses

SECONDS, RATE = 60.0, 15.0
WHITE, CORRELATED, TIME_CONSTANT = 0.4, 1.5, 2.0
CAMERAS = 4


def gls_cost(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, noise: CorrelatedNoise) -> float:
    """The cost that `solve_gls` minimises, with the optimal correlated errors at a state."""
    return _cost(problem, state, prior, _noise_blocks(problem, noise), None)


def gauss_markov_errors(rng: np.random.Generator, time: Floats, std: float, seconds: float) -> Floats:
    """Gauss-Markov errors (n, 2) of both axes at sorted times (n,)."""
    out = std * rng.normal(size=(len(time), 2))
    correlations = np.exp(-np.diff(time) / seconds)
    for i, share in enumerate(correlations, start=1):
        out[i] = share * out[i - 1] + np.sqrt(1.0 - share**2) * out[i]
    return out


def zoomed(lens: Intrinsics, factor: float) -> Intrinsics:
    matrix = lens.matrix.copy()
    matrix[:2, :2] *= factor
    return replace(lens, matrix=matrix)


def rig(seed: int, correlated_px: float = CORRELATED, focal_scale: float = 1.0) -> tuple[Problem, AdjustmentState]:
    """Four cameras and one path; the state is the truth. focal_scale: given focal lengths over the true ones."""
    rng = np.random.default_rng([seed, 4711])
    lenses, poses, middle = [random_lens(rng) for _ in range(CAMERAS)], random_poses(rng, CAMERAS), 0.5 * SECONDS
    cameras = tuple(CameraState(lens, pose, 1.0, middle, middle) for lens, pose in zip(lenses, poses, strict=True))
    path = spline_of(random_path(rng), -0.5, SECONDS + 0.5, 0.25)

    def errors(time: Floats) -> Floats:
        white = rng.normal(0.0, WHITE, (len(time), 2))
        return white + gauss_markov_errors(rng, time, correlated_px, TIME_CONSTANT)

    def times(_: int) -> Floats:
        return np.asarray((np.arange(int(RATE * SECONDS)) + rng.uniform()) / RATE, dtype=np.float64)

    problem, state = observed(cameras, path, times, errors, 1.0)
    return replace(problem, nominal=tuple(zoomed(lens, focal_scale) for lens in lenses)), state


def true_noise(correlated_px: float = CORRELATED) -> CorrelatedNoise:
    return CorrelatedNoise(np.full(CAMERAS, WHITE), np.full(CAMERAS, correlated_px), np.full(CAMERAS, TIME_CONSTANT))


def dense(time: Floats, white: float, std: float, seconds: float, relative: Floats | float = 1.0) -> Floats:
    return np.asarray(
        (white * relative) ** 2 * np.eye(len(time)) + std**2 * np.exp(-np.abs(time[:, None] - time[None]) / seconds),
    )


def test_the_precision_of_the_process_is_the_inverse_of_its_covariance() -> None:
    time = np.sort(np.random.default_rng(0).uniform(0.0, 9.0, 40))
    band = GaussMarkov.sampled_at(time, TIME_CONSTANT).precision()
    found = np.diag(band[1]) + np.diag(band[0, 1:], 1) + np.diag(band[0, 1:], -1)
    assert found @ dense(time, 0.0, 1.0, TIME_CONSTANT) == pytest.approx(np.eye(len(time)), abs=1e-8)


def test_sparse_entries_give_the_permuted_band_in_any_order() -> None:
    rng = np.random.default_rng(1)
    controls, knots, count = 9, 5, 40
    index, place = rng.integers(0, controls - 3, count), rng.integers(0, knots - 1, count)
    weights, knot_weights, values = rng.random((count, 4)), rng.random((count, 2)), rng.normal(size=(3, count))
    upper = np.stack([np.r_[0.0, rng.normal(size=knots - 1)], rng.normal(size=knots)])
    size = 3 * controls + knots
    entries = SparseEntries()
    entries.add_band(upper, 3 * controls)
    entries.add_cross_terms(index, weights, 3 * controls + place, knot_weights, values)
    expected = np.zeros((size, size))
    at = 3 * controls + np.arange(knots)
    expected[at, at], expected[at[:-1], at[1:]] = upper[1], upper[0, 1:]
    for n in range(count):
        for k, knot in np.ndindex(4, 2):
            for axis in range(3):
                value = weights[n, k] * knot_weights[n, knot] * values[axis, n]
                expected[3 * (index[n] + k) + axis, 3 * controls + place[n] + knot] += value
    expected += np.triu(expected, 1).T
    order = rng.permutation(size)
    band = entries.band(order)
    placed = np.zeros_like(expected)
    placed[np.ix_(order, order)] = expected
    for distance in range(size):
        found = band[len(band) - 1 - distance, distance:] if distance < len(band) else np.zeros(size - distance)
        assert found == pytest.approx(np.diag(placed, distance), abs=1e-12)


@pytest.mark.parametrize(("seed", "ratio"), [(1, 1.0), (2, 1.0), (3, 1.0), (4, 4.0)])
def test_the_estimated_noise_is_at_least_as_likely_as_the_true_one(seed: int, ratio: float) -> None:
    """ratio: of the white noise of every other row."""
    rng = np.random.default_rng(seed)
    time, relative = np.sort(rng.uniform(0.0, 60.0, 600)), np.where(np.arange(600) % 2, 1.0, ratio)
    off = rng.normal(0.0, WHITE, (600, 2)) * relative[:, None]
    off += gauss_markov_errors(rng, time, CORRELATED, TIME_CONSTANT)
    found = fit_maximum_likelihood([(time, off, relative**2)])
    logs = [
        multivariate_normal(np.zeros(600), dense(time, *three, relative)).logpdf(off.T).sum()
        for three in (found, (WHITE, CORRELATED, TIME_CONSTANT))
    ]
    assert logs[0] > logs[1] - 0.5  # the search ends slightly below the maximum
    assert found[0] == pytest.approx(WHITE, rel=0.1)
    assert found[1] == pytest.approx(CORRELATED, rel=0.35)
    assert found[2] == pytest.approx(TIME_CONSTANT, rel=0.7)


def test_the_cost_is_the_mahalanobis_distance_by_the_errors_covariance() -> None:
    """Squared residuals weighted by their dense covariance, up to the interpolation between knots."""
    problem, state = rig(1)
    plain = SmoothnessPrior((np.zeros(len(state.trajectories[0].basis.interval_starts())),), ())
    expected = 0.0
    for rows in problem.rows:
        camera = state.cameras[rows.camera]
        seen = camera.intrinsics.project(
            camera.pose.camera_from_world(state.trajectories[0].at(camera.reference_time(rows.time)))
        )
        off = seen - rows.pixels
        expected += float((off * np.linalg.solve(dense(rows.time, WHITE, CORRELATED, TIME_CONSTANT), off)).sum())
    assert gls_cost(problem, state, plain, true_noise()) == pytest.approx(expected, rel=0.1)
    assert expected == pytest.approx(2.0 * CAMERAS * RATE * SECONDS, rel=0.1)


def test_a_correlated_error_that_the_white_noise_hides_needs_few_knots(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state = rig(1)
    prior = estimate_smoothness(problem, state)
    hidden = CorrelatedNoise(np.full(CAMERAS, WHITE), np.full(CAMERAS, 0.1 * WHITE), np.full(CAMERAS, 0.1))
    few, cost = gls._noise_blocks(problem, hidden), gls_cost(problem, state, prior, hidden)
    monkeypatch.setattr(gls, "_MAX_BRIDGE_VARIANCE", 0.0)
    many = gls._noise_blocks(problem, hidden)
    assert 10 * sum(len(block.knots) for block in few) < sum(len(block.knots) for block in many)
    assert cost == pytest.approx(gls_cost(problem, state, prior, hidden), rel=0.03)


def test_every_step_from_the_optimum_increases_the_cost() -> None:
    problem, truth = rig(2)
    prior = estimate_smoothness(problem, truth)
    best = solve_gls(problem, truth, prior, true_noise())
    free, rng = len(problem.free_columns), np.random.default_rng(3)
    tangent = np.linalg.svd(best.free.submatrix(np.arange(free)))[0][:, : free - 7]
    for _ in range(5):
        path = 1e-4 * rng.normal(size=3 * truth.trajectories[0].basis.size)
        cameras = tangent @ (tangent.T @ (1e-5 * rng.normal(size=free)))
        up = [
            gls_cost(problem, apply_step(problem, best.state, s * path, s * cameras), prior, true_noise())
            for s in (1.0, -1.0)
        ]
        assert min(up) > best.cost
        assert abs(up[0] - up[1]) < 0.05 * (up[0] + up[1] - 2.0 * best.cost)


def clock_errors(state: AdjustmentState, truth: AdjustmentState) -> Floats:
    return 1e3 * np.array([a.offset - b.offset for a, b in zip(state.cameras[1:], truth.cameras[1:], strict=True)])


def test_clocks_are_more_accurate_than_with_independent_errors_and_stds_are_consistent() -> None:
    plain, better, scaled = [], [], []
    for seed in range(10, 18):
        problem, truth = rig(seed, correlated_px=6.0)
        _, state, _ = adjust(problem, truth, rounds=2, iterations=10)
        best = solve_gls(problem, state, estimate_smoothness(problem, state), estimate_correlated_noise(problem, state))
        plain.append(clock_errors(state, truth))
        better.append(clock_errors(best.state, truth))
        covariance = CameraCovariance(problem.free_columns, CAMERAS, best.free)
        scaled.append(better[-1] / (1e3 * np.sqrt(covariance.variances[1:, 6])))
    rms = [float(np.sqrt(np.mean(np.square(errors)))) for errors in (plain, better, scaled)]
    assert rms[1] < 0.95 * rms[0]
    assert 0.6 < rms[2] < 1.8  # paths absorb part of the errors, so the noise is underestimated


def test_independent_errors_leave_everything_as_it_is() -> None:
    problem, truth = rig(4, correlated_px=0.0)
    problem, state, _ = adjust(problem, truth, rounds=2, iterations=10)
    after = refit_with_correlated_noise(problem, state, refine_lenses=True)
    assert after[0] is problem
    assert after[1] is state


def test_a_slight_correlation_counts_where_lenses_were_not_measured() -> None:
    """Weak directions of such lenses follow errors that the path absorbs: as independent rows, they pull too much."""
    problem, truth = rig(13, correlated_px=0.2)
    problem, state, _ = adjust(problem, truth, rounds=2, iterations=10)
    slight = 2.0 * float(correlation_inflation(problem, state).max())
    assert refit_with_correlated_noise(problem, state, min_inflation=slight)[1] is state
    priors = tuple(replace(lens_tolerance(lens), focal_std=0.4, k1_std=0.15) for lens in problem.nominal)
    free, estimated, _ = adjust(replace(problem, lens_priors=priors), state, rounds=2, iterations=10)
    after = refit_with_correlated_noise(free, estimated, min_inflation=slight)[1]
    assert after.correlated_noise is not None

    def focal_std(one: AdjustmentState) -> float:
        scaled = rescale_noise(free, one, estimate_smoothness(free, one))
        found = covariance(free, scaled, estimate_smoothness(free, scaled))
        return float(np.sqrt(found.variances[:, Column.FOCAL]).mean())

    assert focal_std(after) > 1.2 * focal_std(estimated)


@pytest.mark.parametrize(("focal_scale", "free_lenses"), [(1.0, False), (1.02, True)])
def test_lenses_are_freed_only_where_the_given_ones_are_wrong(focal_scale: float, free_lenses: bool) -> None:
    problem, truth = rig(5, correlated_px=1.0, focal_scale=focal_scale)
    start = replace(
        truth,
        cameras=tuple(
            replace(camera, intrinsics=lens) for camera, lens in zip(truth.cameras, problem.nominal, strict=True)
        ),
    )
    problem, state, _ = adjust(problem, start, rounds=2, iterations=10)
    found, after = refit_with_correlated_noise(problem, state, refine_lenses=True)
    assert after.correlated_noise is not None
    assert bool(found.lens_tolerances) == free_lenses
    focal = [a.intrinsics.focal / b.intrinsics.focal for a, b in zip(after.cameras, truth.cameras, strict=True)]
    assert np.abs(np.log(focal)).max() < (0.01 if free_lenses else 1e-12)


def test_a_poorly_determined_rig_is_left_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = rig(6)
    problem, state, _ = adjust(problem, truth, rounds=2, iterations=10)
    assert refit_with_correlated_noise(problem, state)[1].correlated_noise is not None
    monkeypatch.setattr(correlated_noise, "_MAX_ROTATION_STD", 1e-6)
    assert refit_with_correlated_noise(problem, state)[1] is state


def test_the_bayes_factor_of_nominal_lenses_is_the_savage_dickey_ratio() -> None:
    """One focal length: nominal lenses win with a posterior as wide as the prior, and lose with a narrow one off it."""
    problem, state = rig(7)
    free_lenses = replace(problem, lens_tolerances=tuple(lens_tolerance(lens) for lens in problem.nominal))
    columns = free_lenses.free_columns
    tight = np.diag(np.full(len(columns), 1e-12))
    first = state.cameras[0]
    off = replace(state, cameras=(replace(first, intrinsics=zoomed(first.intrinsics, 1.005)), *state.cameras[1:]))
    place = int(np.flatnonzero(columns == Column.FOCAL)[0])
    vague = tight.copy()
    vague[place, place] = 0.01**2
    assert prefers_nominal_lenses(free_lenses, GlsSolution(state, 0.0, DenseCovariance(tight)))
    assert prefers_nominal_lenses(free_lenses, GlsSolution(off, 0.0, DenseCovariance(vague)))
    assert not prefers_nominal_lenses(free_lenses, GlsSolution(off, 0.0, DenseCovariance(tight)))


def test_gross_errors_do_not_enter_the_noise_model() -> None:
    """Rows not in use are excluded from the noise estimate."""
    problem, truth = rig(8, correlated_px=0.5)
    rng = np.random.default_rng(9)
    rows = []
    for one in problem.rows:
        wild = rng.random(len(one.time)) < 0.1
        pixels = np.where(wild[:, None], one.pixels + 200.0, one.pixels)
        rows.append(replace(one, pixels=pixels, use=~wild))
    found = estimate_correlated_noise(replace(problem, rows=tuple(rows)), truth)
    assert found.correlated_std == pytest.approx(np.full(CAMERAS, 0.5), rel=0.4)
    norms = residual_norms(rows[0], truth.cameras[0], truth.trajectories[0])
    assert norms.max() > 150.0


def test_stds_use_the_effective_sample_size() -> None:
    """The inflation is that of the variance of the rows' mean, and published stds use it."""
    problem, truth = rig(11)
    state = replace(truth, correlated_noise=true_noise())
    time = problem.rows[0].time
    of_mean = float(dense(time, WHITE, CORRELATED, TIME_CONSTANT).mean())
    inflation = of_mean * len(time) / (WHITE**2 + CORRELATED**2)
    assert modelled_inflation(problem, state, 0) == pytest.approx(inflation, rel=0.05)
    assert modelled_inflation(problem, truth, 0) == 1.0
    # Of rows of which the detector states different noise, that of their scores.
    stated = np.where(np.arange(len(time)) % 2, 3.0, 1.0 / 3.0)
    rows = (replace(problem.rows[0], relative_std=stated), *problem.rows[1:])
    weight, covariance = stated**-2, dense(time, WHITE, CORRELATED, TIME_CONSTANT, stated)
    inflation = float(weight @ covariance @ weight) / float(weight**2 @ np.diag(covariance))
    assert modelled_inflation(replace(problem, rows=rows), state, 0) == pytest.approx(inflation, rel=0.1)
    prior = estimate_smoothness(problem, truth)
    long = replace(state, correlated_noise=replace(true_noise(), time_constant=np.full(CAMERAS, 20.0)))
    assert (rescale_noise(problem, long, prior).sigma > 1.5 * rescale_noise(problem, truth, prior).sigma).all()


def test_the_noise_with_nominal_lenses_does_not_depend_on_the_initial_lenses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lenses that are off by 3 % after the plain adjustment leave residuals that are not correlated noise."""
    problem, truth = rig(12, correlated_px=1.0)
    freed = replace(problem, free_parameters=replace(problem.free_parameters, lens=True, focal_std=1.0))
    start = replace(
        truth,
        cameras=tuple(replace(one, intrinsics=zoomed(one.intrinsics, 1.03)) for one in truth.cameras),
    )
    freed, state, _ = adjust(freed, start, rounds=1, iterations=3)
    monkeypatch.setattr(correlated_noise, "prefers_nominal_lenses", lambda *_: True)
    found, after = refit_with_correlated_noise(freed, state, refine_lenses=True)
    assert not found.lens_tolerances
    plain, fitted, _ = adjust(problem, truth, rounds=1, iterations=10)
    expected = refit_with_correlated_noise(plain, fitted, refine_lenses=True)[1].correlated_noise
    assert after.correlated_noise is not None
    assert expected is not None
    assert after.correlated_noise.correlated_std == pytest.approx(expected.correlated_std, rel=0.15)


def test_a_recording_that_is_too_long_for_its_knots_is_not_tractable() -> None:
    problem, _ = rig(13)
    assert is_tractable(problem, true_noise())
    hours = tuple(replace(rows, time=240.0 * rows.time) for rows in problem.rows)
    assert not is_tractable(replace(problem, rows=hours), replace(true_noise(), time_constant=np.full(CAMERAS, 0.5)))


def test_duplicate_times_count_once() -> None:
    problem, truth = rig(14)
    state = replace(truth, correlated_noise=true_noise())
    twice = np.repeat(np.arange(len(problem.rows[0].time)), 2)
    rows = replace(
        problem.rows[0],
        time=problem.rows[0].time[twice],
        pixels=problem.rows[0].pixels[twice],
        use=np.ones(len(twice), bool),
    )
    doubled = replace(problem, rows=(rows, *problem.rows[1:]))
    assert modelled_inflation(doubled, state, 0) == pytest.approx(modelled_inflation(problem, state, 0), rel=1e-6)
