"""Which cameras each hub of a site takes: their overlap by times of arrival, and a split that changes little."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.distributed.partition import cut, partition
from hub.sync.overlap import BIN_S, MOST_PARTNERS, common_seconds
from hub.sync.settings import PairSettings

_WINDOW_S = 30.0  # of film that overlaps come from: what a calibration needs at least
_MAX_EXCESS = 0.25
"""By how much a group may be larger than its share before all are split anew; a split itself leaves a twentieth."""
_MAX_CUT = 2.0
"""How many times as many pairs may be across as in a new split: cameras that move change hands at some cost."""

Groups = Mapping[str, Sequence[str]]
"""Cameras by hub."""
Pairs = dict[tuple[str, str], float]
"""Seconds in which two cameras, in the order of their names, saw one target."""


class OverlapMeter:
    """Seconds of common view of the cameras that one hub hears, over the last half minute."""

    def __init__(self) -> None:
        self._bins: deque[tuple[int, set[tuple[str, str]]]] = deque()

    def observe(self, camera: str, labels: Iterable[str], now: float) -> None:
        """What a camera saw in a frame that arrived ``now`` [s, any monotonic clock]."""
        bin_number = int(now // BIN_S)
        if not self._bins or self._bins[-1][0] < bin_number:
            self._bins.append((bin_number, set()))
            while self._bins[0][0] < bin_number - _WINDOW_S / BIN_S:
                self._bins.popleft()
        self._bins[-1][1].update((camera, label) for label in labels)

    def pairs(self) -> Pairs:
        """Those with enough for a lag to be scanned, of each camera the largest few."""
        seen = [(number, *who) for number, both in self._bins for who in both]
        cameras, targets = (sorted({one[k] for one in seen}) for k in (1, 2))
        place = [{name: index for index, name in enumerate(names)} for names in (cameras, targets)]
        key = np.array([number * len(targets) + place[1][target] for number, _, target in seen], np.int64)
        seconds = common_seconds(
            np.array([place[0][camera] for _, camera, _ in seen], np.int64), key, len(targets), len(cameras)
        )
        out: Pairs = {}
        for index, camera in enumerate(cameras):
            row = slice(seconds.indptr[index], seconds.indptr[index + 1])
            partners = sorted(zip(-seconds.data[row], seconds.indices[row], strict=True))
            most = [(cameras[k], -less) for less, k in partners if k != index][:MOST_PARTNERS]
            for other, value in most:
                if value >= PairSettings().min_scan_support:
                    out[min(camera, other), max(camera, other)] = float(value)
        return out


def split(pairs: Pairs, cameras: Iterable[str], hubs: Iterable[str], before: Groups) -> dict[str, list[str]]:
    """Cameras by hub: ``before`` with new ones added, where its hubs are these, its sizes balanced and its cut small.

    Otherwise the graph is partitioned anew, and each part goes to the hub that had most of it (scratch-remap, Oliker
    and Biswas 1998). A function of its arguments alone.
    """
    known = set(cameras)
    names, hubs = sorted(known), sorted(set(hubs))
    inside = {pair: weight for pair, weight in pairs.items() if known.issuperset(pair)}
    parts = partition(inside, names, len(hubs))
    if set(before) == set(hubs):
        kept = _with_new_cameras(inside, names, before)
        is_balanced = max(map(len, kept.values())) <= (1.0 + _MAX_EXCESS) * len(names) / len(hubs) + 1.0
        if is_balanced and cut(inside, list(kept.values())) <= _MAX_CUT * cut(inside, parts) + len(hubs):
            return kept
    common = [[len(set(part) & set(before.get(hub, ()))) for part in parts] for hub in hubs]
    rows, columns = linear_sum_assignment(common, maximize=True)
    return {hubs[row]: sorted(parts[column]) for row, column in zip(rows, columns, strict=True)}


def _with_new_cameras(pairs: Pairs, names: Sequence[str], before: Groups) -> dict[str, list[str]]:
    """Each new camera goes to the hub that it overlaps with most; without any, to the smallest group."""
    kept = {hub: [name for name in group if name in set(names)] for hub, group in before.items()}
    hub_of = {name: hub for hub, group in kept.items() for name in group}
    neighbours: dict[str, list[tuple[str, float]]] = {}
    for (a, b), weight in pairs.items():
        neighbours.setdefault(a, []).append((b, weight))
        neighbours.setdefault(b, []).append((a, weight))
    new = [name for name in names if name not in hub_of]
    while new:
        ties = {(name, hub): 0.0 for name in new for hub in kept}
        for name in new:
            for other, weight in neighbours.get(name, ()):
                if other in hub_of:
                    ties[name, hub_of[other]] += weight
        name, hub = max(ties, key=lambda tie: (ties[tie], -len(kept[tie[1]]), tie))
        kept[hub].append(name)
        hub_of[name] = hub
        new.remove(name)
    return {hub: sorted(group) for hub, group in kept.items()}


def border(pairs: Iterable[tuple[str, str]], group: Iterable[str]) -> set[str]:
    """Cameras outside a group that overlap with one inside."""
    inside = set(group)
    return {b if a in inside else a for a, b in pairs if (a in inside) != (b in inside)}
