"""The adjustment by generalised least squares: errors that last for seconds are parameters, held by what they are.

Ordinary least squares takes a thousand rows that err alike for a thousand separate ones, and bends clocks and lenses to
suit. Here each camera, label and image axis has an error that lasts, a line between knots under the prior of its
Gauss-Markov process (`coloured`), and only what is left counts as each row's own. Paths and lasting errors, in the
order of time, are one banded system; poses, clocks and lenses are its border.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array

from hub.bundle.adjustment import gauge_tangent, moved
from hub.bundle.bordered_system import PathBlocks, summed
from hub.bundle.covariance import held_rows
from hub.bundle.gauss_markov import Markov
from hub.bundle.normal_equations import camera_priors
from hub.bundle.problem import CAMERA_PARAMETERS, Coloured, Problem, Rows, State
from hub.bundle.residuals import derivatives, look
from hub.datum.gauge import ReferenceTerms
from hub.trajectory.discrete import PointBasis
from hub.trajectory.smoothness_prior import MotionPrior, motion_cost, motion_terms
from hub.trajectory.splines import SUPPORT
from protocols.geometry.types import Floats, Ints

_KNOTS, _FEWEST_KNOTS = 8.0, 2.0  # of a lasting error, in a time constant
_LONGEST = 5.0  # s between two of them: what a row ties together must stand close together in the band
_MOST_KNOTS = 15_000
_MOST_ROWS = 150_000
_STEPS = 40
_HALVINGS = 5
_GROSS = 100.0**2
_DONE = 1e-5  # gain as a share of the cost


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The optimum. cost: minus twice the logarithm of the likelihood and of the priors, but for constants.

    free: (p, p) covariance of the free columns of the camera parameters, none across the gauge.
    """

    state: State
    cost: float
    free: Floats

    def covariance_of(self, problem: Problem) -> Floats:
        """(18 n, 18 n) covariance of all camera parameters, zero where one was held."""
        columns = problem.free_columns()
        width = len(self.state.cameras) * CAMERA_PARAMETERS
        full = np.zeros((width, width))
        full[np.ix_(columns, columns)] = self.free
        return full


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Used rows (n,) of one camera and label, and the knots (m,) of their lasting error.

    knots: on the camera's clock [s]. place: (n,) the knot before each row. shares: (n, 2) of it and of the next one in
    a row's error. between: (n, m) the same as a matrix. precision: (2, m) upper band of the process. factor: Cholesky
    band of that and the rows. over: information of a row's own noise [1/px²].
    """

    rows: Rows
    knots: Floats
    place: Ints
    shares: Floats
    between: csr_array
    precision: Floats
    factor: Floats
    over: float


def fit(
    problem: Problem,
    state: State,
    prior: MotionPrior,
    noise: Coloured,
    references: Callable[[State], ReferenceTerms] | None = None,
) -> Fit:
    """Gauss-Newton from a state that is nearly there, over the rows in use; halved where the cost would rise.

    references: what surveyed places say at a state; without it the gauge is held (`adjust.gauge_tangent`). Rows that
    are off the path at ``state``, and a camera's only row of a label, are left out; after forty steps it ends wherever
    it is. Raises LinAlgError where the rows do not tell a path.
    """
    problem = _on_the_path(problem, state)
    parts = _parts(problem, noise)
    cost = _cost(problem, state, prior, parts, references)
    for _ in range(_STEPS):
        path, cameras, free = _step(problem, state, prior, parts, references)
        shrink, there, trial = 1.0, np.inf, state
        for _ in range(_HALVINGS):
            trial = moved(problem, state, shrink * path, shrink * cameras)
            there = _cost(problem, trial, prior, parts, references)
            if there < cost:
                break
            shrink *= 0.5
        if not there < cost:
            break
        gain, state, cost = cost - there, trial, there
        if gain < _DONE * cost:
            break
    return Fit(state, cost, free)  # a last step away, where it hardly differs


def cost_at(problem: Problem, state: State, prior: MotionPrior, noise: Coloured) -> float:
    """What `fit` makes small, at a state: lasting errors are the likeliest there; nothing is said of references."""
    return _cost(problem, state, prior, _parts(problem, noise), None)


def within_reach(problem: Problem, noise: Coloured) -> bool:
    """Whether there is room for knots so close that the lasting errors are lines between them, and for the rows."""
    used = _used(problem)
    rows = sum(int(np.count_nonzero(part.use)) for part in used)
    return rows <= _MOST_ROWS and _FEWEST_KNOTS * sum(_constants(part, noise) for part in used) <= _MOST_KNOTS


def _used(problem: Problem) -> list[Rows]:
    return [rows for rows in problem.rows if np.count_nonzero(rows.use) > 1]


def _constants(rows: Rows, noise: Coloured) -> float:
    """Time constants of the lasting error from the first row to the last."""
    return float(np.ptp(rows.time[rows.use])) / float(noise.seconds[rows.camera])


def _on_the_path(problem: Problem, state: State) -> Problem:
    out = []
    for rows in problem.rows:
        use = rows.use.copy()
        use[use] = look(rows, state.cameras[rows.camera], state.trajectories[rows.label]).valid
        out.append(rows.using(use))
    return replace(problem, rows=tuple(out))


def _parts(problem: Problem, noise: Coloured) -> list[_Part]:
    used = _used(problem)
    each = min(_KNOTS, _MOST_KNOTS / max(sum(_constants(rows, noise) for rows in used), 1.0))
    out = []
    for rows in used:
        span = float(np.ptp(rows.time[rows.use]))
        out.append(_part(rows, 1 + max(1, int(np.ceil(max(each * _constants(rows, noise), span / _LONGEST)))), noise))
    return out


def _part(rows: Rows, count: int, noise: Coloured) -> _Part:
    time = rows.time[rows.use]
    knots = np.linspace(float(time.min()), float(time.max()) + 1e-6, count)
    place = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, count - 2)
    share = (time - knots[place]) / (knots[1] - knots[0])
    shares = np.column_stack([1.0 - share, share])
    pointers = 2 * np.arange(len(time) + 1)
    between = csr_array(
        (shares.ravel(), np.column_stack([place, place + 1]).ravel(), pointers), shape=(len(time), count)
    )
    # Between two knots the process strays from the line.
    width, lasting = float(knots[1] - knots[0]), float(noise.lasting[rows.camera])
    strays = lasting**2 * min(width / (3.0 * float(noise.seconds[rows.camera])), 1.0)
    over = 1.0 / (float(noise.white[rows.camera]) ** 2 + strays)
    precision = Markov.over(knots, float(noise.seconds[rows.camera])).precision() / lasting**2
    both = precision + _gram(place, shares, np.full(len(time), over), count)
    return _Part(rows, knots, place, shares, between, precision, cholesky_banded(both, check_finite=False), over)


def _gram(place: Ints, shares: Floats, weight: Floats, count: int) -> Floats:
    """Upper band (2, m) of what rows say of the knots that they lie between."""
    out = np.zeros((2, count))
    before, after = shares.T
    out[1] = np.bincount(place, weight * before**2, count) + np.bincount(place + 1, weight * after**2, count)
    out[0] = np.bincount(place + 1, weight * before * after, count)
    return out


def _cost(
    problem: Problem,
    state: State,
    prior: MotionPrior,
    parts: list[_Part],
    references: Callable[[State], ReferenceTerms] | None,
) -> float:
    """The cost at a state, its lasting errors the likeliest there; a row off the path costs what a gross error does."""
    total = sum(
        motion_cost(path, prior.weights[label], prior.sizes[label] if prior.sizes else None)
        for label, path in enumerate(state.trajectories)
    )
    total += sum((value / std) ** 2 for _, value, std in camera_priors(problem, state))
    if references is not None:
        total += references(state).cost
    for part in parts:
        seen = look(part.rows, state.cameras[part.rows.camera], state.trajectories[part.rows.label])
        total += _GROSS * float(np.count_nonzero(~seen.valid))
        residual = np.where(seen.valid, seen.residual, 0.0)
        pulls = part.over * (part.between.T @ residual.T)
        likeliest = cho_solve_banded((part.factor, False), pulls, check_finite=False)
        total += part.over * float((residual**2).sum()) - float((pulls * likeliest).sum())
    return float(total)


def _motion(state: State, prior: MotionPrior, label: int) -> tuple[Floats, Floats, float]:
    return motion_terms(state.trajectories[label], prior.weights[label], prior.sizes[label] if prior.sizes else None)


def _step(
    problem: Problem,
    state: State,
    prior: MotionPrior,
    parts: list[_Part],
    references: Callable[[State], ReferenceTerms] | None,
) -> tuple[Floats, Floats, Floats]:
    """Steps of the paths (3 n,) and the free camera parameters (p,), and the covariance (p, p) of these."""
    columns = problem.free_columns()
    bases = np.r_[0, np.cumsum([3 * path.basis.size for path in state.trajectories])]
    motion = [_motion(state, prior, label) for label in range(len(state.trajectories))]
    paths, lasting = int(bases[-1]), int(bases[-1])
    size = lasting + 2 * sum(len(part.knots) for part in parts)
    border, gradient = np.zeros((size, len(columns)), order="F"), np.zeros(size)
    corner, pull = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    blocks, entries = PathBlocks(paths // 3), Entries()
    for part in parts:
        rows, camera, path = part.rows, state.cameras[part.rows.camera], state.trajectories[part.rows.label]
        seen = look(rows, camera, path)
        index = seen.index + bases[rows.label] // 3
        mine = np.flatnonzero(columns // CAMERA_PARAMETERS == rows.camera)
        by = derivatives(seen, camera, (columns[mine] % CAMERA_PARAMETERS).tolist())
        terms = np.concatenate([by, seen.residual[:, None]], axis=1)
        weight = np.where(seen.valid, part.over, 0.0)
        weighted = terms * weight
        spread, own = blocks.add_rows(index, seen.weights, terms, weighted)
        border[:paths, mine] += spread[:, :-1]
        gradient[:paths] += spread[:, -1]
        corner[np.ix_(mine, mine)] += own[:-1, :-1]
        pull[mine] += own[:-1, -1]
        gram = part.precision + _gram(part.place, part.shares, weight, len(part.knots))
        for axis in range(2):
            at = slice(lasting, lasting + len(part.knots))
            knots = part.between.T @ np.ascontiguousarray(weighted[axis, 3:].T)
            border[at, mine], gradient[at] = knots[:, :-1], knots[:, -1]
            entries.add_band(gram, lasting)
            entries.add_between(index, seen.weights, part.place + lasting, part.shares, weighted[axis, :3])
            lasting += len(part.knots)
    gradient[:paths] += np.concatenate([one[1] for one in motion])
    entries.add_band(blocks.band() + np.concatenate([one[0] for one in motion], axis=1), 0)
    place = {int(column): i for i, column in enumerate(columns)}
    for column, value, std in camera_priors(problem, state):
        if column in place:
            corner[place[column], place[column]] += 1.0 / std**2
            pull[place[column]] += value / std**2
    tangent = gauge_tangent(problem, state)
    if references is not None:
        told = references(state)
        corner += told.information[np.ix_(columns, columns)]
        pull += told.gradient[columns]
        held = held_rows([camera.pose for camera in state.cameras], told.information)[:, columns]
        tangent = np.linalg.svd(held)[2][len(held) :].T if len(held) else None
    carried = _solved(entries, _in_time(state, parts), np.column_stack([border, gradient]))
    reduced, right_side = corner - border.T @ carried[:, :-1], border.T @ carried[:, -1] - pull
    free = np.eye(len(columns)) if tangent is None else tangent
    covariance = free @ np.linalg.inv(free.T @ reduced @ free) @ free.T if len(columns) else reduced
    cameras = covariance @ right_side
    return -(carried[:, -1] + carried[:, :-1] @ cameras)[:paths], cameras, covariance


class Entries:
    """Entries of a symmetric sparse matrix, those of one half: of one place there may be several, which add up."""

    def __init__(self) -> None:
        self._parts: list[tuple[Ints, Ints, Floats]] = []

    def add_band(self, upper: Floats, first: int) -> None:
        """A block on the diagonal from ``first`` on, told by its upper band (k, m), 0 where there is no row."""
        row, column = np.nonzero(upper)
        self._parts.append((first + column - (len(upper) - 1 - row), first + column, upper[row, column]))

    def add_between(self, index: Ints, weights: Floats, place: Ints, shares: Floats, values: Floats) -> None:
        """What rows tie together: the control points at ``index`` (n,) by ``weights`` (n, 4), of three coordinates by
        ``values`` (3, n), and the two unknowns from ``place`` (n,) on by ``shares`` (n, 2).
        """
        # Rows of one knot interval of the path and one of the lasting error are summed first.
        span = int(place.max()) + 1
        cells, cell = np.unique(index * span + place, return_inverse=True)
        products = (weights[:, :, None] * shares[:, None, :]).reshape(len(index), -1)
        each = products.shape[1]
        sums = summed(products, each * cell[:, None] + np.arange(each), values.T, each * len(cells))
        control = 3 * (cells // span)[:, None] + 3 * np.arange(SUPPORT)
        shape = (len(cells), SUPPORT, 2, 3)
        row = np.broadcast_to(control[:, :, None, None] + np.arange(3), shape)
        column = np.broadcast_to((cells % span)[:, None, None, None] + np.arange(2)[:, None], shape)
        self._parts.append((row.ravel(), column.ravel(), sums.ravel()))

    def band(self, place: Ints) -> Floats:
        """The upper band (k, n), as LAPACK has it, of the matrix whose unknowns are at ``place`` (n,)."""
        row, column = (place[np.concatenate([part[i] for part in self._parts])] for i in range(2))
        low, high = np.minimum(row, column), np.maximum(row, column)
        bands = int((high - low).max(initial=0)) + 1
        flat = bands * high + bands - 1 - (high - low)
        values = np.bincount(flat, np.concatenate([part[2] for part in self._parts]), bands * len(place))
        return np.asarray(values, dtype=np.float64).reshape(len(place), bands).T


def _in_time(state: State, parts: list[_Part]) -> Ints:
    """Places (n,) of all unknowns in an order in which those of a label and a time stand together."""
    labels, times = [], []
    for label, path in enumerate(state.trajectories):
        if isinstance(path.basis, PointBasis):
            raise TypeError("separate points have no errors that last")
        times.append(np.repeat(path.basis.middles, 3))
        labels.append(np.full(len(times[-1]), label))
    for part in parts:
        for _ in range(2):
            times.append(state.cameras[part.rows.camera].reference_time(part.knots))
            labels.append(np.full(len(part.knots), part.rows.label))
    place = np.empty(sum(map(len, times)), dtype=np.int64)
    place[np.lexsort((np.concatenate(times), np.concatenate(labels)))] = np.arange(len(place))
    return place


def _solved(normal: Entries, place: Ints, right: Floats) -> Floats:
    """The solution (n, k) of a symmetric system that is banded once its unknowns are at ``place`` (n,)."""
    band = normal.band(place)
    band[-1] += 1e-12 * float(band[-1].max(initial=1.0))
    factor = cholesky_banded(band, overwrite_ab=True, check_finite=False)
    ordered = np.empty_like(right, order="F")
    ordered[place] = right
    return np.asarray(cho_solve_banded((factor, False), ordered, overwrite_b=True, check_finite=False)[place])


__all__ = ["Entries", "Fit", "cost_at", "fit", "within_reach"]
