"""Groups of cameras by hub: overlaps by times of arrival, and what joins, leaves and deaths change."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hub.distributed.sharding import OverlapMeter, border, cut, split
from tests.unit.hub.distributed.test_partition import along_a_street, over_a_town


def moved(before: dict[str, list[str]], after: dict[str, list[str]]) -> int:
    """Cameras that another hub has now."""
    hub_of = {name: hub for hub, group in before.items() for name in group}
    return sum(hub_of.get(name, hub) != hub for hub, group in after.items() for name in group)


def test_overlap_is_time_in_which_both_see_one_target() -> None:
    meter = OverlapMeter()
    for step in range(1000):
        time = 0.1 * step
        meter.observe("a", ["x"], time)
        meter.observe("b", ["x"] if time < 95.0 else [], time)
        meter.observe("c", ["y"], time)
        if step % 50 == 0:
            meter.observe("d", ["x"], time)
    pairs = meter.pairs()
    assert pairs.keys() == {("a", "b"), ("a", "d"), ("b", "d")}
    assert pairs["a", "b"] == pytest.approx(26.0, abs=1.1), "of the last 30 s without 5"
    assert pairs["a", "d"] < 12.0
    assert OverlapMeter().pairs() == {}


def test_of_many_partners_each_camera_keeps_those_with_most() -> None:
    meter = OverlapMeter()
    for step in range(60):
        for camera in range(40):
            if step >= camera:
                meter.observe(f"cam{camera:02d}", ["x"], 0.5 * step)
    pairs = meter.pairs()
    assert ("cam00", "cam01") in pairs
    assert len(pairs) <= 12 * 40


def test_without_a_change_nothing_moves_and_one_more_camera_moves_none() -> None:
    names, pairs = along_a_street(80)
    groups = split(pairs, names[:-1], ["a", "b", "c", "d"], {})
    assert split(pairs, names[:-1], ["d", "c", "b", "a"], groups) == groups
    after = split(pairs, names, ["a", "b", "c", "d"], groups)
    assert moved(groups, after) == 0
    home = next(hub for hub, group in after.items() if names[-1] in group)
    assert names[-2] in groups[home], "it goes where its neighbours are"
    left = split(pairs, names[1:], ["a", "b", "c", "d"], groups)
    assert moved(groups, left) == 0


@pytest.mark.parametrize("make", [along_a_street, lambda n: over_a_town(n, 4)])
def test_a_death_moves_little_more_than_what_the_dead_hub_had(make: object) -> None:
    names, pairs = make(120)  # type: ignore[operator]
    groups = split(pairs, names, ["a", "b", "c", "d"], {})
    after = split(pairs, names, ["a", "c", "d"], groups)
    assert set(after) == {"a", "c", "d"}
    assert sorted(itertools.chain(*after.values())) == sorted(names)
    assert max(map(len, after.values())) <= 1.15 * 40
    assert moved(groups, after) <= 30 + 30, "30 were the dead hub's, and as many balance the others"


def test_far_too_large_groups_and_far_too_many_pairs_across_are_split_anew() -> None:
    names, pairs = along_a_street(80)
    skewed = {"a": names[:70], "b": names[70:]}
    assert max(map(len, split(pairs, names, "ab", skewed).values())) <= 44
    mixed = {"a": names[::2], "b": names[1::2]}
    assert cut(pairs, list(split(pairs, names, "ab", mixed).values())) < 0.2 * cut(pairs, list(mixed.values()))


@settings(deadline=None, max_examples=50)
@given(st.sets(st.integers(0, 39), max_size=40), st.sets(st.sampled_from("abcde"), min_size=1), st.integers(0, 3))
def test_each_camera_is_in_one_group_of_a_living_hub(present: set[int], hubs: set[str], seed: int) -> None:
    names, pairs = over_a_town(40, seed)
    before = split(pairs, names, ["a", "b", "c"], {})
    cameras = [names[number] for number in sorted(present)]
    groups = split(pairs, cameras, hubs, before)
    assert set(groups) == hubs
    assert sorted(itertools.chain(*groups.values())) == sorted(cameras)
    assert groups == split(dict(reversed(pairs.items())), reversed(cameras), sorted(hubs, reverse=True), before)
    for group in groups.values():
        across = border(pairs, group)
        assert not across & set(group)
        assert across == {n for n in names if n not in group and any({n, m} in map(set, pairs) for m in group)}
