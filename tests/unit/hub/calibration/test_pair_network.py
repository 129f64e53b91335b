"""Pair network: lags predicted through chains of solved pairs, and searches near predicted lags."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import hub.calibration.pairs.pair_network
from hub.bundle.preprocessing import PreparedSession, prepare
from hub.calibration.pairs.pair_network import _leave_to_resection, solve_pairs
from hub.calibration.pairs.synchronised_groups import SynchronisedGroups
from hub.sync.hypothesis import PairSolution
from hub.sync.pair_solver import _PairSearch, solve_pair
from hub.sync.track_cache import TrackCache, ranking_score
from hub.trajectory.image_tracks import smooth_only
from tests.support.rigs import Session, simulate


def prepared_of(session: Session) -> PreparedSession:
    return prepare(session.rig, session.observations())


def true_lag(session: Session, prepared: PreparedSession, a: str, b: str) -> float:
    """t_a - t_b [s], times from the time origins, in the middle of the recording."""
    middle = 15.0
    return (session.shown(a, middle) - prepared.time_origins[a]) - (session.shown(b, middle) - prepared.time_origins[b])


def test_a_chain_of_pairs_predicts_the_lag_of_its_ends() -> None:
    session = simulate(3, 4, 30.0)
    prepared = prepared_of(session)
    groups = SynchronisedGroups()
    assert groups.lag(prepared, "cam0", "cam3") is None
    for a, b in (("cam2", "cam3"), ("cam0", "cam1"), ("cam1", "cam2")):
        tracks = [smooth_only(prepared.camera(name).tracks) for name in (a, b)]
        groups.add(solve_pair(tracks[0], tracks[1], (a, b)))
    for a, b in itertools.combinations(prepared.names, 2):
        lag = groups.lag(prepared, a, b)
        assert lag is not None
        assert lag == pytest.approx(true_lag(session, prepared, a, b), abs=0.01)
        back = groups.lag(prepared, b, a)
        assert back is not None
        assert back == pytest.approx(-lag, abs=1e-9)


def test_a_search_near_the_right_lag_finds_it_and_near_a_wrong_one_does_not() -> None:
    session = simulate(5, 2, 30.0)
    prepared = prepared_of(session)
    a, b = (smooth_only(prepared.camera(name).tracks) for name in ("cam0", "cam1"))
    lag = true_lag(session, prepared, "cam0", "cam1")
    there = solve_pair(a, b, ("cam0", "cam1"), predicted_lag=lag + 0.1)
    assert there.solved
    assert there.fit is not None
    assert there.fit.lag == pytest.approx(lag, abs=0.005)
    assert not solve_pair(a, b, ("cam0", "cam1"), predicted_lag=lag + 3.0).solved


def test_a_pair_that_saw_the_same_object_has_a_higher_ranking_score() -> None:
    prepared = prepared_of(simulate(6, 3, 30.0, unrelated=[2]))
    tracks = {name: smooth_only(prepared.camera(name).tracks) for name in prepared.names}
    assert ranking_score(tracks["cam0"], tracks["cam1"]) > 1.5 * ranking_score(tracks["cam0"], tracks["cam2"])


def test_pairs_of_many_cameras_are_returned_in_the_rigs_order() -> None:
    prepared = prepared_of(simulate(8, 10, 20.0))
    _, pairs = solve_pairs(prepared, lambda text, share: None)
    assert [(pair.a, pair.b) for pair in pairs] == list(itertools.combinations(prepared.names, 2))
    assert sum(pair.solved for pair in pairs) >= 9


def test_a_search_over_all_lags_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thorough search continues from the refusal of the first one, with the same result as without it."""
    prepared = prepared_of(simulate(9, 2, 12.0, unrelated=[1]))
    rates: list[float] = []
    search_at_rate, solve = _PairSearch.search_at_rate, hub.calibration.pairs.pair_network._solve

    def counted(
        self: _PairSearch, names: tuple[str, str], rate: float, near: tuple[float, float] | None = None
    ) -> PairSolution:
        rates.append(rate)
        return search_at_rate(self, names, rate, near)

    def without_previous(*given: Any, unguided: PairSolution | None = None, **more: Any) -> PairSolution:
        return solve(*given, **more)

    monkeypatch.setattr(_PairSearch, "search_at_rate", counted)
    _, (once,) = solve_pairs(prepared, lambda text, share: None, thorough=True)
    assert not once.solved
    assert len(rates) > 5
    assert rates.count(1.0) == 1
    monkeypatch.setattr(hub.calibration.pairs.pair_network, "_solve", without_previous)
    _, (again,) = solve_pairs(prepared, lambda text, share: None, thorough=True)
    assert rates.count(1.0) == 3
    assert again.status == once.status
    assert once.fit is not None
    assert again.fit is not None
    np.testing.assert_array_equal(again.fit.geometry.matrix, once.fit.geometry.matrix)
    assert (again.fit.offset, again.fit.rate) == (once.fit.offset, once.fit.rate)


