"""Null distribution: false-alarm probabilities are calibrated for unrelated tracks and tiny for true alignments."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hub.sync.lag_scan import GridTrack, PairMoments, grid_tracks, scan_lags
from hub.sync.null_distribution import COST_FLOOR, NullDistribution, bandwidth, fit_null_distribution
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from tests.bench.pair_trials import FOCAL, Regime, make_trial, unrelated_trial

STEP, SIGMA_PX = 0.033, 0.5


def grids(tracks: list[SmoothTrack]) -> list[GridTrack]:
    return [grid_tracks([track], STEP, SIGMA_PX) for track in tracks]


@pytest.mark.parametrize(
    "regime",
    [Regime(late=1), Regime(late=1, slowest=0.02, fastest=0.5), Regime(late=1, dropped=0.3, gaps=3)],
    ids=["usual", "slow", "with gaps"],
)
def test_false_alarm_probabilities_of_unrelated_tracks_are_calibrated(regime: Regime) -> None:
    """Events of probability 0.1 or 0.01 are no more frequent than that."""
    values_found = []
    for seed in range(6):
        tracks = unrelated_trial(make_trial(regime, seed), regime, seed).smoothed()
        moments = PairMoments(*grids(tracks))
        scan = scan_lags(moments, 1.0)
        width = min(bandwidth(track) for track in tracks)
        by_octave: dict[int, NullDistribution | None] = {}
        for index in np.flatnonzero((scan.support > 4) & np.isfinite(scan.cost))[::12]:
            seconds = float(scan.support[index])
            octave = round(6 * math.log(seconds))
            if octave not in by_octave:
                by_octave[octave] = fit_null_distribution(moments, scan, seconds, float(scan.offset[index]))
            found = by_octave[octave]
            if found is not None:
                values_found.append(found.log10_false_alarm(float(scan.cost[index]), 1.0, width * seconds))
    values = np.array(values_found)
    assert len(values) > 300
    assert (values < -1).mean() < 0.1
    assert (values < -2).mean() < 0.01
    assert values.min() > -3.5
    assert (values <= 0).all()
    assert np.median(values) < -0.01, "the distribution is uninformative"


@pytest.mark.parametrize("seed", range(4))
def test_the_true_alignment_has_a_tiny_false_alarm_probability(seed: int) -> None:
    trial = make_trial(Regime(late=1), seed)
    a, b = trial.smoothed()
    moments = PairMoments(*grids([a, b]))
    scan = scan_lags(moments, 1.0)
    middle = np.array([np.mean(trial.overlap)])
    offset = float((trial.shown(0, middle) - a.time_origin - trial.shown(1, middle) + b.time_origin)[0])
    index = int(np.argmin(np.abs(scan.offset - offset)))
    seconds = float(scan.support[index])
    found = fit_null_distribution(moments, scan, seconds, offset)
    assert found is not None
    probability = found.log10_false_alarm(1.0, 1.0, min(bandwidth(a), bandwidth(b)) * seconds)
    assert probability < -4
    at_median = found.log10_false_alarm(math.exp(found.log_median) - COST_FLOOR, 1.0, 1e9)
    assert at_median == pytest.approx(math.log10(0.5), abs=1e-6)


def test_it_is_the_distribution_of_a_scaled_chi_square() -> None:
    """Against random draws with the same median."""
    rng = np.random.default_rng(0)
    for freedom in (1.0, 3.0, 6.0):
        draws = rng.chisquare(freedom, 400_000)
        found = NullDistribution(math.log(100.0), freedom)
        for cost in (1.0, 10.0, 60.0, 200.0):
            value = (cost + COST_FLOOR) / 100.0 * float(np.median(draws))
            share = (draws < value).mean()
            assert 10 ** found.log10_false_alarm(cost, 1.0, 1e9) == pytest.approx(share, rel=0.06, abs=1e-4)


def test_less_misfit_and_more_inliers_lower_the_probability() -> None:
    found = NullDistribution(math.log(50.0), 5.0)
    by_cost = [found.log10_false_alarm(cost, 1.0, 100.0) for cost in (0.01, 0.1, 1.0, 10.0, 50.0, 200.0)]
    assert by_cost == sorted(by_cost)
    by_share = [found.log10_false_alarm(1.0, share, 100.0) for share in (1.0, 0.9, 0.5, 0.1, 0.0)]
    assert by_share == sorted(by_share)
    assert by_share[-1] == 0.0


def test_few_cycles_are_no_evidence() -> None:
    """Seven parameters fit any seven independent values."""
    found = NullDistribution(math.log(50.0), 8.0)
    assert found.log10_false_alarm(0.1, 1.0, 1.6) == 0.0
    by_cycles = [found.log10_false_alarm(0.1, 1.0, cycles) for cycles in (20.0, 3.0, 2.2, 1.8)]
    assert by_cycles == sorted(by_cycles)


def test_the_smallest_probabilities_are_continuous() -> None:
    """The series takes over where the incomplete gamma function underflows: no step, no infinity."""
    medians = np.linspace(5.0, 25.0, 81)
    found = [NullDistribution(float(x), 100.0).log10_false_alarm(1.0 - COST_FLOOR, 1.0, 1e9) for x in medians]
    assert found[0] > -200 > found[-1]
    np.testing.assert_allclose(np.diff(found), -0.25 * 50.0 / math.log(10.0), rtol=1e-2)


def test_too_short_recordings_have_no_null_distribution() -> None:
    moments = PairMoments(*grids(make_trial(Regime(span=4, late=0.2), 3).smoothed()))
    assert fit_null_distribution(moments, scan_lags(moments, 1.0), 3.5, 0.0) is None


def test_a_known_geometry_fits_by_chance_more_rarely() -> None:
    """Without free parameters unrelated stretches have a far larger misfit."""
    trial = make_trial(Regime(late=1), 2)
    moments = PairMoments(*grids(trial.smoothed()))
    essential = trial.pose.essential.T
    free = fit_null_distribution(moments, scan_lags(moments, 1.0), 6.0, 0.0)
    fixed = fit_null_distribution(moments, scan_lags(moments, 1.0, essential), 6.0, 0.0, essential)
    assert free is not None
    assert fixed is not None
    assert fixed.log_median > free.log_median + 1.0


def test_bandwidth_is_that_of_the_motion() -> None:
    time = np.arange(0, 60, 1 / 50)
    one = smooth_track(time, 0.2 * np.column_stack([np.sin(2 * np.pi * 0.8 * time)] * 2), FOCAL)
    assert one is not None
    assert bandwidth(one) == pytest.approx(np.sqrt(3) * 0.8, rel=0.05)
    rng = np.random.default_rng(1)
    frequency = np.linspace(0.02, 2.0, 100)
    phase = rng.uniform(0, 2 * np.pi, (2, 100))
    # A flat speed spectrum up to 2 Hz.
    points = np.stack([(np.sin(2 * np.pi * np.outer(time, frequency) + p) / frequency).sum(axis=1) for p in phase], 1)
    flat = smooth_track(time, 1e-3 * points, FOCAL)
    assert flat is not None
    assert bandwidth(flat) == pytest.approx(2.0, rel=0.05)
    assert bandwidth(flat.scaled(2.0)) == pytest.approx(1.0, rel=0.05)
