"""What one camera has learnt about one neighbour from the targets that both saw (METHODS C, steps 2 and 3).

The first observations are kept raw and linearised again and again, where the network says that the neighbour stands
as soon as that agrees with them (the network knows better than one edge); later ones are streamed into the summary,
a quadratic about ``summary.anchor``. Memory is constant: at most ``RAW`` rows, then a few hundred bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.nodes.begin import begin, gate_of, loss, refine, robust_weight, total
from hub.nodes.two_cameras import Relative, Terms, linearise, stacked
from protocols.geometry.types import Floats

RAW = 96
"""Raw observations kept: 24 + 8 bytes each."""
_TRY_AT = (12, 18, 24, 36, 48, 72, RAW)
_REFINE_AT = (24, 48, RAW)
_AGREES = 20.0
"""Half chi2 (6 dof) up to which the network's prediction is taken for the place to linearise."""
_STREAM_AGREES = 8.0
"""The same for streamed observations, which are linearised once: a poor place would refuse good ones."""
_MOVED = 0.05
"""Chi2 by which the prediction may move before the raw observations are linearised anew."""
_SHARE_LOST = 0.45
_SHARE_MEMORY = 1.0 / 24.0
_MEMORY = 200_000.0
"""Observations after which the oldest count 1/e: nothing stands still for ever."""


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """Half chi2 of a relative pose about ``anchor``: ½ eᵀ hessian e + gradientᵀ e, e = anchor.step_to(pose).

    bearings: no sizes, so the length of ``centre`` is free: a pose is first rescaled to the anchor's.
    """

    anchor: Relative
    hessian: Floats
    gradient: Floats
    count: float
    bearings: bool

    def step_to(self, pose: Relative) -> Floats:
        """e (6,) of a pose."""
        return self.anchor.step_to(self.rescaled(pose))

    def rescaled(self, pose: Relative) -> Relative:
        """The pose in the anchor's unit if the unit is free."""
        if not self.bearings:
            return pose
        factor = float(np.linalg.norm(self.anchor.centre)) / max(float(np.linalg.norm(pose.centre)), 1e-12)
        return pose.scaled(factor)

    def best_step(self) -> Floats:
        """From the anchor to the minimum (6,); directions without information stay."""
        return _solve(self.hessian, -self.gradient)

    def excess(self, pose: Relative) -> float:
        """How much half chi2 at ``pose`` lies above the minimum."""
        step, best = self.step_to(pose), self.best_step()
        apart = step - best
        return 0.5 * float(apart @ self.hessian @ apart)

    def reanchored(self, pose: Relative) -> Summary:
        """The same quadratic about another pose."""
        summary = self
        if self.bearings:
            factor = float(np.linalg.norm(pose.centre)) / max(float(np.linalg.norm(self.anchor.centre)), 1e-12)
            summary = self._in_unit(factor)
        step = summary.anchor.step_to(pose)
        gradient = summary.gradient + summary.hessian @ step
        return Summary(pose, summary.hessian, gradient, summary.count, summary.bearings)

    def _in_unit(self, factor: float) -> Summary:
        """Lengths times ``factor``: an exact rescaling (METHODS C, step 3)."""
        scale = np.array([1.0, 1.0, 1.0, 1.0 / factor, 1.0 / factor, 1.0 / factor])
        hessian = self.hessian * scale * scale[:, None]
        return Summary(self.anchor.scaled(factor), hessian, self.gradient * scale, self.count, self.bearings)


@dataclass(slots=True, eq=False)
class Window:
    """Robust sums of the latest observations about the network's prediction, for the test on bumps."""

    hessian: Floats
    gradient: Floats
    count: int = 0

    @classmethod
    def empty(cls) -> Window:
        """Nothing seen yet."""
        return cls(np.zeros((6, 6)), np.zeros(6))

    def add(self, terms: Terms, gate: Floats) -> None:
        """Takes in a batch; far residuals count with a bounded pull, so that outliers don't look like motion."""
        weight = np.where(terms.ahead, np.minimum(1.0, gate / np.maximum(terms.chi2, 1e-12)), 0.0)
        self.hessian = self.hessian + (weight @ terms.hessian.reshape(-1, 36)).reshape(6, 6)
        self.gradient = self.gradient + weight @ terms.gradient
        self.count += len(weight)


