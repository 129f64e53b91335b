"""Bundle adjustment by generalised least squares: measurement noise is white noise plus a Gauss-Markov process.

Ordinary least squares treats a thousand rows with correlated errors as a thousand independent ones, which biases clocks
and lenses. Here each camera, label and image axis has a correlated error: piecewise linear between knots, with the
prior of its Gauss-Markov process (`gauss_markov`). Only the remainder counts as a row's independent noise. Trajectories
and correlated errors, in order of time, form one banded system; poses, clocks and lenses are its border.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.adjustment import apply_step, gauge
from hub.bundle.block_matrix import BlockSum, ParameterCovariance
from hub.bundle.bordered_system import PathBlocks, add_row_sums, add_rows
from hub.bundle.covariance import constrained_step
from hub.bundle.datum.gauge import ControlPointTerms
from hub.bundle.noise.gauss_markov import GaussMarkov
from hub.bundle.normal_equations import camera_priors, prior_terms
from hub.bundle.problem import (
    CAMERA_PARAMETERS,
    AdjustmentState,
    CorrelatedNoise,
    Problem,
    TrackObservations,
    UsedRows,
)
from hub.bundle.residuals import evaluate_residuals, jacobians
from hub.bundle.smoothness_prior import SmoothnessPrior, smoothness_cost, smoothness_terms
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SUPPORT, cho_solve_banded, cholesky_banded
from protocols.geometry.types import Floats, Ints

_KNOTS_PER_TIME_CONSTANT, _MIN_KNOTS_PER_TIME_CONSTANT = 8.0, 2.0  # of a correlated error, per time constant
_MAX_BRIDGE_VARIANCE = 0.01  # of the white noise: what a correlated error does between two knots without being missed
_MAX_KNOT_SPACING_S = 5.0  # between two knots: unknowns that one row couples must be close together in the band
_MAX_KNOTS = 15_000  # bounds time and memory
_MAX_ROWS = 150_000  # the same
_MAX_ITERATIONS = 40  # a bound: it stops where a step gains nothing
_HALVINGS = 5  # of a step that does not lower the cost
_GROSS_ERROR_COST = 100.0**2  # of a row off the trajectory: a hundred sigma
_ON_CONSTRAINTS = 1e-9  # rig units or rad: what rounding leaves
_RELATIVE_TOLERANCE = 1e-5  # relative decrease of the cost at convergence


@dataclass(frozen=True, slots=True, eq=False)
class GlsSolution:
    """The optimum. cost: minus twice the logarithm of likelihood times priors, up to a constant.

    free: (p, p) covariance of the free columns of the camera parameters, zero along the gauge.
    """

    state: AdjustmentState
    cost: float
    free: ParameterCovariance


@dataclass(frozen=True, slots=True, eq=False)
class _NoiseBlock:
    """Used rows (n,) of one camera and label, and the knots (m,) of their correlated error.

    knots: on the camera's clock [s]. interval: (n,) index of the knot before each row. knot_weights: (n, 2) weights of
    that knot and the next one in a row's error. precision: (2, m) upper band of the process. factor: Cholesky band of
    that precision plus the rows' information. white_information: information of a row's white noise [1/px²].
    """

    rows: TrackObservations
    knots: Floats
    interval: Ints
    knot_weights: Floats
    precision: Floats
    factor: Floats
    white_information: Floats

    def knot_sums(self, values: Floats) -> Floats:
        """(m, k) what values (n, k) of the rows come to at the knots."""
        out = np.zeros((len(self.knots), values.shape[1]))
        add_row_sums(out, self.knot_weights, self.interval[:, None] + np.arange(2), values)
        return out


def solve_gls(
    problem: Problem,
    state: AdjustmentState,
    prior: SmoothnessPrior,
    noise: CorrelatedNoise,
    control_terms: Callable[[AdjustmentState], ControlPointTerms] | None = None,
    constraints: Callable[[AdjustmentState], tuple[Floats, Floats]] | None = None,
) -> GlsSolution:
    """Gauss-Newton with step halving from a state near the optimum, over the rows in use.

    control_terms, constraints: normal equations of the control points with a std at a state, and constraints (rows,
    values; see `covariance.constrained_step`) of the others and of the gauge; without them the gauge is fixed
    (`adjustment.gauge`). Rows that are off the trajectory at ``state``, and a camera's only row of a label, are
    left out. Stops after forty steps at the latest. Raises LinAlgError where the rows do not determine a trajectory.
    """
    problem = _on_trajectory(problem, state)
    parts = _noise_blocks(problem, noise)
    cost = _cost(problem, state, prior, parts, control_terms)
    for _ in range(_MAX_ITERATIONS):
        path, cameras, free, must = _step(problem, state, prior, parts, control_terms, constraints)
        if must:  # a state off the constraints has to move onto them, whatever that costs
            state = apply_step(problem, state, path, cameras)
            cost = _cost(problem, state, prior, parts, control_terms)
            continue
        shrink, trial_cost, trial = 1.0, np.inf, state
        for _ in range(_HALVINGS):
            trial = apply_step(problem, state, shrink * path, shrink * cameras)
            trial_cost = _cost(problem, trial, prior, parts, control_terms)
            if trial_cost < cost:
                break
            shrink *= 0.5
        if not trial_cost < cost:
            break
        gain, state, cost = cost - trial_cost, trial, trial_cost
        if gain < _RELATIVE_TOLERANCE * cost:
            break
    return GlsSolution(state, cost, free)  # the covariance is of one step earlier, where it hardly differs


def is_tractable(problem: Problem, noise: CorrelatedNoise) -> bool:
    """Whether the rows, and knots dense enough for piecewise linear correlated errors, stay within the size limits."""
    used = _used(problem)
    rows = sum(int(np.count_nonzero(part.use)) for part in used)
    return (
        rows <= _MAX_ROWS
        and _MIN_KNOTS_PER_TIME_CONSTANT * sum(_time_constants(part, noise) for part in used) <= _MAX_KNOTS
    )


def _used(problem: Problem) -> list[TrackObservations]:
    return [rows for rows in problem.rows if np.count_nonzero(rows.use) > 1]


def _time_constants(rows: TrackObservations, noise: CorrelatedNoise) -> float:
    """Duration from the first row to the last, in time constants of the correlated error; fewer of one so small that
    the white noise hides what it does between knots further apart."""
    share = float(noise.white_std[rows.camera] / noise.correlated_std[rows.camera]) ** 2
    hidden = max(1.0, 3.0 * _KNOTS_PER_TIME_CONSTANT * _MAX_BRIDGE_VARIANCE * share)
    return float(np.ptp(rows.time[rows.use])) / float(noise.time_constant[rows.camera]) / hidden


def _on_trajectory(problem: Problem, state: AdjustmentState) -> Problem:
    out = []
    for rows in problem.rows:
        use = rows.use.copy()
        use[use] = evaluate_residuals(rows, state.cameras[rows.camera], state.trajectories[rows.label]).valid
        out.append(rows.using(use))
    return replace(problem, rows=tuple(out))


def _noise_blocks(problem: Problem, noise: CorrelatedNoise) -> list[_NoiseBlock]:
    used = _used(problem)
    density = min(_KNOTS_PER_TIME_CONSTANT, _MAX_KNOTS / max(sum(_time_constants(rows, noise) for rows in used), 1.0))
    out = []
    for rows in used:
        span = float(np.ptp(rows.time[rows.use]))
        out.append(
            _noise_block(
                rows,
                1 + max(1, int(np.ceil(max(density * _time_constants(rows, noise), span / _MAX_KNOT_SPACING_S)))),
                noise,
            )
        )
    return out


def _noise_block(rows: TrackObservations, count: int, noise: CorrelatedNoise) -> _NoiseBlock:
    time = rows.time[rows.use]
    knots = np.linspace(float(time.min()), float(time.max()) + 1e-6, count)
    interval = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, count - 2)
    share = (time - knots[interval]) / (knots[1] - knots[0])
    knot_weights = np.column_stack([1.0 - share, share])
    # Between two knots the process deviates from the line: mean variance of the bridge.
    width, correlated_std = float(knots[1] - knots[0]), float(noise.correlated_std[rows.camera])
    bridge_variance = correlated_std**2 * min(width / (3.0 * float(noise.time_constant[rows.camera])), 1.0)
    white_variance = float(noise.white_std[rows.camera]) ** 2 / UsedRows.of([rows]).relative_information
    white_information = 1.0 / (white_variance + bridge_variance)
    precision = GaussMarkov.sampled_at(knots, float(noise.time_constant[rows.camera])).precision() / correlated_std**2
    both = precision + _knot_information(interval, knot_weights, white_information, count)
    return _NoiseBlock(
        rows,
        knots,
        interval,
        knot_weights,
        precision,
        cholesky_banded(both),
        white_information,
    )


def _knot_information(interval: Ints, knot_weights: Floats, weight: Floats, count: int) -> Floats:
    """Upper band (2, m) of the rows' information about the knots on either side of them."""
    out = np.zeros((2, count))
    before, after = knot_weights.T
    out[1] = np.bincount(interval, weight * before**2, count) + np.bincount(interval + 1, weight * after**2, count)
    out[0] = np.bincount(interval + 1, weight * before * after, count)
    return out


