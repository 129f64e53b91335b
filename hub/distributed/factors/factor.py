"""Relative-pose factor between two cameras, accumulated from shared observations (distributed pose paper, steps 2, 3).

The first observations are kept raw and relinearised repeatedly, at the relative pose that the network predicts as soon
as that agrees with them (the network is more accurate than one edge). Later ones are streamed into the factor, a
quadratic about ``factor.anchor``. Memory is constant: at most ``RAW_CAPACITY`` rows, then a few hundred bytes.

Both ends of an edge use the same parametrisation: the pose of the camera with the higher number, seen from the one with
the lower number. With each end in its own axes the two quadratics would agree near the optimum only; far from it their
gradients are not those of one cost, and a network with a distorted initial shape would diverge instead of relaxing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from hub.distributed.factors.initialise import (
    chi2_gates,
    estimate_relative_pose,
    refine,
    robust_cost,
    robust_sums,
    robust_weight,
)
from hub.distributed.factors.two_view_model import (
    LinearisedObservations,
    RelativeTransform,
    linearise_observations,
    stack_transforms,
)
from protocols.geometry.types import Floats

RAW_CAPACITY = 96
"""Raw observations kept: 24 + 8 bytes each."""
_INITIALISE_AT = (12, 18, 24, 36, 48, 72, *(96 * 2**n for n in range(12)))
_REFINE_AT = (24, 48, *(96 * 2**n for n in range(12)))
_MAX_INITIALISATION_ROWS = 400
"""Most observations used for an initialisation, evenly spaced over all."""
_MAX_ROTATION_STD, _MAX_CENTRE_STD = 0.05, 0.15
"""Largest std of rotation [rad] and centre (share of its distance) with which an edge is initialised: a target that
moves along a line for a second fits a family of poses."""
_MAX_COST_INCREASE = 20.0
"""Increase of half chi2 (6 dof) up to which the network's prediction is used as linearisation point."""
_MAX_STREAM_EXCESS = 8.0
"""The same for streamed observations, which are linearised once: a poor point would reject good ones."""
_RELINEARISE_CHI2 = 0.05
"""Chi2 by which the prediction may move before the raw observations are relinearised."""
_MAX_STRIDE = 16  # of frames, where the pose hardly changes
_MIN_INLIER_RATE = 0.45  # below it the neighbour's pose is not trusted
_INLIER_RATE_GAIN = 1.0 / 24.0  # of the running mean: over 24 observations
_MEMORY_LENGTH = 200_000.0
"""Observations after which the weight of the oldest has decayed to 1/e, for slow drift."""


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticFactor:
    """Half chi2 of a relative pose about ``anchor``: ½ eᵀ hessian e + gradientᵀ e, e = anchor.local_coordinates(pose).

    count: effective number of inlier observations. bearings: no sizes, so the length of ``centre`` is free and a pose
    is first rescaled to the anchor's. chi2: residual sum of squares of the inliers, 1 dof each, with sizes 3.
    """

    anchor: RelativeTransform
    hessian: Floats
    gradient: Floats
    count: float
    bearings: bool
    chi2: float = 0.0

    def local_coordinates(self, pose: RelativeTransform) -> Floats:
        """e (6,) of a pose."""
        return self.anchor.local_coordinates(self.rescaled(pose))

    def rescaled(self, pose: RelativeTransform) -> RelativeTransform:
        """The pose scaled to the anchor's baseline length if the scale is free."""
        if not self.bearings:
            return pose
        unit = float(np.linalg.norm(self.anchor.centre)) / max(float(np.linalg.norm(pose.centre)), 1e-12)
        return pose.scaled(unit)

    def newton_step(self) -> Floats:
        """Step (6,) from the anchor to the minimum; 0 in directions without information."""
        return _solve_semidefinite(self.hessian, -self.gradient)

    def excess_cost(self, pose: RelativeTransform) -> float:
        """Half chi2 at ``pose`` above the minimum.

        Infinite for a baseline in the opposite direction, which the quadratic with free length cannot distinguish.
        """
        if self.bearings and float(self.anchor.centre @ pose.centre) <= 0.0:
            return float("inf")
        step, best = self.local_coordinates(pose), self.newton_step()
        difference = step - best
        return 0.5 * float(difference @ self.hessian @ difference)

    def reanchored(self, pose: RelativeTransform) -> QuadraticFactor:
        """The same quadratic about another pose."""
        factor = self
        if self.bearings:
            unit = float(np.linalg.norm(pose.centre)) / max(float(np.linalg.norm(self.anchor.centre)), 1e-12)
            factor = self._in_unit(unit)
        step = factor.anchor.local_coordinates(pose)
        gradient = factor.gradient + factor.hessian @ step
        return QuadraticFactor(pose, factor.hessian, gradient, factor.count, factor.bearings, factor.chi2)

    def _in_unit(self, unit: float) -> QuadraticFactor:
        """Lengths times ``unit``: an exact rescaling (distributed pose paper, step 3)."""
        scale = np.array([1.0, 1.0, 1.0, 1.0 / unit, 1.0 / unit, 1.0 / unit])
        hessian = self.hessian * scale * scale[:, None]
        anchor = self.anchor.scaled(unit)
        return QuadraticFactor(anchor, hessian, self.gradient * scale, self.count, self.bearings, self.chi2)


