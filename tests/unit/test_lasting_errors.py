"""Errors that last for seconds: their noise, generalised least squares, and when lenses are taken as told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hub.bundle import correlated_noise
from hub.bundle.adjustment import adjust, moved, residual_norms
from hub.bundle.correlated_noise import as_told, tolerance, with_lasting_errors
from hub.bundle.gauss_markov import Markov, coloured, likeliest
from hub.bundle.gls import Entries, Fit, cost_at, fit, within_reach
from hub.bundle.noise_scale import honest, modelled
from hub.bundle.problem import CAMERA_PARAMETERS, FOCAL, CameraState, Coloured, Problem, Rows, State, Trajectory
from hub.trajectory.smoothness_prior import MotionPrior, motion_prior
from hub.trajectory.splines import SplineBasis, fit_spline
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from tests.rigs import random_lens, random_path, random_poses

SECONDS, RATE = 60.0, 15.0
WHITE, LASTING, SLOW = 0.4, 1.5, 2.0
CAMERAS = 4


def markov(rng: np.random.Generator, time: Floats, std: float, seconds: float) -> Floats:
    """(n, 2) errors of both axes at sorted times (n,)."""
    out = std * rng.normal(size=(len(time), 2))
    kept = np.exp(-np.diff(time) / seconds)
    for i, share in enumerate(kept, start=1):
        out[i] = share * out[i - 1] + np.sqrt(1.0 - share**2) * out[i]
    return out


def zoomed(lens: Intrinsics, factor: float) -> Intrinsics:
    matrix = lens.matrix.copy()
    matrix[:2, :2] *= factor
    return replace(lens, matrix=matrix)


def rig(seed: int, lasting_px: float = LASTING, told: float = 1.0) -> tuple[Problem, State]:
    """Four cameras and one path; the state is the truth. told: told focal lengths over the true ones."""
    rng = np.random.default_rng([seed, 4711])
    lenses, poses, middle = [random_lens(rng) for _ in range(CAMERAS)], random_poses(rng, CAMERAS), 0.5 * SECONDS
    cameras = tuple(CameraState(lens, pose, 1.0, middle, middle) for lens, pose in zip(lenses, poses, strict=True))
    basis = SplineBasis.over(np.array([-0.5]), np.array([SECONDS + 0.5]), 0.25)
    grid = np.arange(-0.5, SECONDS + 0.5, 0.02)
    path = Trajectory(basis, fit_spline(basis, grid, random_path(rng).at(grid), np.ones(len(grid))))
    rows = []
    for i, camera in enumerate(cameras):
        time: Floats = np.asarray((np.arange(int(RATE * SECONDS)) + rng.uniform()) / RATE, dtype=np.float64)
        seen = camera.intrinsics.project(camera.pose.camera_from_world(path.at(camera.reference_time(time))))
        seen = seen + rng.normal(0.0, WHITE, seen.shape) + markov(rng, time, lasting_px, SLOW)
        rows.append(Rows(i, 0, time, seen, np.ones(len(time), dtype=bool)))
    nominal = tuple(zoomed(lens, told) for lens in lenses)
    return Problem(tuple(rows), nominal, 0, (0, 1)), State(cameras, (path,), np.full(CAMERAS, 1.0))


def kinds(lasting_px: float = LASTING) -> Coloured:
    return Coloured(np.full(CAMERAS, WHITE), np.full(CAMERAS, lasting_px), np.full(CAMERAS, SLOW))


def dense(time: Floats, white: float, std: float, seconds: float) -> Floats:
    return np.asarray(
        white**2 * np.eye(len(time)) + std**2 * np.exp(-np.abs(time[:, None] - time[None]) / seconds),
    )


def test_the_precision_of_the_process_is_the_inverse_of_its_covariance() -> None:
    time = np.sort(np.random.default_rng(0).uniform(0.0, 9.0, 40))
    band = Markov.over(time, SLOW).precision()
    found = np.diag(band[1]) + np.diag(band[0, 1:], 1) + np.diag(band[0, 1:], -1)
    assert found @ dense(time, 0.0, 1.0, SLOW) == pytest.approx(np.eye(len(time)), abs=1e-8)


def test_what_rows_tie_together_comes_out_banded_in_any_order() -> None:
    rng = np.random.default_rng(1)
    controls, knots, count = 9, 5, 40
    index, place = rng.integers(0, controls - 3, count), rng.integers(0, knots - 1, count)
    weights, shares, values = rng.random((count, 4)), rng.random((count, 2)), rng.normal(size=(3, count))
    upper = np.stack([np.r_[0.0, rng.normal(size=knots - 1)], rng.normal(size=knots)])
    size = 3 * controls + knots
    entries = Entries()
    entries.add_band(upper, 3 * controls)
    entries.add_between(index, weights, 3 * controls + place, shares, values)
    expected = np.zeros((size, size))
    at = 3 * controls + np.arange(knots)
    expected[at, at], expected[at[:-1], at[1:]] = upper[1], upper[0, 1:]
    for n in range(count):
        for k, knot in np.ndindex(4, 2):
            for axis in range(3):
                value = weights[n, k] * shares[n, knot] * values[axis, n]
                expected[3 * (index[n] + k) + axis, 3 * controls + place[n] + knot] += value
    expected += np.triu(expected, 1).T
    order = rng.permutation(size)
    band = entries.band(order)
    placed = np.zeros_like(expected)
    placed[np.ix_(order, order)] = expected
    for distance in range(size):
        found = band[len(band) - 1 - distance, distance:] if distance < len(band) else np.zeros(size - distance)
        assert found == pytest.approx(np.diag(placed, distance), abs=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_noise_is_at_least_as_likely_as_the_true_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, 60.0, 600))
    off = rng.normal(0.0, WHITE, (600, 2)) + markov(rng, time, LASTING, SLOW)
    found = likeliest([(time, off)])
    logs = [
        multivariate_normal(np.zeros(600), dense(time, *three)).logpdf(off.T).sum()
        for three in (found, (WHITE, LASTING, SLOW))
    ]
    assert logs[0] > logs[1] - 0.5  # the search ends a little before the top
    assert found[0] == pytest.approx(WHITE, rel=0.1)
    assert found[1] == pytest.approx(LASTING, rel=0.35)
    assert found[2] == pytest.approx(SLOW, rel=0.7)


def test_the_cost_is_that_of_the_errors_own_covariance() -> None:
    """Squared residuals in the metric of their dense covariance, but for the knots between which errors stray."""
    problem, state = rig(1)
    plain = MotionPrior((np.zeros(len(state.trajectories[0].basis.interval_starts())),), ())
    expected = 0.0
    for rows in problem.rows:
        camera = state.cameras[rows.camera]
        seen = camera.intrinsics.project(
            camera.pose.camera_from_world(state.trajectories[0].at(camera.reference_time(rows.time)))
        )
        off = seen - rows.pixels
        expected += float((off * np.linalg.solve(dense(rows.time, WHITE, LASTING, SLOW), off)).sum())
    assert cost_at(problem, state, plain, kinds()) == pytest.approx(expected, rel=0.1)
    assert expected == pytest.approx(2.0 * CAMERAS * RATE * SECONDS, rel=0.1)


def test_from_its_optimum_every_way_leads_up() -> None:
    problem, truth = rig(2)
    prior = motion_prior(problem, truth)
    best = fit(problem, truth, prior, kinds())
    free, rng = len(problem.free_columns()), np.random.default_rng(3)
    tangent = np.linalg.svd(best.free)[0][:, : free - 7]
    for _ in range(5):
        path = 1e-4 * rng.normal(size=3 * truth.trajectories[0].basis.size)
        cameras = tangent @ (tangent.T @ (1e-5 * rng.normal(size=free)))
        up = [cost_at(problem, moved(problem, best.state, s * path, s * cameras), prior, kinds()) for s in (1.0, -1.0)]
        assert min(up) > best.cost
        assert abs(up[0] - up[1]) < 0.05 * (up[0] + up[1] - 2.0 * best.cost)


def clock_errors(state: State, truth: State) -> Floats:
    return 1e3 * np.array([a.offset - b.offset for a, b in zip(state.cameras[1:], truth.cameras[1:], strict=True)])


def test_clocks_are_better_than_with_errors_taken_as_separate_and_stds_cover_them() -> None:
    plain, better, scaled = [], [], []
    for seed in range(10, 18):
        problem, truth = rig(seed, lasting_px=6.0)
        _, state, _ = adjust(problem, truth, rounds=2, iterations=10)
        best = fit(problem, state, motion_prior(problem, state), coloured(problem, state))
        plain.append(clock_errors(state, truth))
        better.append(clock_errors(best.state, truth))
        covariance = best.covariance_of(problem)
        offsets = [CAMERA_PARAMETERS * k + 6 for k in range(1, CAMERAS)]
        scaled.append(better[-1] / (1e3 * np.sqrt(np.diag(covariance)[offsets])))
    rms = [float(np.sqrt(np.mean(np.square(errors)))) for errors in (plain, better, scaled)]
    assert rms[1] < 0.95 * rms[0]
    assert 0.6 < rms[2] < 1.8  # paths take up part of what errs, so that the noise is told too small


def test_independent_errors_leave_everything_as_it_is() -> None:
    problem, truth = rig(4, lasting_px=0.0)
    problem, state, _ = adjust(problem, truth, rounds=2, iterations=10)
    after = with_lasting_errors(problem, state)
    assert after[0] is problem
    assert after[1] is state


@pytest.mark.parametrize(("told", "loose"), [(1.0, False), (1.02, True)])
def test_lenses_are_loose_only_where_they_were_told_wrong(told: float, loose: bool) -> None:
    problem, truth = rig(5, lasting_px=1.0, told=told)
    start = replace(
        truth,
        cameras=tuple(
            replace(camera, intrinsics=lens) for camera, lens in zip(truth.cameras, problem.nominal, strict=True)
        ),
    )
    problem, state, _ = adjust(problem, start, rounds=2, iterations=10)
    found, after = with_lasting_errors(problem, state)
    assert after.coloured is not None
    assert bool(found.loose) == loose
    focal = [a.intrinsics.focal / b.intrinsics.focal for a, b in zip(after.cameras, truth.cameras, strict=True)]
    assert np.abs(np.log(focal)).max() < (0.01 if loose else 1e-12)


def test_a_rig_that_is_held_too_loosely_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = rig(6)
    problem, state, _ = adjust(problem, truth, rounds=2, iterations=10)
    assert with_lasting_errors(problem, state)[1].coloured is not None
    monkeypatch.setattr(correlated_noise, "_LARGEST_TURN_STD", 1e-6)
    assert with_lasting_errors(problem, state)[1] is state


def test_the_odds_of_told_lenses_are_those_of_savage_and_dickey() -> None:
    """One free focal length: known as well as before, told lenses are as likely; known well and off, hardly."""
    problem, state = rig(7)
    loose = replace(problem, loose=tuple(tolerance(lens) for lens in problem.nominal))
    columns = loose.free_columns()
    tight = np.diag(np.full(len(columns), 1e-12))
    first = state.cameras[0]
    off = replace(state, cameras=(replace(first, intrinsics=zoomed(first.intrinsics, 1.005)), *state.cameras[1:]))
    place = int(np.flatnonzero(columns == FOCAL)[0])
    vague = tight.copy()
    vague[place, place] = 0.01**2
    assert as_told(loose, Fit(state, 0.0, tight))
    assert as_told(loose, Fit(off, 0.0, vague))
    assert not as_told(loose, Fit(off, 0.0, tight))


def test_gross_errors_are_no_lasting_ones() -> None:
    """Rows that do not count do not tell the noise."""
    problem, truth = rig(8, lasting_px=0.5)
    rng = np.random.default_rng(9)
    rows = []
    for one in problem.rows:
        wild = rng.random(len(one.time)) < 0.1
        pixels = np.where(wild[:, None], one.pixels + 200.0, one.pixels)
        rows.append(replace(one, pixels=pixels, use=~wild))
    found = coloured(replace(problem, rows=tuple(rows)), truth)
    assert found.lasting == pytest.approx(np.full(CAMERAS, 0.5), rel=0.4)
    norms = residual_norms(rows[0], truth.cameras[0], truth.trajectories[0])
    assert norms.max() > 150.0


def test_stds_count_rows_that_are_alike_as_one() -> None:
    """As many as make the variance of the rows' mean what it is; and what is published goes by it."""
    problem, truth = rig(11)
    state = replace(truth, coloured=kinds())
    time = problem.rows[0].time
    of_mean = float(dense(time, WHITE, LASTING, SLOW).mean())
    alike = of_mean * len(time) / (WHITE**2 + LASTING**2)
    assert modelled(problem, state, 0) == pytest.approx(alike, rel=0.05)
    assert modelled(problem, truth, 0) == 1.0
    prior = motion_prior(problem, truth)
    long = replace(state, coloured=replace(kinds(), seconds=np.full(CAMERAS, 20.0)))
    assert (honest(problem, long, prior).sigma > 1.5 * honest(problem, truth, prior).sigma).all()


