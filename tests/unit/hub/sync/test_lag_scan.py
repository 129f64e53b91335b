"""Lag scan: FFT moments are direct sums, costs are eigenvalues, and the true lag is among the candidates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import next_fast_len
from scipy.linalg import eigh

from hub.sync.lag_scan import GridTrack, LagScan, PairMoments, candidate_lags, fast_length, grid_tracks, scan_lags
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from protocols.geometry.types import Floats
from tests.support.rigs import Session, simulate

STEP, SIGMA_PX, LABELS = 0.05, 0.5, 2


def test_lengths_of_transforms_are_those_that_scipy_takes() -> None:
    lengths = [*range(1, 2000), 12_345, 999_983]
    assert [fast_length(length) for length in lengths] == [next_fast_len(length, real=True) for length in lengths]


def smooth(session: Session) -> list[SmoothTrack]:
    return [session.smoothed(name)["marker"] for name in session.rig.cameras]


def true_offset(session: Session, a: SmoothTrack, b: SmoothTrack) -> float:
    """t_a - t_b of one instant in the middle, on the tracks' shifted times."""
    true = session.true_time("cam1", session.middle("cam1"))
    shown = [session.shown(name, true) for name in ("cam0", "cam1")]
    return (shown[0] - a.time_origin) - (shown[1] - b.time_origin)


def random_grid(seed: int, count: int) -> GridTrack:
    rng = np.random.default_rng(seed)
    weight = rng.random((LABELS, count)) * (rng.random((LABELS, count)) > 0.2)
    return GridTrack(rng.normal(), STEP, rng.normal(size=(LABELS, count, 2)), weight, 1e-3, np.eye(3))


def direct_moments(a: GridTrack, b: GridTrack, lag: int) -> Floats:
    """Sum over samples n of w_a w_b (s_a ⊗ s_b)(s_a ⊗ s_b)ᵀ with b taken at n + lag."""
    out = np.zeros((9, 9))
    for k in range(LABELS):
        for n in range(a.weight.shape[1]):
            if 0 <= n + lag < b.weight.shape[1]:
                product = np.kron(np.r_[a.points[k, n], 1.0], np.r_[b.points[k, n + lag], 1.0])
                out += a.weight[k, n] * b.weight[k, n + lag] * np.outer(product, product)
    return out


