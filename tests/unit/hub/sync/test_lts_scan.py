"""LTS scan: moments are direct sums, geometries are eigenvectors, and the true lag has the most inlier time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.linalg import eigh

from hub.sync import lts_scan
from hub.sync.lag_scan import GridTrack, PairMoments, grid_tracks, to_grid_coordinates
from hub.sync.lts_scan import LtsScan, scan_lags_lts
from protocols.geometry.types import Floats
from tests.bench.pair_trials import Regime, Trial, make_trial, unrelated_trial

STEP, SIGMA_PX = 0.033, 0.5
TWO_OBJECTS = Regime(span=15, second_object=0.2, late=2)


def random_grid(seed: int, count: int, labels: int = 2) -> GridTrack:
    rng = np.random.default_rng(seed)
    weight = rng.random((labels, count)) * (rng.random((labels, count)) > 0.2)
    return GridTrack(rng.normal(), 0.05, rng.normal(size=(labels, count, 2)), weight, 1e-2 * (1 + seed), np.eye(3))


def of(trial: Trial) -> tuple[PairMoments, float]:
    """The moments of a trial and its true lag."""
    a, b = trial.smoothed()
    middle = np.array([np.mean(trial.overlap)])
    offset = float((trial.shown(0, middle) - a.time_origin - trial.shown(1, middle) + b.time_origin)[0])
    return PairMoments(*(grid_tracks([track], STEP, SIGMA_PX) for track in (a, b))), offset


@cache
def scanned(seed: int) -> tuple[PairMoments, float, LtsScan]:
    moments, offset = of(make_trial(TWO_OBJECTS, seed))
    return moments, offset, scan_lags_lts(moments, SIGMA_PX)


def test_bin_moments_are_direct_sums() -> None:
    a, b = random_grid(1, 40), random_grid(2, 33)
    width, bins = 8, 5
    lags = np.arange(-39, 33)
    cells = lts_scan._bin_moments(a, b, lags, width, bins).reshape(len(lags), bins, 6, 6)
    monomial = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    for row in (0, 20, 39, 41, 60, 71):
        for k in range(bins):
            expected = np.zeros((6, 6))
            for label, n in np.ndindex(2, width):
                i, j = k * width + n, k * width + n + int(lags[row])
                if not 0 <= j < 33:
                    continue
                here, there = np.r_[a.points[label, i], 1.0], np.r_[b.points[label, j], 1.0]
                of_a = [here[p] * here[q] for p, q in monomial]
                of_b = [there[p] * there[q] for p, q in monomial]
                expected += a.weight[label, i] * b.weight[label, j] * np.outer(of_a, of_b)
            np.testing.assert_allclose(cells[row, k], expected, atol=1e-12)


def test_the_bin_moments_of_a_lag_add_up_to_its_moments() -> None:
    a, b = random_grid(3, 40), random_grid(4, 40)
    moments = PairMoments(a, b)
    cells = lts_scan._bin_moments(a, b, moments.lags, 8, 5).sum(axis=1).reshape(-1, 6, 6)
    np.testing.assert_allclose(cells, np.moveaxis(moments.moment_sums(np.arange(len(moments.lags))), -1, 0), atol=1e-9)


def cells_of(seed: int) -> tuple[Floats, GridTrack, GridTrack]:
    """Moments (1, 1, 36) of points that nearly fit one geometry."""
    moments, offset = of(make_trial(Regime(late=2), seed))
    a, b = moments.a, moments.b
    index = int(np.argmin(np.abs(moments.offset - offset)))
    width = a.weight.shape[1] // 2
    return lts_scan._bin_moments(a, b, moments.lags[index : index + 1], width, 1), a, b


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_best_geometry_is_the_smallest_eigenvector(seed: int) -> None:
    cells, a, b = cells_of(seed)
    cells = cells[0] / cells[0, :, 35:]
    moment, norm = lts_scan._moment_matrices(cells, a, b)
    values, vectors = eigh(norm[0], moment[0])  # the largest of the inverse problem: the norm is singular
    found, expected = lts_scan._smallest_eigenvectors(cells, a, b)[0], vectors[:, -1] / np.linalg.norm(vectors[:, -1])
    assert abs(found @ expected) == pytest.approx(1.0, abs=1e-5)
    cost = float(lts_scan._bin_costs(cells[None], found[None], a, b)[0, 0])
    assert cost == pytest.approx(1.0 / values[-1], rel=1e-4)


def test_the_cost_of_a_bin_is_the_squared_distance_over_the_noise() -> None:
    cells, a, b = cells_of(0)
    theta = np.random.default_rng(0).normal(size=(1, 9))
    moment, norm = lts_scan._moment_matrices(cells[0] / cells[0, :, 35:], a, b)
    expected = (theta[0] @ moment[0] @ theta[0]) / (theta[0] @ norm[0] @ theta[0])
    found = lts_scan._bin_costs(cells / cells[:, :, 35:], theta, a, b)
    assert found[0, 0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_true_lag_has_the_most_inlier_time(seed: int) -> None:
    moments, offset, scan = scanned(seed)
    best = int(np.argmax(scan.inlier_seconds))
    assert abs(moments.offset[best] - offset) < 2 * STEP
    other = np.abs(moments.offset - offset) > 0.5
    assert scan.inlier_seconds[best] > 1.2 * scan.inlier_seconds[other].max()


@pytest.mark.parametrize("seed", [0, 1])
def test_the_estimated_geometry_is_that_of_the_marker(seed: int) -> None:
    """Compared in the grids' coordinates."""
    trial = make_trial(TWO_OBJECTS, seed)
    moments, offset, scan = scanned(seed)
    best = int(np.argmax(scan.inlier_seconds))
    theta = to_grid_coordinates(scan.matrix[best], moments.a, moments.b)
    truth = to_grid_coordinates(trial.pose.essential.T, moments.a, moments.b)
    which = np.array([int(np.argmin(np.abs(moments.offset - offset)))])
    assert abs(theta @ truth) / np.linalg.norm(theta) / np.linalg.norm(truth) > 0.9
    assert np.isfinite(moments.costs_given(which, scan.matrix[best]))[0]