def test_the_cache_distinguishes_tracks_and_their_time_scales() -> None:
    prepared = prepared_of(simulate(3, 2, 20.0))
    (track,) = smooth_only(prepared.camera("cam0").tracks).values()
    cache = TrackCache()
    grid = cache.grid([track], 0.05, 0.5)
    assert cache.grid([track], 0.05, 0.5) is grid
    assert cache.grid([track], 0.05, 1.0).sigma == pytest.approx(2.0 * grid.sigma)
    assert cache.grid([track], 0.02, 0.5).step == 0.02
    slower = track.scaled(2.0)
    assert cache.bandwidth(slower) == pytest.approx(0.5 * cache.bandwidth(track))
    assert cache.fast_image_speed(slower) == pytest.approx(0.5 * cache.fast_image_speed(track))
    assert cache.grid([slower], 0.05, 0.5).points.shape[1] == pytest.approx(2 * grid.points.shape[1], abs=3)


def test_no_scan_is_made_near_a_lag_without_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = prepared_of(simulate(3, 2, 20.0))
    tracks = [smooth_only(prepared.camera(name).tracks) for name in ("cam0", "cam1")]
    monkeypatch.setattr("hub.sync.pair_solver.scan_lags", None)  # not to be called
    solution = solve_pair(tracks[0], tracks[1], ("cam0", "cam1"), predicted_lag=100.0)
    assert not solution.solved
    assert "other lags were not searched" in solution.status


def test_the_only_pair_of_a_camera_that_its_other_pairs_refute_is_left_to_resection() -> None:
    def network(refuting: int, calibrated: set[str]) -> str:
        names = ["a", "b", "c", "d"]
        pairs = {both: PairSolution(*both, "ok") for both in itertools.combinations(names, 2)}
        pairs |= {(name, "x"): PairSolution(name, "x", "refuted", refuted=True) for name in names[:refuting]}
        pairs["d", "x"] = PairSolution("d", "x", "ok")
        _leave_to_resection(pairs, calibrated)
        assert all(pair.solved for (_, one), pair in pairs.items() if one != "x")
        return pairs["d", "x"].status

    assert network(2, {"x"}) == "its lag contradicts 2 other pairs of x"
    assert network(1, {"x"}) == "ok"
    assert network(3, set()) == "ok"  # resection finds no camera without a lens


def test_a_camera_whose_search_has_failed_waits_until_a_path_may_spare_it_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = simulate(3, 4, 20.0)
    mine = session.of_camera("cam1")
    pixels = session.pixels.copy()
    pixels[mine] = pixels[np.random.default_rng(0).permutation(np.flatnonzero(mine))]
    prepared = prepared_of(Session(**{**_fields(session), "pixels": pixels}))
    order = [("cam0", "cam2"), ("cam0", "cam1"), ("cam1", "cam2"), ("cam1", "cam3"), ("cam0", "cam3"), ("cam2", "cam3")]
    monkeypatch.setattr("hub.calibration.pairs.pair_network._ranked", lambda *_: order)
    _, pairs = solve_pairs(prepared, lambda text, share: None, thorough="first pair")
    assert all(pair.solved for pair in pairs if "cam1" not in (pair.a, pair.b))
    searched = [pair for pair in pairs if "cam1" in (pair.a, pair.b) and "not searched" not in pair.status]
    assert [(pair.a, pair.b) for pair in searched] == [("cam0", "cam1")]


def _fields(session: Session) -> dict[str, Any]:
    return {name: getattr(session, name) for name in session.__dataclass_fields__}
