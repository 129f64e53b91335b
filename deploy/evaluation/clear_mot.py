"""How well targets were followed, against the truth: CLEAR MOT and identity scores.

Bernardin and Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics" (2008), and Ristani
et al., "Performance measures and a data set for multi-target, multi-camera tracking" (2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True)
class Moment:
    """One instant. truth: places (t, d) of those who are there, by name. found: (n, d) of those told, by label."""

    truth_names: tuple[str, ...]
    truth: Floats
    found_names: tuple[str, ...]
    found: Floats


@dataclass(frozen=True, slots=True)
class Scores:
    """Counts over instants, and what is made of them.

    mota: 1 - (misses + false + switches) / truths. idf1: identity F1. error, error_p95: mean distance of the matched in
    the truth's unit, and what 95 % of them keep. switches: times a true target's label changed. fragments: times it was
    lost and found. labels: how many were given.
    """

    mota: float
    idf1: float
    error: float
    error_p95: float
    truths: int
    matches: int
    misses: int
    false: int
    switches: int
    fragments: int
    labels: int


def clear_mot(moments: Sequence[Moment], reach: float) -> Scores:
    """Scores over instants. reach: the farthest that a found place may be from a true one.

    As in the paper, a pair of the last instant stays while it is within reach; the rest is matched anew by least
    distance.
    """
    last: dict[str, str] = {}
    holds: dict[str, str] = {}
    errors: list[float] = []
    misses = false = switches = fragments = truths = 0
    was_tracked: dict[str, bool] = {}
    shared: dict[tuple[str, str], int] = {}
    found_count: dict[str, int] = {}
    for moment in moments:
        t, n = len(moment.truth_names), len(moment.found_names)
        truths += t
        for label in moment.found_names:
            found_count[label] = found_count.get(label, 0) + 1
        distance = np.linalg.norm(moment.truth[:, None] - moment.found[None], axis=2) if t and n else np.zeros((t, n))
        pairs: dict[int, int] = {}
        for i, name in enumerate(moment.truth_names):
            held = holds.get(name)
            if held is not None and held in moment.found_names:
                j = moment.found_names.index(held)
                if distance[i, j] < reach and j not in pairs.values():
                    pairs[i] = j
        rows = [i for i in range(t) if i not in pairs]
        columns = [j for j in range(n) if j not in pairs.values()]
        if rows and columns:
            part = distance[np.ix_(rows, columns)]
            a, b = linear_sum_assignment(np.where(part < reach, part, 1e6))
            pairs |= {rows[i]: columns[j] for i, j in zip(a, b, strict=True) if part[i, j] < reach}
        holds = {}
        for i, name in enumerate(moment.truth_names):
            if i not in pairs:
                misses += 1
                was_tracked[name] = False
                continue
            label = moment.found_names[pairs[i]]
            if name in last and last[name] != label:
                switches += 1
            if was_tracked.get(name) is False and name in last:
                fragments += 1
            was_tracked[name], last[name], holds[name] = True, label, label
            errors.append(float(distance[i, pairs[i]]))
        false += n - len(pairs)
        for i in range(t):
            for j in range(n):
                if distance[i, j] < reach:
                    key = (moment.truth_names[i], moment.found_names[j])
                    shared[key] = shared.get(key, 0) + 1
    matches = len(errors)
    return Scores(
        mota=1.0 - (misses + false + switches) / max(truths, 1),
        idf1=_idf1(shared, truths, sum(found_count.values())),
        error=float(np.mean(errors)) if errors else float("nan"),
        error_p95=float(np.quantile(errors, 0.95)) if errors else float("nan"),
        truths=truths,
        matches=matches,
        misses=misses,
        false=false,
        switches=switches,
        fragments=fragments,
        labels=len(found_count),
    )


def _idf1(shared: dict[tuple[str, str], int], truths: int, found: int) -> float:
    """2 IDTP / (truths + found), names and labels matched one to one over the whole time."""
    if not shared or not truths + found:
        return 0.0
    names, labels = sorted({name for name, _ in shared}), sorted({label for _, label in shared})
    table = np.zeros((len(names), len(labels)))
    for (name, label), count in shared.items():
        table[names.index(name), labels.index(label)] = count
    rows, columns = linear_sum_assignment(-table)
    return float(2.0 * table[rows, columns].sum() / (truths + found))