def test_unrelated_tracks_have_less_inlier_time() -> None:
    moments, _ = of(unrelated_trial(make_trial(TWO_OBJECTS, 1), TWO_OBJECTS, 1))
    scan = scan_lags_lts(moments, SIGMA_PX)
    inlier_seconds = scan.inlier_seconds[scan.inlier_seconds > 0]
    _, _, true = scanned(1)
    assert inlier_seconds.max() < 0.75 * true.inlier_seconds.max()


def test_inlier_time_does_not_exceed_the_overlap() -> None:
    moments, _, scan = scanned(0)
    longest = np.minimum(moments.a.weight.shape[1], moments.b.weight.shape[1]) * STEP
    assert (scan.inlier_seconds <= longest).all()
    distance = np.abs(moments.offset - np.median(moments.offset))
    assert (scan.inlier_seconds[distance > distance.max() - 1.0] == 0).all(), (
        "a second of overlap is too short for a geometry"
    )
    assert np.isinf(scan.misfit[scan.inlier_seconds == 0]).all()


def test_the_scan_is_deterministic_in_its_seed() -> None:
    moments, _, scan = scanned(0)
    again = scan_lags_lts(moments, SIGMA_PX)
    np.testing.assert_array_equal(scan.inlier_seconds, again.inlier_seconds)
    np.testing.assert_array_equal(scan.matrix, again.matrix)


def test_short_tracks_have_no_inlier_time() -> None:
    moments = PairMoments(random_grid(1, 50), random_grid(2, 50))
    scan = scan_lags_lts(moments, SIGMA_PX)
    assert (scan.inlier_seconds == 0).all()
    assert np.isinf(scan.misfit).all()
