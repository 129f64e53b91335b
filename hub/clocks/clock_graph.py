"""Time synchronisation over the graph of camera pairs: one time map per camera, with outlier pairs rejected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from hub.sync.hypothesis import PairSolution, evidence
from hub.trajectory.image_tracks import ImageTrack
from protocols.geometry.types import Floats

_MAX_LAG_RESIDUAL = 0.15  # s: a pair whose lag differs that much from the network's solution is an outlier
_LAG_STD, _RATE_STD = 0.01, 5e-4  # s; weights of a pair's lag and of a clock's nominal rate
_RATE_BASELINE = 30.0  # s: time span by which a rate difference is weighed as a time difference


@dataclass(frozen=True, slots=True)
class TimeMapEstimate:
    """Initial time map of one camera: ``t = rate * (t_camera - centre) + offset``, times from the session's origins."""

    rate: float
    offset: float
    centre: float


@dataclass(frozen=True, slots=True, eq=False)
class ClockGraph:
    """Time maps of one connected component, the pairs consistent with them, and the rejected outlier pairs."""

    clocks: dict[str, TimeMapEstimate]
    inlier_pairs: tuple[PairSolution, ...]
    outlier_pairs: tuple[PairSolution, ...]


def connected_components(names: list[str], pairs: list[PairSolution]) -> list[list[str]]:
    """Connected components over solved pairs, largest first; equal sizes by the order of names."""
    parent = {name: name for name in names}

    def root(name: str) -> str:
        while parent[name] != name:
            name = parent[name]
        return name

    for pair in pairs:
        parent[root(pair.a)] = root(pair.b)
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(root(name), []).append(name)
    return sorted(groups.values(), key=lambda group: (-len(group), names.index(group[0])))


def synchronise_clocks(
    names: list[str], pairs: list[PairSolution], tracks: Mapping[str, Mapping[str, ImageTrack]]
) -> ClockGraph:
    """L1 average of the pairs' time maps over one connected component (iteratively reweighted least squares).

    names: cameras of the component. Pairs that contradict the average are rejected as outliers, worst first, unless
    they are bridges: only the cycles of the graph are redundant.
    """
    centres = {name: _time_centre(tracks[name]) for name in names}
    kept, outliers = list(pairs), []
    while True:
        offsets, rates, errors = _solve_time_maps(names, kept, centres)
        worst = int(np.argmax(errors)) if len(errors) else -1
        if worst < 0 or errors[worst] < _MAX_LAG_RESIDUAL:
            break
        without = kept[:worst] + kept[worst + 1 :]
        if len(connected_components(names, without)[0]) < len(names):
            break  # a bridge cannot contradict anything
        outliers.append(kept[worst])
        kept = without
    clocks = {name: TimeMapEstimate(rates[i], offsets[i], centres[name]) for i, name in enumerate(names)}
    return ClockGraph(clocks, tuple(kept), tuple(outliers))


def _time_centre(tracks: Mapping[str, ImageTrack]) -> float:
    begin = min(float(track.time[0]) for track in tracks.values())
    end = max(float(track.time[-1]) for track in tracks.values())
    return 0.5 * (begin + end)


def _solve_time_maps(
    names: list[str], pairs: list[PairSolution], centres: dict[str, float]
) -> tuple[Floats, Floats, Floats]:
    """Offsets and rates (n,), and the residual of each pair (m,) [s]."""
    count = len(names)
    index = {name: i for i, name in enumerate(names)}
    # Unknowns: offset and rate less 1 per camera. Rows: time agreement at two times around the overlap.
    entries, right, owner, base_weight = list[tuple[int, int, float]](), list[float](), list[int](), list[float]()
    for number, pair in enumerate(pairs):
        fit = pair.fit
        if fit is None:
            continue
        a, b = index[pair.a], index[pair.b]
        middle = fit.mid_time
        for time_a in (middle - _RATE_BASELINE / 2, middle + _RATE_BASELINE / 2):
            since_a, since_b = time_a - centres[pair.a], (time_a - fit.offset) / fit.rate - centres[pair.b]
            row = {2 * a: 1.0, 2 * a + 1: since_a, 2 * b: -1.0, 2 * b + 1: -since_b}
            entries += [(len(right), column, value) for column, value in row.items()]
            right.append(since_b - since_a)
            owner.append(number)
            base_weight.append(np.sqrt(max(evidence(fit), 1e-3)) / _LAG_STD)
    for i in range(count):  # rates near nominal
        entries.append((len(right), 2 * i + 1, 1.0))
        right.append(0.0)
        owner.append(-1)
        base_weight.append(1.0 / _RATE_STD)
    at, columns, values = zip(*entries, strict=True)
    matrix = csr_array((values, (at, columns)), shape=(len(right), 2 * count))[:, 1:]  # the first offset is 0
    target, owners, base = np.array(right), np.array(owner), np.array(base_weight)
    solution, weight, error = np.zeros(2 * count), base, np.zeros(len(target))
    for _ in range(30):
        weighted = matrix.multiply(weight[:, None] ** 2).T.tocsc()
        # By a correction: rounding of the normal equations is corrected by the next one.
        solution[1:] += splu(weighted @ matrix).solve(weighted @ (target - matrix @ solution[1:]))
        error = np.abs(matrix @ solution[1:] - target)
        weight = base / np.sqrt(np.where(owners >= 0, np.maximum(error / _LAG_STD, 0.1), 1.0))
    errors = np.array([error[owners == number].mean() for number in range(len(pairs))])
    return solution[::2], 1.0 + solution[1::2], errors
