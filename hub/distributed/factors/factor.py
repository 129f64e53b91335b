"""What one camera has learnt about one neighbour from the targets that both saw (METHODS C, steps 2 and 3).

The first observations are kept raw and linearised again and again, where the network says that the neighbour stands
as soon as that agrees with them (the network knows better than one edge); later ones are streamed into the summary,
a quadratic about ``summary.anchor``. Memory is constant: at most ``RAW`` rows, then a few hundred bytes.

Both ends of an edge write it the same way, as the camera with the lower number sees the other. Were each to write it
in its own axes, the two would agree near the optimum only: far from it their stiff pulls are not those of one cost, and
a network that begins bent swings ever wider instead of relaxing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.distributed.factors.initialise import begin, gate_of, loss, refine, robust_weight, total
from hub.distributed.factors.linearise import Relative, Terms, linearise, stacked
from protocols.geometry.types import Floats

RAW = 96
"""Raw observations kept: 24 + 8 bytes each."""
_TRY_AT = (12, 18, 24, 36, 48, 72, *(96 * 2**n for n in range(12)))
_REFINE_AT = (24, 48, *(96 * 2**n for n in range(12)))
_MOST_TRIED = 400
"""Observations that a beginning looks at, spread over all."""
_TURN_STD, _CENTRE_STD = 0.05, 0.15
"""Most uncertain rotation [rad] and centre (share of its distance) with which an edge begins: a target that moves on
in a line for a second fits a family of poses."""
_AGREES = 20.0
"""Half chi2 (6 dof) up to which the network's prediction is taken for the place to linearise."""
_STREAM_AGREES = 8.0
"""The same for streamed observations, which are linearised once: a poor place would refuse good ones."""
_MOVED = 0.05
"""Chi2 by which the prediction may move before the raw observations are linearised anew."""
_LONGEST_STRIDE = 16
_SHARE_LOST = 0.45
_SHARE_MEMORY = 1.0 / 24.0
_MEMORY = 200_000.0
"""Observations after which the oldest count 1/e: nothing stands still for ever."""


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """Half chi2 of a relative pose about ``anchor``: ½ eᵀ hessian e + gradientᵀ e, e = anchor.step_to(pose).

    bearings: no sizes, so the length of ``centre`` is free: a pose is first rescaled to the anchor's. chi2: what the
    observations that count left over, 1 dof each, with sizes 3.
    """

    anchor: Relative
    hessian: Floats
    gradient: Floats
    count: float
    bearings: bool
    chi2: float = 0.0

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
        """How much half chi2 at ``pose`` lies above the minimum.

        Infinite on the other side of the camera: along a baseline of free length the quadratic tells nothing.
        """
        if self.bearings and float(self.anchor.centre @ pose.centre) <= 0.0:
            return float("inf")
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
        return Summary(pose, summary.hessian, gradient, summary.count, summary.bearings, summary.chi2)

    def _in_unit(self, factor: float) -> Summary:
        """Lengths times ``factor``: an exact rescaling (METHODS C, step 3)."""
        scale = np.array([1.0, 1.0, 1.0, 1.0 / factor, 1.0 / factor, 1.0 / factor])
        hessian = self.hessian * scale * scale[:, None]
        anchor = self.anchor.scaled(factor)
        return Summary(anchor, hessian, self.gradient * scale, self.count, self.bearings, self.chi2)


@dataclass(slots=True, eq=False)
class Window:
    """Robust sums of the latest observations about the network's prediction, for the test on bumps."""

    sums: Floats
    """(42,): Hessian (36) and gradient (6)."""
    count: int = 0

    @classmethod
    def empty(cls) -> Window:
        """Nothing seen yet."""
        return cls(np.zeros(42))

    @property
    def hessian(self) -> Floats:
        """(6, 6)."""
        return self.sums[:36].reshape(6, 6)

    @property
    def gradient(self) -> Floats:
        """(6,)."""
        return self.sums[36:]

    def add(self, sums: Floats, count: int) -> None:
        """Takes in the sums of a batch."""
        self.sums = self.sums + sums
        self.count += count


