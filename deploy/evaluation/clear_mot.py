"""Multi-target tracking metrics against ground truth: CLEAR MOT and identity scores.

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
class EvaluationFrame:
    """One instant. truth: true positions (t, d), by truth_names. found: estimates (n, d), by estimate_labels."""

    truth_names: tuple[str, ...]
    truth: Floats
    estimate_labels: tuple[str, ...]
    found: Floats


@dataclass(frozen=True, slots=True)
class MotScores:
    """Tracking scores: counts over all instants, and ratios of them.

    mota: 1 - (misses + false + switches) / truths. idf1: identity F1. error, error_p95: mean and 95 % quantile of the
    distance of matched pairs, in the unit of the truth. switches: label changes of true targets. fragments:
    interruptions of tracks of true targets. labels: number of different labels.
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


def clear_mot(moments: Sequence[EvaluationFrame], max_distance: float) -> MotScores:
    """Scores over instants. max_distance: largest distance of a matched estimate from the true position.

    As in the CLEAR MOT paper, a pair of the previous instant is kept while it is within max_distance; the others are
    assigned by minimum total distance.
    """
    last: dict[str, str] = {}
    holds: dict[str, str] = {}
    errors: list[float] = []
    misses = false = switches = fragments = truths = 0
    was_tracked: dict[str, bool] = {}
    shared: dict[tuple[str, str], int] = {}
    found_count: dict[str, int] = {}
    for moment in moments:
        t, n = len(moment.truth_names), len(moment.estimate_labels)
        truths += t
        for label in moment.estimate_labels:
            found_count[label] = found_count.get(label, 0) + 1
        distance = np.linalg.norm(moment.truth[:, None] - moment.found[None], axis=2) if t and n else np.zeros((t, n))
        pairs: dict[int, int] = {}
        for i, name in enumerate(moment.truth_names):
            held = holds.get(name)
            if held is not None and held in moment.estimate_labels:
                j = moment.estimate_labels.index(held)
                if distance[i, j] < max_distance and j not in pairs.values():
                    pairs[i] = j
        rows = [i for i in range(t) if i not in pairs]
        columns = [j for j in range(n) if j not in pairs.values()]
        if rows and columns:
            part = distance[np.ix_(rows, columns)]
            a, b = linear_sum_assignment(np.where(part < max_distance, part, 1e6))
            pairs |= {rows[i]: columns[j] for i, j in zip(a, b, strict=True) if part[i, j] < max_distance}
        holds = {}
        for i, name in enumerate(moment.truth_names):
            if i not in pairs:
                misses += 1
                was_tracked[name] = False
                continue
            label = moment.estimate_labels[pairs[i]]
            if name in last and last[name] != label:
                switches += 1
            if was_tracked.get(name) is False and name in last:
                fragments += 1
            was_tracked[name], last[name], holds[name] = True, label, label
            errors.append(float(distance[i, pairs[i]]))
        false += n - len(pairs)
        for i in range(t):
            for j in range(n):
                if distance[i, j] < max_distance:
                    key = (moment.truth_names[i], moment.estimate_labels[j])
                    shared[key] = shared.get(key, 0) + 1
    matches = len(errors)
    return MotScores(
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
    """IDF1 = 2 IDTP / (truths + found), with a one-to-one assignment of names to labels over all instants."""
    if not shared or not truths + found:
        return 0.0
    names, labels = sorted({name for name, _ in shared}), sorted({label for _, label in shared})
    table = np.zeros((len(names), len(labels)))
    for (name, label), count in shared.items():
        table[names.index(name), labels.index(label)] = count
    rows, columns = linear_sum_assignment(-table)
    return float(2.0 * table[rows, columns].sum() / (truths + found))
