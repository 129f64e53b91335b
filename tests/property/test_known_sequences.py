"""Duplicates are known in constant memory as they are by remembering all, as long as they are not very old."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from protocols.session.builder import _DUPLICATE_WINDOW, _BootBuffer


@given(st.lists(st.integers(0, 40_000), max_size=200))
def test_a_live_hub_knows_the_duplicates_that_a_set_knows(sequences: list[int]) -> None:
    live, all_of_them = _BootBuffer(), _BootBuffer()
    highest = -1
    for sequence in sequences:
        duplicate, known = live.is_recent_duplicate(sequence, 0, 1.0 + sequence), all_of_them.is_duplicate(sequence)
        assert duplicate == (known or sequence <= highest - _DUPLICATE_WINDOW)
        highest = max(highest, sequence)
    assert live.ring is None or len(live.ring) == _DUPLICATE_WINDOW // 8