class Edge:
    """One neighbour's edge. ``add`` observations; then ``flush_raw``, or `stream` for those that keep none.

    seen_by: the neighbour has the lower number, so all is written as it sees this camera. raw: how many observations
    are kept raw. An edge that could not begin by then keeps every second, fourth, … of
    what comes, until they tell the pose.
    """

    def __init__(self, neighbour: int, rng: np.random.Generator, raw: int = RAW, *, seen_by: bool = False) -> None:
        self.neighbour = neighbour
        self.seen_by = seen_by
        self.raw = raw
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
        self._stride, self._skipped = 1, 0
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
        self._pending.append((*row[3:6], *row[0:3], *row[8:10], *row[6:8]) if self.seen_by else row)

    def from_here(self, pose: Relative) -> Relative:
        """The neighbour as this camera sees it, of a pose as the edge writes it."""
        return pose.inverse() if self.seen_by else pose

    def reset(self, *, badly: bool = False) -> None:
        """Forget everything: one of the cameras moved, or the edge began ``badly``: then look at a longer stretch."""
        stride = min(2 * self._stride, _LONGEST_STRIDE) if badly else 1
        self.__init__(self.neighbour, self._rng, self.raw, seen_by=self.seen_by)  # type: ignore[misc]
        self._stride = stride

    def resume(self, summary: Summary) -> None:
        """Goes on with what was learnt elsewhere."""
        self.summary, self.began, self._keeps_raw = summary, True, False

    def flush_raw(self, predicted: Relative | None) -> None:
        """Take the waiting observations in while they are kept raw. predicted: where the network sees the neighbour."""
        fresh = self.drain()
        if self._stride > 1:
            at = self._skipped + np.arange(len(fresh))
            self._skipped += len(fresh)
            fresh = fresh[at % self._stride == 0]
        if len(fresh):
            self._take_raw(fresh[:, :6], fresh[:, 6:])
        full = len(self._raw_rows) >= self.raw
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
        if self.seen_by:
            mine, theirs = theirs, mine
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
        inside = terms.ahead & (terms.chi2 < gate)
        # For the windows far residuals count with a bounded pull, so that outliers don't look like motion.
        near = np.minimum(1.0, gate / np.maximum(terms.chi2, 1e-12)) * terms.ahead
        count = len(inside)
        rows = np.concatenate([terms.hessian.reshape(count, 36), terms.gradient], axis=1)
        certain, bounded = np.array([inside, near]) @ rows
        taken = int(np.count_nonzero(inside))
        fade = max(0.0, 1.0 - count / _MEMORY)
        self.summary = Summary(
            summary.anchor,
            summary.hessian * fade + certain[:36].reshape(6, 6),
            summary.gradient * fade + certain[36:],
            summary.count * fade + taken,
            summary.bearings,
            summary.chi2 * fade + float(terms.chi2[inside].sum()),
        )
        self.short.add(bounded, count)
        self.long.add(bounded, count)
        # As if they had come one by one, in any order.
        self.share = taken / count + (self.share - taken / count) * (1.0 - _SHARE_MEMORY) ** count
        return self.share < _SHARE_LOST

    def linearise_again(self, predicted: Relative | None, *, spare: float = 0.0) -> None:
        """Raw observations only: the summary about the best pose known now.

        spare: share of new observations that may wait for the next time.
        """
        if not self._keeps_raw or not len(self._raw_rows):
            return
        if len(self._raw_rows) <= (1.0 + spare) * self._linearised and self._still_good(predicted):
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
        weight = robust_weight(terms, gate)
        bearings = not bool((weights[:, [1, 3]] > 0).any())
        chi2 = float((weight * terms.chi2)[terms.ahead].sum())
        self.summary = Summary(point, hessian, gradient, float(weight.sum()), bearings, chi2)

    def _still_good(self, predicted: Relative | None) -> bool:
        """Nothing new, and the network's prediction hardly moved against what the edge knows."""
        if self.summary is None:
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
        doubled = any(at in due for at in _REFINE_AT)
        if self.began and not doubled:
            return
        gate = gate_of(weights)
        candidates = []
        if self._own is not None and self.summary is not None:
            candidates.append(refine(self._own, rows, weights, self.summary.bearings))
        if self._own is None or doubled:
            # What fitted a short path may be wrong about a long one: each doubling is a chance to begin anew.
            pick = np.linspace(0, n - 1, min(n, _MOST_TRIED)).astype(np.int64)
            found = begin(rows[pick], weights[pick], self._rng)
            if found is not None and _well_told(found[0], rows, weights):
                candidates.append(found[0])
        if candidates:
            self._own = min(candidates, key=lambda pose: loss(linearise(pose, rows, weights), gate))
            self.began = True

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
        if self.summary is None:  # they tell no pose yet: spread what is kept over twice the time
            self._raw_rows, self._raw_weights = self._raw_rows[::2], self._raw_weights[::2]
            self._stride, self._skipped = 2 * self._stride, 0
            self._tried = len(self._raw_rows)
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


def _well_told(pose: Relative, rows: Floats, weights: Floats) -> bool:
    """Whether the observations fix the pose: rotation, and centre (with bearings only its direction)."""
    hessian, _ = total(linearise(pose, rows, weights), gate_of(weights))
    length = max(float(np.linalg.norm(pose.centre)), 1e-12)
    along = np.concatenate([np.zeros(3), pose.centre / length])
    if not (weights[:, [1, 3]] > 0).any():
        hessian = hessian + np.outer(along, along) / length**2  # the distance is free: as good as known to itself
    scale = np.array([1.0, 1.0, 1.0, length, length, length])
    values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
    spread = vectors / np.sqrt(np.maximum(values, 1e-12))
    if not (weights[:, [1, 3]] > 0).any():
        spread[3:] -= np.outer(along[3:], along[3:] @ spread[3:])
    turn, centre = np.linalg.norm(spread[:3], ord=2), np.linalg.norm(spread[3:], ord=2)
    return bool(turn < _TURN_STD and centre < _CENTRE_STD)


def _solve(hessian: Floats, right: Floats) -> Floats:
    """Solution of a positive semidefinite system (6, 6); directions without information get about 0."""
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    normalised = hessian * scale * scale[:, None]
    normalised.flat[::7] += 1e-7
    return np.asarray(scale * np.linalg.solve(normalised, scale * right))
