"""Groups of cameras that solved pairs connect, while more pairs are being solved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from hub.bundle.preprocessing import PreparedSession
from hub.sync.hypothesis import PairSolution

MIN_REDUNDANT = 3  # cameras from which on pairs are checked against each other
ENOUGH_PAIRS = 2  # of a new camera with placed ones: the second checks the first
_MAX_PAIR_NOISE = 2.0
"""Median residual of a camera's pairs, over that of the best pairs of all: above it its lens may be wrong."""


class SynchronisedGroups:
    """Groups of cameras connected by solved pairs, each with a common time: ``t_group = rate * t + offset``."""

    def __init__(self) -> None:
        self._maps: dict[str, tuple[str, float, float]] = {}
        self._residuals: dict[str, list[float]] = {}

    def has_enough(self, a: str, b: str) -> bool:
        """Whether two cameras are in one group, and each in pairs that check each other."""
        one, other = (self._maps.get(name, ("", 0.0, 0.0))[0] for name in (a, b))
        return bool(one) and one == other and all(len(self._residuals[name]) > ENOUGH_PAIRS for name in (a, b))

    def add(self, pair: PairSolution) -> None:
        """Merge the groups of a solved pair's cameras; a pair within one group changes nothing."""
        if not pair.solved or pair.fit is None:
            return
        for name in (pair.a, pair.b):
            self._residuals.setdefault(name, []).append(pair.fit.residual_px)
            self._maps.setdefault(name, (name, 1.0, 0.0))
        (group_a, rate_a, offset_a), (group_b, rate_b, offset_b) = self._maps[pair.a], self._maps[pair.b]
        if group_a == group_b:
            return
        # t_a = rate t_b + offset, so group a's time from group b's
        rate = rate_a * pair.fit.rate / rate_b
        offset = rate_a * pair.fit.offset + offset_a - rate * offset_b
        for name, (group, r, o) in list(self._maps.items()):
            if group == group_b:
                self._maps[name] = (group_a, rate * r, rate * o + offset)

    def size(self, name: str) -> int:
        """Number of cameras in the group of a camera; 0 where it is connected to none."""
        group = self._maps.get(name, ("", 1.0, 0.0))[0]
        return sum(other == group for other, _, _ in self._maps.values())

    def leaves(self, a: str, b: str, pairs: Iterable[PairSolution]) -> bool:
        """Whether one of two cameras is in a group of three or more, and the other's best pair with it has failed.

        A failed pair with a camera whose own pairs fit far worse than the others' says nothing about the new one.
        """
        groups = Counter(group for group, _, _ in self._maps.values())
        most = _MAX_PAIR_NOISE * np.median([min(pixels) for pixels in self._residuals.values()] or [np.inf])
        for new, old in ((a, b), (b, a)):
            group = self._maps.get(old, ("", 1.0, 0.0))[0]
            if new in self._maps or groups[group] < MIN_REDUNDANT:
                continue
            tried = [pair.b if pair.a == new else pair.a for pair in pairs if new in (pair.a, pair.b)]
            inside = [other for other in tried if self._maps.get(other, ("", 1.0, 0.0))[0] == group]
            if any(np.median(self._residuals[other]) <= most for other in inside):
                return True
        return False

    def has_failed(self, a: str, b: str, pairs: Iterable[PairSolution]) -> bool:
        """Whether one of two cameras is connected to none, and a pair of it with a connected one has failed."""
        tried = [(pair.a, pair.b) for pair in pairs]
        return any(
            new not in self._maps and any(new in both and any(one in self._maps for one in both) for both in tried)
            for new in (a, b)
        )

    def lag(self, prepared: PreparedSession, a: str, b: str) -> float | None:
        """``t_a - t_b`` [s] in the middle of the common recording time; None if they are not connected."""
        if a not in self._maps or b not in self._maps or self._maps[a][0] != self._maps[b][0]:
            return None
        (_, rate_a, offset_a), (_, rate_b, offset_b) = self._maps[a], self._maps[b]
        rate, offset = rate_b / rate_a, (offset_b - offset_a) / rate_a
        begin_a, end_a = time_span(prepared, a)
        begin_b, end_b = (rate * time + offset for time in time_span(prepared, b))
        middle = 0.5 * (max(begin_a, begin_b) + min(end_a, end_b))
        return middle - (middle - offset) / rate


def time_span(prepared: PreparedSession, name: str) -> tuple[float, float]:
    """Times [s] of a camera's first and last row, from its origin."""
    tracks = prepared.camera(name).tracks.values()
    return min(float(track.time[0]) for track in tracks), max(float(track.time[-1]) for track in tracks)
