"""Cameras split over hubs: balanced, few pairs across, the same whoever computes it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hub.distributed.sharding import cut, partition

Pairs = dict[tuple[str, str], float]


def along_a_street(count: int, reach: int = 5) -> tuple[list[str], Pairs]:
    names = [f"cam{number}" for number in range(count)]
    return names, {
        (names[a], names[b]): float(reach + 1 - (b - a))
        for a in range(count)
        for b in range(a + 1, min(count, a + reach + 1))
    }


def over_a_town(count: int, seed: int) -> tuple[list[str], Pairs]:
    """Cameras anywhere on a square, each overlapping with some ten."""
    rng = np.random.default_rng(seed)
    at, names = rng.uniform(0, 1, (count, 2)), [f"cam{number}" for number in range(count)]
    close = np.linalg.norm(at[:, None] - at[None, :], axis=2) < np.sqrt(10 / np.pi / count)
    return names, {(names[a], names[b]): 1.0 for a, b in itertools.combinations(range(count), 2) if close[a, b]}


@pytest.mark.parametrize("parts", [2, 3, 4, 7])
def test_a_street_is_cut_across_where_fewest_pairs_are(parts: int) -> None:
    names, pairs = along_a_street(400)
    shuffled = [names[k] for k in np.random.default_rng(0).permutation(400)]
    groups = partition(pairs, shuffled, parts)
    assert sorted(itertools.chain(*groups)) == sorted(names)
    assert max(map(len, groups)) <= 1.15 * 400 / parts
    assert cut(pairs, groups) <= 1.1 * 15 * (parts - 1), "15 pairs are across each place of the street"


def test_a_town_in_four_has_a_tenth_of_the_pairs_across_that_hashing_has() -> None:
    names, pairs = over_a_town(600, 1)
    groups = partition(pairs, names, 4)
    assert max(map(len, groups)) <= 1.15 * 150
    hashed = [names[number::4] for number in range(4)]
    assert cut(pairs, groups) < 0.12 * cut(pairs, hashed)


def test_the_parts_do_not_depend_on_the_order_in_which_pairs_were_heard() -> None:
    names, pairs = over_a_town(200, 2)
    backwards = dict(reversed(list(pairs.items())))
    assert partition(pairs, names, 4) == partition(backwards, names, 4)


def test_separate_places_lone_cameras_and_more_hubs_than_cameras() -> None:
    names, pairs = along_a_street(20)
    more = [*names, "alone"]
    groups = partition(pairs, more, 3)
    assert sorted(itertools.chain(*groups)) == sorted(more)
    assert partition({}, ["a", "b"], 4) == [["a"], ["b"], [], []]
    twice = {**pairs, **{(f"x{a}", f"x{b}"): weight for (a, b), weight in pairs.items()}}
    halves = partition(twice, [*names, *(f"x{name}" for name in names)], 2)
    assert cut(twice, halves) == 0