@dataclass(slots=True, eq=False)
class Window:
    """Robust sums of the latest observations about the network's prediction, for the moved-camera test."""

    sums: Floats
    """(42,): Hessian (36) and gradient (6)."""
    count: int = 0

    @classmethod
    def empty(cls) -> Window:
        """No observations yet."""
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
        """Add the sums of a batch."""
        self.sums = self.sums + sums
        self.count += count


class Edge:
    """Accumulates one neighbour's factor. ``add`` observations; then ``flush_raw``, or `stream_pending` once streaming.

    reverse: the neighbour has the lower number, so the factor describes this camera as seen by the neighbour. raw:
    number of observations kept raw. An edge that is not initialised by then keeps every second, fourth, … of the
    following ones until they determine the pose.
    """

    def __init__(
        self, neighbour: int, rng: np.random.Generator, raw: int = RAW_CAPACITY, *, reverse: bool = False
    ) -> None:
        self.neighbour = neighbour
        self.reverse = reverse
        self.raw = raw
        self.factor: QuadraticFactor | None = None
        self.initialised = False
        self._own_estimate: RelativeTransform | None = None
        self.short_window, self.long_window = Window.empty(), Window.empty()
        self.inlier_rate = 1.0
        self._rng = rng
        self._raw_rows = np.zeros((0, 6), np.float32)
        self._raw_weights = np.zeros((0, 4), np.float16)
        self._pending: list[tuple[float, ...]] = []
        self._keeps_raw = True
        self._last_attempt = 0
        self._linearised = 0
        self._prediction_rejected = False
        self._stride, self._skipped = 1, 0
        self.contradictions = 0

    @property
    def observation_count(self) -> int:
        """Number of inlier observations."""
        return int(self.factor.count) if self.factor is not None else len(self._raw_rows)

    @property
    def streaming(self) -> bool:
        """Whether raw observations are no longer kept."""
        return not self._keeps_raw

    @property
    def pending(self) -> int:
        """Observations not yet flushed."""
        return len(self._pending)

    @property
    def state_bytes(self) -> int:
        """Bytes of data stored."""
        raw = self._raw_rows.nbytes + self._raw_weights.nbytes + 80 * len(self._pending)
        factor = 8 * (9 + 3 + 21 + 6 + 1) if self.factor is not None else 0
        return raw + factor + 2 * 8 * (21 + 6 + 1)

    def add(self, row: tuple[float, ...]) -> None:
        """Add a row of 10: x, y, log size in this camera and in the neighbour; then the four weights."""
        x, y, s, u, v, w, a, b, c, d = row
        self._pending.append((u, v, w, x, y, s, c, d, a, b) if self.reverse else row)

    def neighbour_from_own(self, pose: RelativeTransform) -> RelativeTransform:
        """The neighbour relative to this camera, from a pose in the factor's parametrisation."""
        return pose.inverse() if self.reverse else pose

    def reset(self, *, failed: bool = False) -> None:
        """Discard everything: one of the cameras moved, or initialisation ``failed``: then cover a longer time span."""
        stride = min(2 * self._stride, _MAX_STRIDE) if failed else 1
        self.__init__(self.neighbour, self._rng, self.raw, reverse=self.reverse)  # type: ignore[misc]
        self._stride = stride

    def resume(self, factor: QuadraticFactor) -> None:
        """Continue with a factor accumulated by another host."""
        self.factor, self.initialised, self._keeps_raw = factor, True, False

    def flush_raw(self, predicted: RelativeTransform | None) -> None:
        """Take in pending observations while raw ones are kept. predicted: relative pose predicted by the network."""
        fresh = self.drain()
        if self._stride > 1:
            at = self._skipped + np.arange(len(fresh))
            self._skipped += len(fresh)
            fresh = fresh[at % self._stride == 0]
        if len(fresh):
            self._take_raw(fresh[:, :6], fresh[:, 6:])
        full = len(self._raw_rows) >= self.raw
        if full or len(self._raw_rows) >= 1.2 * self._linearised or len(self._raw_rows) in _INITIALISE_AT:
            self.relinearise(predicted)
        if full:
            self._drop_raw()

    def drain(self) -> Floats:
        """Return the pending observations (n, 10) and clear them."""
        fresh = np.fromiter(chain.from_iterable(self._pending), float, 10 * len(self._pending)).reshape(-1, 10)
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
        if self.reverse:
            mine, theirs = theirs, mine
        return mine, theirs, np.hypot(own, other)

    def reanchor(self, predicted: RelativeTransform | None) -> RelativeTransform:
        """Move the factor's anchor to the best known pose, the linearisation point of the next observations."""
        factor = self.factor
        assert factor is not None
        if predicted is not None and factor.excess_cost(predicted) < _MAX_STREAM_EXCESS:
            point = predicted
        else:
            point = factor.anchor.retract(factor.newton_step())
        self.factor = factor.reanchored(point)
        return point

    def accumulate(self, terms: LinearisedObservations, gate: Floats) -> bool:
        """Add a batch to the factor, linearised at the point of `reanchor`; outliers are rejected.

        Returns whether most of the latest were outliers: a wrong initialisation, or a moved camera.
        """
        factor = self.factor
        assert factor is not None
        inlier = terms.in_front & (terms.chi2 < gate)
        # In the windows outliers have a bounded gradient, so that they do not look like motion.
        bounded_weight = np.minimum(1.0, gate / np.maximum(terms.chi2, 1e-12)) * terms.in_front
        count = len(inlier)
        rows = np.concatenate([terms.hessian.reshape(count, 36), terms.gradient], axis=1)
        inlier_sums, bounded_sums = np.array([inlier, bounded_weight]) @ rows
        inlier_count = int(np.count_nonzero(inlier))
        fade = max(0.0, 1.0 - count / _MEMORY_LENGTH)
        self.factor = QuadraticFactor(
            factor.anchor,
            factor.hessian * fade + inlier_sums[:36].reshape(6, 6),
            factor.gradient * fade + inlier_sums[36:],
            factor.count * fade + inlier_count,
            factor.bearings,
            factor.chi2 * fade + float(terms.chi2[inlier].sum()),
        )
        self.short_window.add(bounded_sums, count)
        self.long_window.add(bounded_sums, count)
        # Equivalent to one update per observation, in any order.
        self.inlier_rate = (
            inlier_count / count + (self.inlier_rate - inlier_count / count) * (1.0 - _INLIER_RATE_GAIN) ** count
        )
        return self.inlier_rate < _MIN_INLIER_RATE

    def relinearise(self, predicted: RelativeTransform | None, *, spare: float = 0.0) -> None:
        """Rebuild the factor from the raw observations at the best known pose, while they are kept.

        spare: share of new observations that may wait for the next relinearisation.
        """
        if not self._keeps_raw or not len(self._raw_rows):
            return
        if len(self._raw_rows) <= (1.0 + spare) * self._linearised and self._is_current(predicted):
            return
        rows, weights = self._raw_observations()
        self._linearised = len(rows)
        self._try_to_initialise(rows, weights)
        point = self._linearisation_point(rows, weights, predicted)
        if point is None:
            self.factor = None
            return
        gate = chi2_gates(weights)
        terms = linearise_observations(point, rows, weights)
        hessian, gradient = robust_sums(terms, gate)
        weight = robust_weight(terms, gate)
        bearings = not bool((weights[:, [1, 3]] > 0).any())
        chi2 = float((weight * terms.chi2)[terms.in_front].sum())
        self.factor = QuadraticFactor(point, hessian, gradient, float(weight.sum()), bearings, chi2)

    def _is_current(self, predicted: RelativeTransform | None) -> bool:
        """Whether the network's prediction has hardly moved relative to the factor's information."""
        if self.factor is None:
            return False
        if predicted is None:
            return True
        step = self.factor.local_coordinates(predicted)
        moved = float(step @ self.factor.hessian @ step)
        # With a rejected prediction and the edge at its own optimum, test again only when the two are closer.
        return moved < _RELINEARISE_CHI2 or (self._prediction_rejected and moved > 4.0 * _MAX_COST_INCREASE)

    def _raw_observations(self) -> tuple[Floats, Floats]:
        return self._raw_rows.astype(np.float64), self._raw_weights.astype(np.float64)

    def _take_raw(self, rows: Floats, weights: Floats) -> None:
        self._raw_rows = np.concatenate([self._raw_rows, rows.astype(np.float32)])
        self._raw_weights = np.concatenate([self._raw_weights, weights.astype(np.float16)])

    def _try_to_initialise(self, rows: Floats, weights: Floats) -> None:
        n = len(rows)
        due = [at for at in _INITIALISE_AT if self._last_attempt < at <= n]
        if not due:
            return
        self._last_attempt = due[-1]
        doubled = any(at in due for at in _REFINE_AT)
        if self.initialised and not doubled:
            return
        gate = chi2_gates(weights)
        candidates = []
        if self._own_estimate is not None and self.factor is not None:
            candidates.append(refine(self._own_estimate, rows, weights, self.factor.bearings))
        if self._own_estimate is None or doubled:
            # A pose that fits a short path may not fit a long one: each doubling allows a new initialisation.
            pick = np.linspace(0, n - 1, min(n, _MAX_INITIALISATION_ROWS)).astype(np.int64)
            found = estimate_relative_pose(rows[pick], weights[pick], self._rng)
            if found is not None and _is_well_determined(found[0], rows, weights):
                candidates.append(found[0])
        if candidates:
            self._own_estimate = min(
                candidates, key=lambda pose: robust_cost(linearise_observations(pose, rows, weights), gate)
            )
            self.initialised = True

    def _linearisation_point(
        self, rows: Floats, weights: Floats, predicted: RelativeTransform | None
    ) -> RelativeTransform | None:
        """The network's prediction, unless the edge's own observations contradict it."""
        if self._own_estimate is None:
            return predicted
        if predicted is None:
            return self._own_estimate
        gate = chi2_gates(weights)
        there = robust_cost(linearise_observations(predicted, rows, weights), gate)
        here = robust_cost(linearise_observations(self._own_estimate, rows, weights), gate)
        self._prediction_rejected = there - here >= _MAX_COST_INCREASE
        return self._own_estimate if self._prediction_rejected else predicted

    def _drop_raw(self) -> None:
        if self.factor is None:  # the pose is not determined yet: spread the kept rows over twice the time
            self._raw_rows, self._raw_weights = self._raw_rows[::2], self._raw_weights[::2]
            self._stride, self._skipped = 2 * self._stride, 0
            self._last_attempt = len(self._raw_rows)
            return
        self._keeps_raw = False
        self._raw_rows, self._raw_weights = self._raw_rows[:0], self._raw_weights[:0]


