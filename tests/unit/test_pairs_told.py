"""What solved pairs tell of the others: lags through a chain of cameras, and searches about them."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import hub.calibration.pair_network
from hub.calibration.pair_network import _ToldClocks, solve_pairs
from hub.calibration.preprocessing import Prepared, prepare
from hub.sync.pair_ranking import promise
from hub.sync.pair_solver import PairSolution, _Search, solve_pair
from hub.sync.track_cache import Kept
from hub.trajectory.image_tracks import smooth_only
from tests.rigs import Session, simulate


def prepared_of(session: Session) -> Prepared:
    return prepare(session.rig, session.observations())


def true_lag(session: Session, prepared: Prepared, a: str, b: str) -> float:
    """t_a - t_b [s], times less the epochs, at the middle of the whole recording."""
    middle = 15.0
    return (session.shown(a, middle) - prepared.epochs[a]) - (session.shown(b, middle) - prepared.epochs[b])


def test_a_chain_of_pairs_tells_the_lag_of_its_ends() -> None:
    session = simulate(3, 4, 30.0)
    prepared = prepared_of(session)
    told = _ToldClocks()
    assert told.lag(prepared, "cam0", "cam3") is None
    for a, b in (("cam2", "cam3"), ("cam0", "cam1"), ("cam1", "cam2")):
        tracks = [smooth_only(prepared.camera(name).tracks) for name in (a, b)]
        told.hear(solve_pair(tracks[0], tracks[1], (a, b)))
    for a, b in itertools.combinations(prepared.names, 2):
        lag = told.lag(prepared, a, b)
        assert lag is not None
        assert lag == pytest.approx(true_lag(session, prepared, a, b), abs=0.01)
        back = told.lag(prepared, b, a)
        assert back is not None
        assert back == pytest.approx(-lag, abs=1e-9)


def test_a_search_about_the_right_lag_finds_it_and_about_a_wrong_one_does_not() -> None:
    session = simulate(5, 2, 30.0)
    prepared = prepared_of(session)
    a, b = (smooth_only(prepared.camera(name).tracks) for name in ("cam0", "cam1"))
    lag = true_lag(session, prepared, "cam0", "cam1")
    there = solve_pair(a, b, ("cam0", "cam1"), near=lag + 0.1)
    assert there.solved
    assert there.fit is not None
    assert there.fit.lag == pytest.approx(lag, abs=0.005)
    assert not solve_pair(a, b, ("cam0", "cam1"), near=lag + 3.0).solved


def test_a_pair_that_saw_the_same_thing_promises_more() -> None:
    prepared = prepared_of(simulate(6, 3, 30.0, strangers=[2]))
    tracks = {name: smooth_only(prepared.camera(name).tracks) for name in prepared.names}
    assert promise(tracks["cam0"], tracks["cam1"]) > 1.5 * promise(tracks["cam0"], tracks["cam2"])


def test_many_cameras_are_answered_in_the_rigs_order() -> None:
    prepared = prepared_of(simulate(8, 10, 20.0))
    _, pairs = solve_pairs(prepared, lambda text, share: None)
    assert [(pair.a, pair.b) for pair in pairs] == list(itertools.combinations(prepared.names, 2))
    assert sum(pair.solved for pair in pairs) >= 9


def test_a_search_through_all_lags_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thorough search goes on from the refusal of the plain one, and says what it would say without it."""
    prepared = prepared_of(simulate(9, 2, 12.0, strangers=[1]))
    rates: list[float] = []
    at_rate, solve = _Search.at_rate, hub.calibration.pair_network._solve

    def counted(
        self: _Search, names: tuple[str, str], rate: float, near: tuple[float, float] | None = None
    ) -> PairSolution:
        rates.append(rate)
        return at_rate(self, names, rate, near)

    def anew(*given: Any, plain: PairSolution | None = None, **more: Any) -> PairSolution:
        return solve(*given, **more)

    monkeypatch.setattr(_Search, "at_rate", counted)
    _, (once,) = solve_pairs(prepared, lambda text, share: None, thorough=True)
    assert not once.solved
    assert len(rates) > 5
    assert rates.count(1.0) == 1
    monkeypatch.setattr(hub.calibration.pair_network, "_solve", anew)
    _, (again,) = solve_pairs(prepared, lambda text, share: None, thorough=True)
    assert rates.count(1.0) == 3
    assert again.status == once.status
    assert once.fit is not None
    assert again.fit is not None
    np.testing.assert_array_equal(again.fit.geometry.matrix, once.fit.geometry.matrix)
    assert (again.fit.offset, again.fit.rate) == (once.fit.offset, once.fit.rate)


def test_what_is_kept_is_of_that_very_track() -> None:
    prepared = prepared_of(simulate(3, 2, 20.0))
    (track,) = smooth_only(prepared.camera("cam0").tracks).values()
    kept = Kept()
    grid = kept.grid([track], 0.05, 0.5)
    assert kept.grid([track], 0.05, 0.5) is grid
    assert kept.grid([track], 0.05, 1.0).sigma == pytest.approx(2.0 * grid.sigma)
    assert kept.grid([track], 0.02, 0.5).step == 0.02
    slower = track.scaled(2.0)
    assert kept.bandwidth(slower) == pytest.approx(0.5 * kept.bandwidth(track))
    assert kept.fast_motion(slower) == pytest.approx(0.5 * kept.fast_motion(track))
    assert kept.grid([slower], 0.05, 0.5).points.shape[1] == pytest.approx(2 * grid.points.shape[1], abs=3)


def test_nothing_is_looked_for_near_a_lag_that_leaves_nothing_in_common(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = prepared_of(simulate(3, 2, 20.0))
    tracks = [smooth_only(prepared.camera(name).tracks) for name in ("cam0", "cam1")]
    monkeypatch.setattr("hub.sync.pair_solver.scan_lags", None)  # not to be called
    answer = solve_pair(tracks[0], tracks[1], ("cam0", "cam1"), near=100.0)
    assert not answer.solved
    assert "other lags were not looked at" in answer.status
