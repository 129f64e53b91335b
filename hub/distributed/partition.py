"""Which cameras one hub takes: parts of the overlap graph of equal size with few pairs across.

Recursive spectral bisection (Pothen, Simon and Liou 1990): along the Laplacian's second eigenvector neighbours stand
next to each other, so a cut in its middle is balanced and crosses few edges; single vertices are then moved while that
makes the cut smaller (Fiduccia and Mattheyses 1982, one sweep). A function of the graph alone: all hubs find the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import eigsh

from protocols.geometry.types import Ints

_IMBALANCE = 0.05
"""By how much a part may be larger than its share, for a smaller cut."""
_EXACT_SIZE = 64
"""Vertices up to which the eigenvector comes from a dense matrix."""


def partition(pairs: Mapping[tuple[str, str], float], cameras: Sequence[str], parts: int) -> list[list[str]]:
    """Cameras split into ``parts`` groups, in the order of ``cameras``; a camera without pairs fills the smallest.

    pairs: weight of each overlap, as seconds of common motion. Sizes differ by about a twentieth.
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
