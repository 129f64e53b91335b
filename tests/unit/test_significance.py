"""How likely chance makes an alignment: never too unlikely where nothing corresponds, and very where all does."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hub.sync.lag_scan import GridTrack, PairMoments, grid_tracks, scan_lags
from hub.sync.null_distribution import COST_FLOOR, Chance, bandwidth, chance
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from tests.bench.pair_trials import FOCAL, MATRIX, Regime, Trial, make, stranger

STEP, SIGMA_PX = 0.033, 0.5


def smooth(trial: Trial) -> list[SmoothTrack]:
    found = [smooth_track(view.time, (view.pixels - MATRIX[:2, 2]) / FOCAL, FOCAL) for view in trial.views]
    assert all(track is not None for track in found)
    return [track for track in found if track is not None]


def grids(tracks: list[SmoothTrack]) -> list[GridTrack]:
    return [grid_tracks([track], STEP, SIGMA_PX) for track in tracks]


@pytest.mark.parametrize(
    "regime",
    [Regime(late=1), Regime(late=1, slowest=0.02, fastest=0.5), Regime(late=1, dropped=0.3, gaps=3)],
    ids=["usual", "slow", "with holes"],
)
def test_unrelated_tracks_are_not_unlikely(regime: Regime) -> None:
    """What is told to happen once in ten or a hundred cases happens no more often."""
    told = []
    for seed in range(6):
        tracks = smooth(stranger(make(regime, seed), regime, seed))
        moments = PairMoments(*grids(tracks))
        scan = scan_lags(moments, 1.0)
        width = min(bandwidth(track) for track in tracks)
        known: dict[int, Chance | None] = {}
        for index in np.flatnonzero((scan.support > 4) & np.isfinite(scan.cost))[::12]:
            seconds = float(scan.support[index])
            octave = round(6 * math.log(seconds))
            if octave not in known:
                known[octave] = chance(moments, scan, seconds, float(scan.offset[index]))
            found = known[octave]
            if found is not None:
                told.append(found.log10_probability(float(scan.cost[index]), 1.0, width * seconds))
    values = np.array(told)
    assert len(values) > 300
    assert (values < -1).mean() < 0.1
    assert (values < -2).mean() < 0.01
    assert values.min() > -3.5
    assert (values <= 0).all()
    assert np.median(values) < -0.01, "it tells nothing at all"


@pytest.mark.parametrize("seed", range(4))
def test_the_true_alignment_is_unlikely(seed: int) -> None:
    trial = make(Regime(late=1), seed)
    a, b = smooth(trial)
    moments = PairMoments(*grids([a, b]))
    scan = scan_lags(moments, 1.0)
    middle = np.array([np.mean(trial.overlap)])
    offset = float((trial.shown(0, middle) - a.epoch - trial.shown(1, middle) + b.epoch)[0])
    index = int(np.argmin(np.abs(scan.offset - offset)))
    seconds = float(scan.support[index])
    found = chance(moments, scan, seconds, offset)
    assert found is not None
    probability = found.log10_probability(1.0, 1.0, min(bandwidth(a), bandwidth(b)) * seconds)
    assert probability < -4
    usual = found.log10_probability(math.exp(found.log_median) - COST_FLOOR, 1.0, 1e9)
    assert usual == pytest.approx(math.log10(0.5), abs=1e-6)


def test_it_is_the_chance_of_a_chi_square() -> None:
    """Against draws: how often one of the same median is as small."""
    rng = np.random.default_rng(0)
    for freedom in (1.0, 3.0, 6.0):
        draws = rng.chisquare(freedom, 400_000)
        found = Chance(math.log(100.0), freedom, 100)
        for cost in (1.0, 10.0, 60.0, 200.0):
            value = (cost + COST_FLOOR) / 100.0 * float(np.median(draws))
            share = (draws < value).mean()
            assert 10 ** found.log10_probability(cost, 1.0, 1e9) == pytest.approx(share, rel=0.06, abs=1e-4)


def test_less_misfit_and_more_agreement_are_less_likely() -> None:
    found = Chance(math.log(50.0), 5.0, 100)
    by_cost = [found.log10_probability(cost, 1.0, 100.0) for cost in (0.01, 0.1, 1.0, 10.0, 50.0, 200.0)]
    assert by_cost == sorted(by_cost)
    by_share = [found.log10_probability(1.0, share, 100.0) for share in (1.0, 0.9, 0.5, 0.1, 0.0)]
    assert by_share == sorted(by_share)
    assert by_share[-1] == 0.0


def test_few_cycles_prove_nothing() -> None:
    """Seven parameters fit anything of seven independent values, however well."""
    found = Chance(math.log(50.0), 8.0, 100)
    assert found.log10_probability(0.1, 1.0, 1.6) == 0.0
    by_cycles = [found.log10_probability(0.1, 1.0, cycles) for cycles in (20.0, 3.0, 2.2, 1.8)]
    assert by_cycles == sorted(by_cycles)


def test_the_smallest_chances_go_on_smoothly() -> None:
    """Where the function underflows the series takes over: no step, no infinity."""
    medians = np.linspace(5.0, 25.0, 81)
    found = [Chance(float(x), 100.0, 100).log10_probability(1.0 - COST_FLOOR, 1.0, 1e9) for x in medians]
    assert found[0] > -200 > found[-1]
    np.testing.assert_allclose(np.diff(found), -0.25 * 50.0 / math.log(10.0), rtol=1e-2)


def test_recordings_that_are_too_short_tell_nothing() -> None:
    moments = PairMoments(*grids(smooth(make(Regime(span=4, late=0.2), 3))))
    assert chance(moments, scan_lags(moments, 1.0), 3.5, 0.0) is None


def test_a_given_geometry_is_hard_to_meet_by_chance() -> None:
    """With nothing to fit, unrelated stretches leave far more."""
    trial = make(Regime(late=1), 2)
    moments = PairMoments(*grids(smooth(trial)))
    essential = trial.pose.essential.T
    free = chance(moments, scan_lags(moments, 1.0), 6.0, 0.0)
    fixed = chance(moments, scan_lags(moments, 1.0, essential), 6.0, 0.0, essential)
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
    # The same speed at all frequencies up to 2 Hz.
    points = np.stack([(np.sin(2 * np.pi * np.outer(time, frequency) + p) / frequency).sum(axis=1) for p in phase], 1)
    flat = smooth_track(time, 1e-3 * points, FOCAL)
    assert flat is not None
    assert bandwidth(flat) == pytest.approx(2.0, rel=0.05)
    assert bandwidth(flat.scaled(2.0)) == pytest.approx(1.0, rel=0.05)
