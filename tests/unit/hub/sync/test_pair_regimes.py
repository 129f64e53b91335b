"""The pair solver over random rigs, a few trials per regime: related pairs are solved, unrelated ones refused.

`tests.bench.pair_timing` runs the same trials by the hundred and prints success rates.
"""

from __future__ import annotations

import numpy as np
import pytest

from hub.sync.hypothesis import PairSolution
from hub.sync.pair_solver import solve_pair
from hub.two_view.relative_pose import fundamental_from
from tests.bench.pair_trials import (
    MATRIX,
    Regime,
    Trial,
    geometry_error,
    lag_bound,
    make_trial,
    time_map_error,
    unrelated_trial,
)

USUAL = Regime()
SHORT = Regime(span=10, overlap=3)
OUTLIERS = Regime(outliers=0.4, dropped=0.3)
SECOND = Regime(span=12, late=2, second_object=0.2)
SLOW_CAMERAS = Regime(fps=(10.0, 10.0), slowest=0.5, fastest=3.0)
DRIFT = Regime(span=120, ppm=5000)
ASSUMED_30 = Regime(fps=(25.0, 30.0), assumed_fps=(30.0, 30.0))
ASSUMED_24 = Regime(fps=(30.0, 50.0), assumed_fps=(30.0, 24.0), span=12, late=2)

REGIMES = {
    "usual": (USUAL, (1, 2), True),
    "3 s of overlap in 10": (SHORT, (1, 2, 3), True),
    "40 % outliers, 30 % dropped": (OUTLIERS, (1, 2), True),
    "a second object": (SECOND, (2,), True),
    "10 fps, 3 Hz": (SLOW_CAMERAS, (1, 2, 3), True),
    "±5000 ppm over 120 s": (DRIFT, (1, 2), True),
    "50 fps timestamped as 24": (ASSUMED_24, (1,), True),
    "no intrinsics": (USUAL, (1, 2, 3), False),
    "no intrinsics, other rates, outliers": (Regime(fps=(30.0, 25.0), ppm=200, outliers=0.1), (1, 2), False),
    "no intrinsics, 25 fps timestamped as 30": (ASSUMED_30, (1,), False),
    "no intrinsics, a second object": (SECOND, (1,), False),
}


def solve(trial: Trial, regime: Regime, calibrated: bool = True) -> PairSolution:
    """The pair solution, with the expensive searches where the regime needs them."""
    a, b = trial.smoothed()
    thorough = regime.assumed_fps is not None or regime.second_object > 0 or regime.ppm > 1000
    return solve_pair({"": a}, {"": b}, ("a", "b"), calibrated=calibrated, thorough=thorough)


def errors(trial: Trial, found: PairSolution) -> tuple[float, float, float]:
    """Errors of the lag at mid-overlap [s], of the time map over the overlap [s], and of the epipolar lines [px]."""
    assert found.fit is not None
    epochs = [float(view.time[0]) for view in trial.views]
    lag, rms = time_map_error(trial, found.fit.rate, found.fit.offset + epochs[0] - found.fit.rate * epochs[1])
    return lag, rms, geometry_error(trial, fundamental_from(found.fit.geometry, MATRIX, MATRIX))


@pytest.mark.parametrize(("name", "seed"), [(name, seed) for name, (_, seeds, _) in REGIMES.items() for seed in seeds])
def test_a_pair_is_solved(name: str, seed: int) -> None:
    """Time map within 5 ms over the whole overlap and epipolar lines within 2 px of the true ones."""
    regime, _, calibrated = REGIMES[name]
    trial = make_trial(regime, seed)
    found = solve(trial, regime, calibrated)
    assert found.solved, found.status
    _, rms, pixels = errors(trial, found)
    assert rms < 5e-3
    assert pixels < 2.0


UNRELATED = {
    "usual": (USUAL, True),
    "no intrinsics": (USUAL, False),
    "slow": (Regime(late=2, slowest=0.02, fastest=0.4), True),
    "3 s of overlap in 10": (SHORT, True),
    "40 % outliers, 30 % dropped": (Regime(span=15, late=2, outliers=0.4, dropped=0.3), True),
    "a second object": (Regime(span=8, late=1, second_object=0.2), False),
    "10 fps, 3 Hz": (SLOW_CAMERAS, True),
    "wrong rates, 5000 ppm": (Regime(fps=(30.0, 50.0), assumed_fps=(30.0, 24.0), span=9, late=1, ppm=5000), True),
    "(a)": (Regime(paper_path=True, span=11, late=0.5), True),
}