def stream_pending(edges: list[tuple[Edge, RelativeTransform | None]]) -> list[Edge]:
    """Accumulate the pending observations of many edges at once; each edge comes with the network's prediction.

    Returns the edges that reject most of their observations.
    """
    edges = [(edge, predicted) for edge, predicted in edges if edge.pending]
    if not edges:
        return []
    counts = [edge.pending for edge, _ in edges]
    points = [edge.reanchor(predicted) for edge, predicted in edges]
    fresh = np.concatenate([edge.drain() for edge, _ in edges])
    weights = fresh[:, 6:]
    terms = linearise_observations(stack_transforms(points, counts), fresh[:, :6], weights)
    gate = chi2_gates(weights)
    bad, at = [], 0
    for (edge, _), count in zip(edges, counts, strict=True):
        part = slice(at, at + count)
        mine = LinearisedObservations(terms.hessian[part], terms.gradient[part], terms.chi2[part], terms.in_front[part])
        if edge.accumulate(mine, gate[part]):
            bad.append(edge)
        at += count
    return bad


def _is_well_determined(pose: RelativeTransform, rows: Floats, weights: Floats) -> bool:
    """Whether the observations determine the pose: rotation, and centre (with bearings only its direction)."""
    hessian, _ = robust_sums(linearise_observations(pose, rows, weights), chi2_gates(weights))
    length = max(float(np.linalg.norm(pose.centre)), 1e-12)
    along = np.concatenate([np.zeros(3), pose.centre / length])
    if not (weights[:, [1, 3]] > 0).any():
        hessian = hessian + np.outer(along, along) / length**2  # the length of the baseline is free: regularise it
    scale = np.array([1.0, 1.0, 1.0, length, length, length])
    values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
    spread = vectors / np.sqrt(np.maximum(values, 1e-12))
    if not (weights[:, [1, 3]] > 0).any():
        spread[3:] -= np.outer(along[3:], along[3:] @ spread[3:])
    turn, centre = np.linalg.norm(spread[:3], ord=2), np.linalg.norm(spread[3:], ord=2)
    return bool(turn < _MAX_ROTATION_STD and centre < _MAX_CENTRE_STD)


def _solve_semidefinite(hessian: Floats, right: Floats) -> Floats:
    """Solution of a positive semidefinite system (6, 6); about 0 in directions without information."""
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    normalised = hessian * scale * scale[:, None]
    normalised.flat[::7] += 1e-7
    return np.asarray(scale * np.linalg.solve(normalised, scale * right))
