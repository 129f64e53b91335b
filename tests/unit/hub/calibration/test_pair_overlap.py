"""Pairs of a large network are chosen by overlap: no pair that could be synchronised is missing, none is without."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest

from hub.bundle.preprocessing import PreparedSession, prepare
from hub.bundle.problem import LARGE_NETWORK
from hub.calibration.pairs import pair_network
from hub.calibration.pairs.pair_network import solve_pairs
from hub.calibration.pairs.pair_overlap import candidate_pairs
from hub.clocks.clock_graph import connected_components
from hub.sync.hypothesis import PairSolution
from tests.support.long_street import street


def test_of_a_long_street_only_pairs_with_common_motion_are_tried() -> None:
    """Each pair of all cameras had a coarse scan: of a thousand 500,000, half an hour before the first answer."""
    rig, observations, arrivals, *_ = street(3, cameras=60, seconds=12.0)
    prepared = prepare(rig, observations)
    chosen = set(candidate_pairs(prepared, arrivals))
    assert 2 * 60 < len(chosen) < 12 * 60
    assert {both for pair in chosen for both in pair} == set(prepared.names)
    partners = {name: sum(name in pair for pair in chosen) for name in prepared.names}
    missing = 0
    for a, b in itertools.combinations(prepared.names, 2):
        apart = abs(int(a[3:]) - int(b[3:])) * 2.0
        assert (a, b) not in chosen or apart <= 24.0, "nobody sees further than 12 m"
        common = 0.0
        for label in set(observations.by_label(a)) & set(observations.by_label(b)):
            one, other = (observations.by_label(name)[label].time + arrivals[name].unix_minus_camera for name in (a, b))
            near = np.abs(one[:, None] - other[None, :]).min(axis=1) < 0.02
            common += near.sum() / 30.0
        missing += common > 2.0 and (a, b) not in chosen and min(partners[a], partners[b]) < 12
    assert missing == 0


def test_small_networks_and_unknown_clocks_have_all_their_pairs() -> None:
    rig, observations, arrivals, *_ = street(3, cameras=LARGE_NETWORK + 6, seconds=8.0)
    prepared = prepare(rig, observations)
    names, every = prepared.names, len(prepared.names) * (len(prepared.names) - 1) // 2
    assert len(candidate_pairs(prepared, None)) == every
    without = {name: prior for name, prior in arrivals.items() if name != names[0]}
    chosen = candidate_pairs(prepared, without)
    assert sum(names[0] in pair for pair in chosen) == len(names) - 1, "it may overlap with any"
    assert len(chosen) < every


def test_the_chosen_pairs_connect_all_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hub.calibration.pairs.pair_overlap.LARGE_NETWORK", 4)
    monkeypatch.setattr(pair_network, "LARGE_NETWORK", 4)
    rig, observations, arrivals, *_ = street(5, cameras=9, seconds=40.0)
    solve, searches = pair_network._solve, Counter[tuple[str, str]]()

    def counted(prepared: PreparedSession, names: tuple[str, str], *rest: Any, **more: Any) -> PairSolution:
        searches[names] += 1
        return solve(prepared, names, *rest, **more)

    monkeypatch.setattr(pair_network, "_solve", counted)
    prepared, pairs = solve_pairs(prepare(rig, observations), lambda text, share: None, arrivals=arrivals)
    solved = [pair for pair in pairs if pair.solved]
    assert len(connected_components(prepared.names, solved)[0]) == 9
    assert len(solved) < 9 * 8 // 2
    twice = [names for names, count in searches.items() if count > 1]
    assert not twice, "near the times of arrival; over all lags only where chance may fit there"