def test_told_lenses_have_their_own_noise_whatever_lenses_came_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lenses that the plain adjustment had freed by 3 % leave residuals that are no lasting errors."""
    problem, truth = rig(12, lasting_px=1.0)
    freed = replace(problem, freedom=replace(problem.freedom, lens=True, focal_std=1.0))
    start = replace(
        truth,
        cameras=tuple(replace(one, intrinsics=zoomed(one.intrinsics, 1.03)) for one in truth.cameras),
    )
    freed, state, _ = adjust(freed, start, rounds=1, iterations=3)
    monkeypatch.setattr(correlated_noise, "as_told", lambda *_: True)
    found, after = with_lasting_errors(freed, state)
    assert not found.loose
    plain, fitted, _ = adjust(problem, truth, rounds=1, iterations=10)
    expected = with_lasting_errors(plain, fitted)[1].coloured
    assert after.coloured is not None
    assert expected is not None
    assert after.coloured.lasting == pytest.approx(expected.lasting, rel=0.1)


def test_a_recording_that_is_too_long_for_its_knots_is_left_alone() -> None:
    problem, _ = rig(13)
    assert within_reach(problem, kinds())
    hours = tuple(replace(rows, time=240.0 * rows.time) for rows in problem.rows)
    assert not within_reach(replace(problem, rows=hours), replace(kinds(), seconds=np.full(CAMERAS, 0.5)))


def test_times_told_twice_are_one() -> None:
    problem, truth = rig(14)
    state = replace(truth, coloured=kinds())
    twice = np.repeat(np.arange(len(problem.rows[0].time)), 2)
    rows = replace(
        problem.rows[0],
        time=problem.rows[0].time[twice],
        pixels=problem.rows[0].pixels[twice],
        use=np.ones(len(twice), bool),
    )
    doubled = replace(problem, rows=(rows, *problem.rows[1:]))
    assert modelled(doubled, state, 0) == pytest.approx(modelled(problem, state, 0), rel=1e-6)