class Edge:
    """One neighbour's edge. ``add`` observations; then ``flush_raw``, or `stream` for those that keep none."""

    def __init__(self, neighbour: int, rng: np.random.Generator) -> None:
        self.neighbour = neighbour
        self.summary: Summary | None = None
        self.began = False
        self._own: Relative | None = None
        self.short, self.long = Window.empty(), Window.empty()
        self.share = 1.0
        self._rng = rng
        self._raw_rows = np.zeros((0, 6), np.float32)
        self._raw_weights = np.zeros((0, 4), np.float16)
        self._pending: list[tuple[float, ...]] = []
        self._keeps_raw = True
        self._tried = 0
        self._linearised = 0
        self._refused = False
        self.contradictions = 0

    @property
    def seen(self) -> int:
        """Observations that count."""
        return int(self.summary.count) if self.summary is not None else len(self._raw_rows)

    @property
    def streaming(self) -> bool:
        """Whether the raw observations are gone."""
        return not self._keeps_raw

    @property
    def waiting(self) -> int:
        """Observations not yet flushed."""
        return len(self._pending)

    @property
    def state_bytes(self) -> int:
        """Bytes of data held."""
        raw = self._raw_rows.nbytes + self._raw_weights.nbytes + 80 * len(self._pending)
        summary = 8 * (9 + 3 + 21 + 6 + 1) if self.summary is not None else 0
        return raw + summary + 2 * 8 * (21 + 6 + 1)

    def add(self, row: tuple[float, ...]) -> None:
        """A row of 10: x, y, log size in this camera and in the neighbour; then the four weights."""
        self._pending.append(row)

    def reset(self) -> None:
        """Forget everything: one of the cameras moved, or the edge began badly."""
        self.__init__(self.neighbour, self._rng)  # type: ignore[misc]

    def flush_raw(self, predicted: Relative | None) -> None:
        """Take the waiting observations in while they are kept raw. predicted: where the network sees the neighbour."""
        fresh = self.drain()
        if len(fresh):
            self._take_raw(fresh[:, :6], fresh[:, 6:])
        full = len(self._raw_rows) >= RAW
        if full or len(self._raw_rows) >= 1.2 * self._linearised or len(self._raw_rows) in _TRY_AT:
            self.linearise_again(predicted)
        if full:
            self._drop_raw()

    def drain(self) -> Floats:
        """The waiting observations (n, 10); none wait any more."""
        fresh = np.array(self._pending).reshape(-1, 10)
        self._pending.clear()
        return fresh

    def points(self) -> tuple[Floats, Floats, Floats]:
        """Raw observations with sizes as points in this camera's and in the neighbour's axes (n, 3), and std (n,)."""
        rows, weights = self._raw_observations()
        sized = (weights[:, 1] > 0) & (weights[:, 3] > 0)
        rows, weights = rows[sized], weights[sized]
        ones = np.ones((len(rows), 1))
        mine = np.concatenate([rows[:, 0:2], ones], axis=1) * np.exp(-rows[:, 2:3])
        theirs = np.concatenate([rows[:, 3:5], ones], axis=1) * np.exp(-rows[:, 5:6])
        own, other = np.linalg.norm(mine, axis=1) / weights[:, 1], np.linalg.norm(theirs, axis=1) / weights[:, 3]
        return mine, theirs, np.hypot(own, other)

    def aim(self, predicted: Relative | None) -> Relative:
        """Moves the summary's anchor to the best pose known, where the next observations are to be linearised."""
        summary = self.summary
        assert summary is not None
        if predicted is not None and summary.excess(predicted) < _STREAM_AGREES:
            point = predicted
        else:
            point = summary.anchor.moved(summary.best_step())
        self.summary = summary.reanchored(point)
        return point

    def absorb(self, terms: Terms, gate: Floats) -> bool:
        """Takes a batch into the summary, linearised where `aim` said; far ones are refused.

        Returns whether most of the latest were: the edge began badly, or a camera moved.
        """
        summary = self.summary
        assert summary is not None
        inside = (terms.ahead & (terms.chi2 < gate)).astype(np.float64)
        fade = max(0.0, 1.0 - len(inside) / _MEMORY)
        self.summary = Summary(
            summary.anchor,
            summary.hessian * fade + (inside @ terms.hessian.reshape(-1, 36)).reshape(6, 6),
            summary.gradient * fade + inside @ terms.gradient,
            summary.count * fade + float(inside.sum()),
            summary.bearings,
        )
        self.short.add(terms, gate)
        self.long.add(terms, gate)
        for good in inside:
            self.share += (float(good) - self.share) * _SHARE_MEMORY
        return self.share < _SHARE_LOST

    def linearise_again(self, predicted: Relative | None) -> None:
        """Raw observations only: the summary about the best pose known now."""
        if not self._keeps_raw or not len(self._raw_rows):
            return
        if self._still_good(predicted):
            return
        rows, weights = self._raw_observations()
        self._linearised = len(rows)
        self._try_to_begin(rows, weights)
        point = self._where(rows, weights, predicted)
        if point is None:
            self.summary = None
            return
        gate = gate_of(weights)
        terms = linearise(point, rows, weights)
        hessian, gradient = total(terms, gate)
        count = float(robust_weight(terms, gate).sum())
        self.summary = Summary(point, hessian, gradient, count, not bool((weights[:, [1, 3]] > 0).any()))

    def _still_good(self, predicted: Relative | None) -> bool:
        """Nothing new, and the network's prediction hardly moved against what the edge knows."""
        if self.summary is None or self._linearised != len(self._raw_rows):
            return False
        if predicted is None:
            return True
        step = self.summary.step_to(predicted)
        moved = float(step @ self.summary.hessian @ step)
        # Contradicted and standing at its own optimum, it need not be judged again before the two are closer.
        return moved < _MOVED or (self._refused and moved > 4.0 * _AGREES)

    def _raw_observations(self) -> tuple[Floats, Floats]:
        return self._raw_rows.astype(np.float64), self._raw_weights.astype(np.float64)

    def _take_raw(self, rows: Floats, weights: Floats) -> None:
        self._raw_rows = np.concatenate([self._raw_rows, rows.astype(np.float32)])
        self._raw_weights = np.concatenate([self._raw_weights, weights.astype(np.float16)])

    def _try_to_begin(self, rows: Floats, weights: Floats) -> None:
        n = len(rows)
        due = [at for at in _TRY_AT if self._tried < at <= n]
        if not due:
            return
        self._tried = due[-1]
        if self.began and not any(at in due for at in _REFINE_AT):
            return
        if self._own is not None and self.summary is not None:
            self._own = refine(self._own, rows, weights, self.summary.bearings)
            return
        found = begin(rows, weights, self._rng)
        if found is not None:
            self._own, self.began = found[0], True

    def _where(self, rows: Floats, weights: Floats, predicted: Relative | None) -> Relative | None:
        """The pose to linearise about: the network's unless the edge's own observations contradict it."""
        if self._own is None:
            return predicted
        if predicted is None:
            return self._own
        gate = gate_of(weights)
        there = loss(linearise(predicted, rows, weights), gate)
        here = loss(linearise(self._own, rows, weights), gate)
        self._refused = there - here >= _AGREES
        return self._own if self._refused else predicted

    def _drop_raw(self) -> None:
        if self.summary is None:  # they agree on nothing: keep the later half
            self._raw_rows, self._raw_weights = self._raw_rows[RAW // 2 :], self._raw_weights[RAW // 2 :]
            self._tried = 0
            return
        self._keeps_raw = False
        self._raw_rows, self._raw_weights = self._raw_rows[:0], self._raw_weights[:0]


def stream(edges: list[tuple[Edge, Relative | None]]) -> list[Edge]:
    """Takes the waiting observations of many edges in at once. Each comes with the network's prediction.

    Returns the edges that refuse most of what they see.
    """
    edges = [(edge, predicted) for edge, predicted in edges if edge.waiting]
    if not edges:
        return []
    counts = [edge.waiting for edge, _ in edges]
    points = [edge.aim(predicted) for edge, predicted in edges]
    fresh = np.concatenate([edge.drain() for edge, _ in edges])
    weights = fresh[:, 6:]
    terms = linearise(stacked(points, counts), fresh[:, :6], weights)
    gate = gate_of(weights)
    bad, at = [], 0
    for (edge, _), count in zip(edges, counts, strict=True):
        part = slice(at, at + count)
        mine = Terms(terms.hessian[part], terms.gradient[part], terms.chi2[part], terms.ahead[part])
        if edge.absorb(mine, gate[part]):
            bad.append(edge)
        at += count
    return bad


def _solve(hessian: Floats, right: Floats) -> Floats:
    """Solution of a positive semidefinite system (6, 6); directions without information get about 0."""
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    normalised = hessian * scale * scale[:, None]
    normalised.flat[::7] += 1e-7
    return np.asarray(scale * np.linalg.solve(normalised, scale * right))