@pytest.mark.parametrize(("n_a", "n_b"), [(40, 40), (25, 60), (60, 13)])
def test_the_fft_moments_are_direct_sums(n_a: int, n_b: int) -> None:
    a, b = random_grid(1, n_a), random_grid(2, n_b)
    moments = PairMoments(a, b)
    assert moments.lags[0] == -(n_a - 1)
    assert moments.lags[-1] == n_b - 1
    for which in (3, n_a // 2, n_a - 1, n_a + 3, n_a + n_b - 5):
        lag = int(moments.lags[which])
        direct = direct_moments(a, b, lag)
        matrix, _ = moments.matrices(np.array([which]))
        assert moments.support[which] == pytest.approx(direct[8, 8] * STEP, abs=1e-9)
        np.testing.assert_allclose(matrix[0] * direct[8, 8], direct, atol=1e-9)


def test_moments_do_not_depend_on_the_order_of_requests() -> None:
    a, b = random_grid(7, 40), random_grid(8, 30)
    whole, parts = PairMoments(a, b), PairMoments(a, b)
    every = np.arange(len(whole.lags))
    expected = whole.moment_sums(every)
    for which in (np.array([30, 4]), np.array([4, 5, 60, 30]), every[::-1], every):
        np.testing.assert_array_equal(parts.moment_sums(which), expected[:, :, which])


def test_the_offset_of_a_lag_is_the_time_difference_of_its_samples() -> None:
    a, b = random_grid(3, 30), random_grid(4, 30)
    moments = PairMoments(a, b)
    for which in (5, 29, 50):
        lag = int(moments.lags[which])
        n = max(0, -lag)
        time_a, time_b = a.begin + STEP * n, b.begin + STEP * (n + lag)
        assert moments.offset[which] == pytest.approx(time_a - time_b)


def test_the_normalisation_is_the_variance_of_the_epipolar_product() -> None:
    """Taubin: the variance of s_aᵀ F s_b under noise, to first order, by differences."""
    a, b = random_grid(5, 30), random_grid(6, 30)
    moments = PairMoments(a, b)
    which = 29  # lag 0
    _, norm = moments.matrices(np.array([which]))
    f = np.random.default_rng(0).normal(size=9)
    total, weights = 0.0, 0.0
    for k, n in np.ndindex(LABELS, 30):
        w = a.weight[k, n] * b.weight[k, n]
        sa, sb = np.r_[a.points[k, n], 1.0], np.r_[b.points[k, n], 1.0]
        matrix = f.reshape(3, 3)
        gradient_a, gradient_b = (matrix @ sb)[:2], (matrix.T @ sa)[:2]
        total += w * (a.sigma**2 * gradient_a @ gradient_a + b.sigma**2 * gradient_b @ gradient_b)
        weights += w
    assert f @ norm[0] @ f == pytest.approx(total / weights, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_costs_are_the_smallest_generalised_eigenvalues(seed: int) -> None:
    """Oracle: scipy's eigenvalues of the readable 9x9 matrices, the free constant term eliminated."""
    a, b = smooth(simulate(seed, 2, 20))
    moments = PairMoments(grid_tracks([a], STEP, SIGMA_PX), grid_tracks([b], STEP, SIGMA_PX))
    which = np.flatnonzero(moments.support > 1.0)[::5]
    expected = []
    for moment, norm in zip(*moments.matrices(which), strict=True):
        reduced = moment[:8, :8] - np.outer(moment[:8, 8], moment[8, :8]) / moment[8, 8]
        expected.append(eigh(reduced, norm[:8, :8], eigvals_only=True)[0])
    ratio = moments.min_costs(which) / np.array(expected)
    # Inverse iteration converges from above, and is exact where one eigenvalue is much the smallest.
    assert ratio.min() > 1.0 - 1e-6
    assert np.median(ratio) < 1.01
    assert ratio.max() < 2.0
    assert ratio[np.argmin(expected)] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_the_cost_is_at_the_noise_at_the_true_lag_and_higher_elsewhere(seed: int) -> None:
    session = simulate(seed, 2, 30)
    a, b = smooth(session)
    fine = STEP / 8  # motion in half a grid step is less than the noise
    scan = scan_lags(PairMoments(grid_tracks([a], fine, SIGMA_PX), grid_tracks([b], fine, SIGMA_PX)), 1.0)
    at = int(np.argmin(np.abs(scan.offset - true_offset(session, a, b))))
    cost = float(np.min(scan.cost[at - 1 : at + 2]))
    assert cost < 3.0
    median = float(np.median(scan.cost[scan.support > 0.5 * scan.support.max()]))
    assert cost < 0.03 * median


@pytest.mark.parametrize("seed", range(10, 18))
def test_the_true_lag_is_among_the_candidates(seed: int) -> None:
    session = simulate(seed, 2, 25, outliers=0.05 * (seed % 2), drops=0.1)
    a, b = smooth(session)
    scan = scan_lags(PairMoments(grid_tracks([a], STEP, SIGMA_PX), grid_tracks([b], STEP, SIGMA_PX)), 1.0)
    chosen = scan.offset[candidate_lags(scan, 3, 10)]
    assert len(chosen) <= 10
    assert np.min(np.abs(chosen - true_offset(session, a, b))) < STEP


@pytest.mark.parametrize("seed", range(3))
def test_a_short_overlap_of_long_tracks_is_still_a_candidate(seed: int) -> None:
    session = simulate(seed, 2, 60, windows=[(0, 35), (22, 60)], late=0)
    a, b = smooth(session)
    scan = scan_lags(PairMoments(grid_tracks([a], STEP, SIGMA_PX), grid_tracks([b], STEP, SIGMA_PX)), 1.0)
    chosen = scan.offset[candidate_lags(scan, 3, 10)]
    assert np.min(np.abs(chosen - true_offset(session, a, b))) < STEP


def test_the_best_matrix_at_the_true_lag_fits_the_tracks() -> None:
    session = simulate(1, 2, 30, noise=0.2)
    a, b = smooth(session)
    moments = PairMoments(grid_tracks([a], STEP, SIGMA_PX), grid_tracks([b], STEP, SIGMA_PX))
    offset = true_offset(session, a, b)
    at = int(np.argmin(np.abs(moments.offset - offset)))
    f = moments.fundamental(at)
    assert np.linalg.norm(f) == pytest.approx(1.0)
    here, there = a.at(a.time), b.at(a.time - moments.offset[at])
    both = np.isfinite(there).all(axis=1)
    sa, sb = np.column_stack([here, np.ones(len(here))])[both], np.column_stack([there, np.ones(len(here))])[both]
    lines = sa @ f
    distance = np.abs((lines * sb).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1) * b.focal
    assert np.median(distance) < 10  # grid of lags: up to half a step of motion


def test_a_still_track_has_no_support() -> None:
    time = np.arange(0, 20, 1 / 30)
    rng = np.random.default_rng(0)
    still = smooth_track(time, rng.normal(0, 5e-4, (600, 2)), 1000.0)
    (moving, _) = smooth(simulate(2, 2, 20))
    assert still is not None
    moments = PairMoments(grid_tracks([still], STEP, SIGMA_PX), grid_tracks([moving], STEP, SIGMA_PX))
    assert moments.support.max() < 3.0
    assert not np.isfinite(scan_lags(moments, 5.0).cost).any()


def test_candidates_come_from_every_octave_of_support() -> None:
    support = np.r_[np.full(50, 3.0), np.full(50, 30.0)]
    cost = np.full(100, 1000.0)
    cost[20], cost[70], cost[90] = 5.0, 10.0, 500.0
    chosen = candidate_lags(LagScan(np.arange(100.0), support, cost), 2, 10)
    assert {20, 70} <= set(chosen.tolist())
    assert chosen[0] == 70  # it has more support


def test_without_support_there_is_no_candidate() -> None:
    scan = LagScan(np.arange(5.0), np.zeros(5), np.full(5, np.inf))
    assert len(candidate_lags(scan, 3, 10)) == 0