@pytest.mark.parametrize(
    ("name", "seed"),
    # Without a null distribution the later ones would be accepted.
    [*((name, 1) for name in UNRELATED), ("usual", 11), ("usual", 20), ("usual", 25), ("slow", 6), ("slow", 7)],
)
def test_unrelated_pairs_are_refused(name: str, seed: int) -> None:
    regime, calibrated = UNRELATED[name]
    trial = unrelated_trial(make_trial(regime, seed), regime, seed)
    assert not solve(trial, regime, calibrated).solved


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_papers_trajectory_is_synchronised(seed: int) -> None:
    """(a) hardly determines the geometry, but the lag well enough: 3.1 ms RMS, so 3 times that at most."""
    regime = Regime(paper_path=True, span=11, late=0.5)
    trial = make_trial(regime, seed)
    found = solve(trial, regime)
    if found.solved:
        lag, rms, pixels = errors(trial, found)
        assert abs(lag) < 3 * 3.1e-3
        assert rms < 20e-3
        assert pixels < 10


def test_lag_errors_are_near_the_cramer_rao_bound() -> None:
    """RMS over ten clean rigs against the Cramér-Rao bound of points that are not smoothed."""
    lag_errors, bounds = [], []
    for seed in range(100, 110):
        trial = make_trial(USUAL, seed)
        found = solve(trial, USUAL)
        assert found.solved, found.status
        lag_errors.append(errors(trial, found)[0])
        bounds.append(lag_bound(trial, True))
    lag, least = np.sqrt(np.mean(np.square(lag_errors))), np.sqrt(np.mean(np.square(bounds)))
    assert lag < 1.6 * least  # 1.15 over a hundred: ten scatter by a quarter


def test_a_wrong_frame_rate_is_found_only_by_the_thorough_search() -> None:
    a, b = make_trial(ASSUMED_30, 1).smoothed()
    plain = solve_pair({"": a}, {"": b}, ("a", "b"))
    assert not plain.solved
    found = solve_pair({"": a}, {"": b}, ("a", "b"), thorough=True)
    assert found.fit is not None
    assert found.fit.rate == pytest.approx(25 / 30, rel=1e-4)


def test_a_wrong_frame_rate_of_the_first_camera_gives_the_inverse_rate() -> None:
    trial = make_trial(ASSUMED_30, 3)
    a, b = trial.smoothed()
    forward = solve_pair({"": a}, {"": b}, ("a", "b"), thorough=True)
    backward = solve_pair({"": b}, {"": a}, ("b", "a"), thorough=True)
    assert forward.fit is not None
    assert backward.fit is not None
    assert forward.fit.rate == pytest.approx(25 / 30, rel=1e-4)
    assert backward.fit.rate == pytest.approx(30 / 25, rel=1e-4)
    # t_a = r t_b + o  and  t_b = r' t_a + o'
    assert backward.fit.offset == pytest.approx(-forward.fit.offset / forward.fit.rate, abs=2e-3)
    rate = forward.fit.rate
    assert time_map_error(trial, rate, forward.fit.offset + a.time_origin - rate * b.time_origin)[1] < 5e-3


def test_the_lag_std_is_calibrated() -> None:
    """It is about the Cramér-Rao bound, and errors are about it."""
    over = []
    for seed in range(200, 212):
        trial = make_trial(USUAL, seed)
        a, b = trial.smoothed()
        found = solve_pair({"": a}, {"": b}, ("a", "b"))
        assert found.fit is not None
        assert 0.5 < found.fit.lag_std / lag_bound(trial, True) < 2.0
        rate = found.fit.rate
        error = time_map_error(trial, rate, found.fit.offset + a.time_origin - rate * b.time_origin)[0]
        over.append(error / found.fit.lag_std)
    assert 0.3 < np.sqrt(np.mean(np.square(over))) < 1.7


def test_without_intrinsics_there_is_no_pose() -> None:
    a, b = make_trial(USUAL, 4).smoothed()
    found = solve_pair({"": a}, {"": b}, ("a", "b"), calibrated=False)
    assert found.fit is not None
    with pytest.raises(ValueError, match="intrinsics"):
        _ = found.fit.pose