def _cost(
    problem: Problem,
    state: AdjustmentState,
    prior: SmoothnessPrior,
    parts: list[_NoiseBlock],
    control_terms: Callable[[AdjustmentState], ControlPointTerms] | None,
) -> float:
    """The cost at a state with optimal correlated errors; a row off the trajectory costs as much as a gross error."""
    total = sum(smoothness_cost(path, *prior.of(label)) for label, path in enumerate(state.trajectories))
    total += sum((value / std) ** 2 for _, value, std in camera_priors(problem, state))
    if control_terms is not None:
        total += control_terms(state).cost
    for part in parts:
        evaluation = evaluate_residuals(part.rows, state.cameras[part.rows.camera], state.trajectories[part.rows.label])
        total += _GROSS_ERROR_COST * float(np.count_nonzero(~evaluation.valid))
        residual = np.where(evaluation.valid, evaluation.residual, 0.0)
        weighted_residual = part.knot_sums((residual * part.white_information).T)
        noise_estimate = cho_solve_banded(part.factor, weighted_residual)
        total += float((part.white_information * residual**2).sum()) - float((weighted_residual * noise_estimate).sum())
    return float(total)


def _step(
    problem: Problem,
    state: AdjustmentState,
    prior: SmoothnessPrior,
    parts: list[_NoiseBlock],
    control_terms: Callable[[AdjustmentState], ControlPointTerms] | None,
    constraints: Callable[[AdjustmentState], tuple[Floats, Floats]] | None,
) -> tuple[Floats, Floats, ParameterCovariance, bool]:
    """Steps of the paths (3 n,) and the free camera parameters (p,), the covariance (p, p) of these, and whether the
    state is off the constraints."""
    columns = problem.free_columns
    first_columns = np.r_[0, np.cumsum([3 * path.basis.size for path in state.trajectories])]
    motion = [smoothness_terms(path, *prior.of(label)) for label, path in enumerate(state.trajectories)]
    paths, first_knot = int(first_columns[-1]), int(first_columns[-1])
    size = first_knot + 2 * sum(len(part.knots) for part in parts)
    border, gradient = np.zeros((size, len(columns)), order="F"), np.zeros(size)
    corner, camera_gradient = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    blocks, entries = PathBlocks(paths // 3), SparseEntries()
    for part in parts:
        rows, camera, path = part.rows, state.cameras[part.rows.camera], state.trajectories[part.rows.label]
        evaluation = evaluate_residuals(rows, camera, path)
        index = evaluation.index + first_columns[rows.label] // 3
        camera_columns = np.flatnonzero(columns // CAMERA_PARAMETERS == rows.camera)
        jacobian = jacobians(evaluation, camera, (columns[camera_columns] % CAMERA_PARAMETERS).tolist())
        terms = np.concatenate([jacobian, evaluation.residual[:, None]], axis=1)
        weight = np.where(evaluation.valid, part.white_information, 0.0)
        weighted = terms * weight
        ends = np.array([len(index)])
        ((low, path_terms),), camera_terms = add_rows(
            [(0, blocks)], ends, index, evaluation.weights, terms * np.sqrt(weight)
        )
        observed = slice(3 * low, 3 * low + len(path_terms))
        border[observed, camera_columns] += path_terms[:, :-1]
        gradient[observed] += path_terms[:, -1]
        corner[np.ix_(camera_columns, camera_columns)] += camera_terms[:-1, :-1]
        camera_gradient[camera_columns] += camera_terms[:-1, -1]
        gram = part.precision + _knot_information(part.interval, part.knot_weights, weight, len(part.knots))
        for axis in range(2):
            at = slice(first_knot, first_knot + len(part.knots))
            knots = part.knot_sums(weighted[axis, 3:].T)
            border[at, camera_columns], gradient[at] = knots[:, :-1], knots[:, -1]
            entries.add_band(gram, first_knot)
            entries.add_cross_terms(
                index, evaluation.weights, part.interval + first_knot, part.knot_weights, weighted[axis, :3]
            )
            first_knot += len(part.knots)
    gradient[:paths] += np.concatenate([one[1] for one in motion])
    entries.add_band(blocks.band() + np.concatenate([one[0] for one in motion], axis=1), 0)
    given, pull = prior_terms(problem, state)
    camera_gradient += pull
    if control_terms is not None:
        control_at_state = control_terms(state)
        given += control_at_state.information.restricted(columns)
        camera_gradient += control_at_state.gradient[columns]
    solution = _solve_banded(entries, _time_order(state, parts), np.column_stack([border, gradient]))
    reduced, right_side = corner - border.T @ solution[:, :-1], border.T @ solution[:, -1] - camera_gradient
    if constraints is None:
        fixed = gauge(problem, state)
        values = np.zeros(len(fixed))
    else:
        directions, values = constraints(state)
        fixed = directions[:, columns]
    normal = given + BlockSum(np.zeros(len(columns)), ((np.arange(len(columns)), reduced),))
    cameras, covariance = constrained_step(normal, right_side, fixed, values)
    must = bool(np.abs(values).max(initial=0.0) > _ON_CONSTRAINTS)
    return -(solution[:, -1] + solution[:, :-1] @ cameras)[:paths], cameras, covariance, must


class SparseEntries:
    """One triangle of a symmetric sparse matrix as (row, column, value) triplets; duplicates are summed."""

    def __init__(self) -> None:
        self._entries: list[tuple[Ints, Ints, Floats]] = []

    def add_band(self, upper: Floats, first: int) -> None:
        """Add a diagonal block that begins at row ``first``, given as its upper band (k, m); padding is 0."""
        row, column = np.nonzero(upper)
        self._entries.append((first + column - (len(upper) - 1 - row), first + column, upper[row, column]))

    def add_cross_terms(self, index: Ints, weights: Floats, knot: Ints, knot_weights: Floats, values: Floats) -> None:
        """Add the cross terms between control points and knots: for width row the four control points from ``index``
        (n,) with ``weights`` (n, 4) and three coordinates ``values`` (3, n), and the two unknowns from ``knot`` (n,)
        with ``knot_weights`` (n, 2).
        """
        # Rows in the same knot interval of the trajectory and of the correlated error are summed first.
        span = int(knot.max()) + 1
        cells, cell = np.unique(index * span + knot, return_inverse=True)
        products = (weights[:, :, None] * knot_weights[:, None, :]).reshape(len(index), -1)
        width = products.shape[1]
        sums = np.zeros((width * len(cells), len(values)))
        add_row_sums(sums, products, width * cell[:, None] + np.arange(width), values.T)
        control = 3 * (cells // span)[:, None] + 3 * np.arange(SUPPORT)
        shape = (len(cells), SUPPORT, 2, 3)
        row = np.broadcast_to(control[:, :, None, None] + np.arange(3), shape)
        column = np.broadcast_to((cells % span)[:, None, None, None] + np.arange(2)[:, None], shape)
        self._entries.append((row.ravel(), column.ravel(), sums.ravel()))

    def band(self, order: Ints) -> Floats:
        """The upper band (k, n) in LAPACK's layout, with the unknowns permuted to ``order`` (n,)."""
        row, column = (order[np.concatenate([part[i] for part in self._entries])] for i in range(2))
        low, high = np.minimum(row, column), np.maximum(row, column)
        bands = int((high - low).max(initial=0)) + 1
        flat = bands * high + bands - 1 - (high - low)
        values = np.bincount(flat, np.concatenate([part[2] for part in self._entries]), bands * len(order))
        return np.asarray(values, dtype=np.float64).reshape(len(order), bands).T


def _time_order(state: AdjustmentState, parts: list[_NoiseBlock]) -> Ints:
    """Permutation (n,) of all unknowns by label and then by time, which keeps the band narrow."""
    labels, times = [], []
    for label, path in enumerate(state.trajectories):
        if isinstance(path.basis, PointBasis):
            raise TypeError("separate points have no correlated errors")
        times.append(np.repeat(path.basis.centres, 3))
        labels.append(np.full(len(times[-1]), label))
    for part in parts:
        for _ in range(2):
            times.append(state.cameras[part.rows.camera].reference_time(part.knots))
            labels.append(np.full(len(part.knots), part.rows.label))
    order = np.empty(sum(map(len, times)), dtype=np.int64)
    order[np.lexsort((np.concatenate(times), np.concatenate(labels)))] = np.arange(len(order))
    return order


def _solve_banded(normal: SparseEntries, order: Ints, right: Floats) -> Floats:
    """Solution (n, k) of a symmetric system that is banded once its unknowns are permuted to ``order`` (n,)."""
    band = normal.band(order)
    band[-1] += 1e-12 * float(band[-1].max(initial=1.0))
    factor = cholesky_banded(band)
    ordered = np.empty_like(right, order="F")
    ordered[order] = right
    return cho_solve_banded(factor, ordered, overwrite=True)[order]
