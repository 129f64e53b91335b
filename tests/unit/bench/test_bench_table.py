"""The table of `make bench`: ratios, limits, what fell; and how many hubs and routers some cameras need."""

from __future__ import annotations

import json

import pytest

from tests.bench.scale import Cost, needed
from tests.bench.speed.rows import Limit, Row, Section, fallen, table

SLOWER = Row("work", 20.0, "ms", "a peer", 10.0, must=Limit("ratio", 0.67), reach=Limit("ours", 25.0))
FASTER = Row("rate", 300.0, "/s", "a peer", 100.0, less=False, must=Limit("ours", 200.0), reach=Limit("ratio", 5.0))
ALONE = Row("memory", 138.0, "MB", must=Limit("ours", 150.0))


def test_a_ratio_above_one_means_that_ours_is_ahead_of_times_and_of_rates() -> None:
    assert SLOWER.ratio == pytest.approx(0.5)
    assert FASTER.ratio == pytest.approx(3.0)
    assert ALONE.ratio is None


def test_limits_are_read_from_the_side_that_the_row_means() -> None:
    assert [row.holds(row.must) for row in (SLOWER, FASTER, ALONE)] == [False, True, True]
    assert [row.holds(row.reach) for row in (SLOWER, FASTER, ALONE)] == [True, False, None]
    assert Row("x", 1.0, "s", must=Limit("ratio", 2.0)).holds(Limit("ratio", 2.0)) is None


def test_the_table_says_what_is_missed_and_what_is_reached() -> None:
    lines = table([SLOWER, FASTER, ALONE]).splitlines()
    assert "**no**" in lines[2]
    assert "≤ 25 ms ✓" in lines[2]
    assert "yes" in lines[3]
    assert "≥ 200 /s" in lines[3]
    assert len({line.count("|") for line in lines[:5]}) == 1


def test_a_section_survives_the_way_between_processes() -> None:
    section = Section([SLOWER, FASTER, ALONE], ["nothing else"])
    assert Section.from_json(json.loads(json.dumps(section.as_json()))) == section


def test_what_fell_by_more_than_a_fifth_is_told_and_nothing_else() -> None:
    kept = {row.key: row.kept() for row in (SLOWER, FASTER, ALONE)}
    assert fallen([SLOWER, FASTER, ALONE], kept) == []
    slightly = Row("work", 24.0, "ms", "a peer", 10.0)
    assert fallen([slightly], kept) == []
    worse = Row("work", 26.0, "ms", "a peer", 10.0)
    assert fallen([worse], kept) == ["work | a peer: 0.385×, was 0.5×"]
    # A slower machine slows both: only what has no peer is judged by itself.
    assert fallen([Row("work", 200.0, "ms", "a peer", 100.0)], kept) == []
    assert fallen([Row("memory", 180.0, "MB")], kept) == ["memory: 180 MB, was 138 MB"]


def test_hubs_and_routers_follow_from_what_an_observation_costs() -> None:
    hub, router = Cost.through(500.0, 0.10, 1500.0, 0.20), Cost(0.0, 1e-6)
    assert hub.idle == pytest.approx(0.05)
    assert hub.most(0.5) == pytest.approx(4500.0)
    hubs, routers, why = needed(hub, router, 5.0)
    assert (hubs, why) == (12, "sessions")
    assert routers == 11
    assert needed(hub, Cost(0.0, 1e-3), 5.0)[1:] == (50, "CPU")
