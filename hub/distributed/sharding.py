"""Which cameras each hub of a site takes: their overlap by times of arrival, and a split that changes little."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import eigsh

from hub.sync.overlap import BIN_S, MOST_PARTNERS, common_seconds
from hub.sync.settings import PairSettings
from protocols.geometry.types import Ints

_IMBALANCE = 0.05
"""By how much a part may be larger than its share, for a smaller cut."""
_EXACT_SIZE = 64
"""Vertices up to which the eigenvector comes from a dense matrix."""
_WINDOW_S = 30.0  # of film that overlaps come from: what a calibration needs at least
_MAX_EXCESS = 0.25
"""By how much a group may be larger than its share before all are split anew; a split itself leaves a twentieth."""
_MAX_CUT = 2.0
"""How many times as many pairs may be across as in a new split: cameras that move change hands at some cost."""


def partition(pairs: Mapping[tuple[str, str], float], cameras: Sequence[str], parts: int) -> list[list[str]]:
    """Cameras split into ``parts`` groups, in the order of ``cameras``; a camera without pairs fills the smallest.

    pairs: weight of each overlap, as seconds of common motion. Sizes differ by about a twentieth. Recursive spectral
    bisection (Pothen, Simon and Liou 1990): along the Laplacian's second eigenvector neighbours stand next to each
    other, so a cut in its middle is balanced and crosses few edges; single vertices are then moved while that makes the
    cut smaller (Fiduccia and Mattheyses 1982, one sweep). A function of the graph alone: all hubs find the same.
    """
    index = {name: number for number, name in enumerate(cameras)}
    rows = [(index[a], index[b], weight) for (a, b), weight in sorted(pairs.items()) if a != b and weight > 0.0]
    one, other, weights = (np.array(column) for column in zip(*rows, strict=True)) if rows else (np.zeros(0, int),) * 3
    ends = np.concatenate([one, other]), np.concatenate([other, one])
    graph = csr_array((np.concatenate([weights, weights]).astype(float), ends), (len(cameras), len(cameras)))
    found = np.zeros(len(cameras), np.int64)
    _split(graph, np.arange(len(cameras)), found, 0, max(1, min(parts, len(cameras))))
    return [[name for name, part in zip(cameras, found, strict=True) if part == number] for number in range(parts)]


def cut(pairs: Iterable[tuple[str, str]], groups: Sequence[Sequence[str]]) -> int:
    """Pairs whose cameras are in different groups."""
    group = {name: number for number, names in enumerate(groups) for name in names}
    return sum(group[a] != group[b] for a, b in pairs)


def _split(graph: Any, members: Ints, found: Ints, first: int, parts: int) -> None:
    """Write the numbers first, first + 1, … of the parts of ``members`` into ``found``."""
    if parts == 1:
        found[members] = first
        return
    left = parts // 2
    inside = graph[members][:, members]
    size = round(len(members) * left / parts)
    order = _along(inside)
    chosen = np.zeros(len(members), np.bool_)
    chosen[order[:size]] = True
    _improve(inside, chosen, order, size)
    _split(graph, members[chosen], found, first, left)
    _split(graph, members[~chosen], found, first + left, parts - left)


def _along(graph: Any) -> Ints:
    """Vertices along the second eigenvector of each component, the components one after the other."""
    count, component = connected_components(graph, directed=False)
    out = []
    for number in range(count):
        members = np.flatnonzero(component == number)
        out.append(members[_fiedler_order(graph[members][:, members])])
    return np.concatenate(sorted(out, key=len, reverse=True))


def _fiedler_order(graph: Any) -> Ints:
    size = graph.shape[0]
    if size < 3:
        return np.arange(size)
    degree = np.asarray(graph.sum(axis=1)).ravel()
    laplacian = diags_array(degree) - graph
    if size <= _EXACT_SIZE:
        vector = np.linalg.eigh(laplacian.toarray())[1][:, 1]
    else:
        # Factorised in an order of small bandwidth: a street's Laplacian is then a band.
        near = np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True))
        shifted = csr_array(laplacian)[near][:, near].tocsc()
        start = np.linspace(-1.0, 1.0, size)
        scale = -1e-6 * float(degree.mean())
        _, vectors = eigsh(shifted, k=2, sigma=scale, v0=start, tol=1e-6)
        vector = np.empty(size)
        vector[near] = vectors[:, 1]
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    return np.argsort(vector, kind="stable")


def _improve(graph: Any, chosen: np.ndarray[Any, np.dtype[np.bool_]], order: Ints, size: int) -> None:
    """Move vertices near the cut to the other side, once each, where that makes the cut smaller."""
    slack = max(1, int(_IMBALANCE * min(size, len(order) - size)))
    window = order[max(0, size - 4 * slack) : size + 4 * slack]
    count = int(chosen.sum())
    for vertex in window:
        row = slice(graph.indptr[vertex], graph.indptr[vertex + 1])
        same = chosen[graph.indices[row]] == chosen[vertex]
        gain = float(graph.data[row][~same].sum() - graph.data[row][same].sum())
        after = count + (-1 if chosen[vertex] else 1)
        if gain > 0.0 and abs(after - size) <= slack:
            chosen[vertex], count = not chosen[vertex], after


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
