"""Covariances of the adjusted cameras, clocks and trajectories, in the published gauge."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import block_diag, csr_array, eye_array
from scipy.special import erf

from hub.bundle.block_matrix import BlockSum, BlockTridiagonal, DenseCovariance, ParameterCovariance, SparseCovariance
from hub.bundle.bordered_system import BAND, Elimination, PathByCameras, eliminate, regularisation
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, LARGE_NETWORK, AdjustmentState, Column, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior, deformation_terms
from hub.trajectory.splines import SUPPORT, cho_solve_banded, weighted_sums
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats, Ints

_Z_95 = 1.96  # 97.5 % quantile of the standard normal distribution
_COVERAGE_95 = float(erf(_Z_95 / np.sqrt(2.0)))
_HALVINGS = 24  # of the interval: to 1e-7 of its width
_IS_HELD = 1e-9  # of a parameter's square that no direction holds, from which it moves
_HOLDING_SHARE = 1e-5
"""Of a parameter's information beside known others: about what is left with all others unknown, so that holding it
neither hides the rest in rounding nor leaves the matrix singular."""


@dataclass(frozen=True, eq=False)
class CameraCovariance:
    """Joint covariance of all camera parameters.

    columns: (p,) the free ones of 18 n parameters of n cameras; fixed ones have none. free: (p, p) of these.
    """

    columns: Ints
    cameras: int
    free: ParameterCovariance

    def of(self, parameters: Ints) -> Floats:
        """(k, k) covariance of parameters (k,) of all cameras' 18 n."""
        place = np.minimum(np.searchsorted(self.columns, parameters), len(self.columns) - 1)
        is_free = self.columns[place] == parameters
        out = np.zeros((len(parameters), len(parameters)))
        out[np.ix_(is_free, is_free)] = self.free.submatrix(place[is_free])
        return out

    def of_each_camera(self, *parameters: int, cameras: Ints | None = None) -> Floats:
        """(n k, n k) covariance of k parameters of every camera, or of ``cameras`` (n,)."""
        chosen = np.arange(self.cameras) if cameras is None else cameras
        return self.of((chosen[:, None] * CAMERA_PARAMETERS + np.array(parameters)).ravel())

    @cached_property
    def variances(self) -> Floats:
        """(n, 18) of all parameters."""
        return self.spread(self.free.diagonal()).reshape(-1, CAMERA_PARAMETERS)

    @cached_property
    def clocks(self) -> Floats:
        """(2 n, 2 n) of offset and rate of every camera."""
        return self.of_each_camera(Column.OFFSET, Column.RATE)

    def spread(self, values: Floats) -> Floats:
        """(18 n, …) values (p, …) of the free parameters among all, 0 of fixed ones."""
        out = np.zeros((self.cameras * CAMERA_PARAMETERS, *values.shape[1:]))
        out[self.columns] = values
        return out


@dataclass(frozen=True, eq=False)
class Covariance(CameraCovariance):
    """With the path's. a_inv_b: (3 m, p) A⁻¹ B. blocks: (k, 24, 24) blocks of A⁻¹ about the diagonal."""

    a_inv_b: PathByCameras
    blocks: Floats


def covariance(
    problem: Problem,
    state: AdjustmentState,
    prior: SmoothnessPrior,
    control_information: BlockSum | None = None,
    datum_points: list[tuple[int, Floats]] | None = None,
    exact: Floats | None = None,
    longest: bool = False,
) -> Covariance:
    """Covariance at the solution.

    control_information: (18 n, 18 n) information of control points: surveyed positions, attitudes and distances. Gauge
    directions that they leave free are fixed by convention (`gauge_constraints`), or, with
    datum_points (label index, internal times), by inner constraints over these points of the trajectories. exact:
    (q, 18 n) directions in which nothing is uncertain, because control points without std fix them. longest: see
    `gauge_constraints`.
    """
    parts, blocks = _eliminate_paths(problem, state, prior)
    columns = problem.free_columns
    information = parts.reduced
    constraints = np.zeros((0, len(columns)))
    if problem.free_parameters.pose:
        given = control_information or BlockSum(np.zeros(len(state.cameras) * CAMERA_PARAMETERS))
        information = information + given.restricted(columns)
        if datum_points:
            constraints = inner_constraints(parts.a_inv_b, state, datum_points)
        else:
            constraints = gauge_constraints([camera.pose for camera in state.cameras], given, longest)[:, columns]
        if exact is not None:
            constraints = np.concatenate([constraints, exact[:, columns]])
    _, free = constrained_step(information, np.zeros(len(columns)), constraints, np.zeros(len(constraints)))
    return Covariance(columns, len(state.cameras), free, parts.a_inv_b, blocks)


def _eliminate_paths(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> tuple[Elimination, Floats]:
    """The reduced camera system at a state, and blocks (k, 24, 24) of A⁻¹ about the diagonal.

    The prior's cost is invariant under affine maps of a path, its linearisation in a fixed metric is not: it held the
    depth of a pair whose baseline is 3 % of the distance to 3 %, where 10 % was the error. What two narrow views leave
    open is a projective map; so each path may be mapped, by unknowns of its own, with which A⁻¹ grows by F Fᵀ.
    """
    system, _ = build_system(problem, state, prior, robust=False)
    parts, blocks = eliminate(system), inverse_blocks(system.band)
    for label, (rows, columns, border) in enumerate(system.border.parts):
        weight, scatter = prior.of(label)
        if scatter is None:
            continue
        pull, own = deformation_terms(state.trajectories[label], weight, scatter)
        reach = cho_solve_banded(parts.factor[:, rows], pull)
        further = np.linalg.solve(np.linalg.cholesky(own - pull.T @ reach), reach.T).T
        along = further.T @ border
        parts.a_inv_b.parts[label][2][:] += further @ along
        parts.reduced += BlockSum(np.zeros(parts.reduced.size), ((columns, -along.T @ along),))
        some = np.arange(max(rows.start // BAND - 1, 0), -(-rows.stop // BAND))
        windows = np.pad(further, ((rows.start, BAND * (len(blocks) + 1) - rows.stop), (0, 0)))
        windows = windows[BAND * some[:, None] + np.arange(2 * BAND)]
        blocks[some] += windows @ windows.transpose(0, 2, 1)
    return parts, blocks


def constrained_step(
    normal: BlockSum, right: Floats, rows: Floats, values: Floats
) -> tuple[Floats, ParameterCovariance]:
    """The step (p,) that solves ``normal @ step = right`` subject to ``rows @ step = -values``, and its covariance.

    Rows may repeat each other; ones that contradict each other are met in the least-squares sense.
    """
    fixed, directions = np.zeros(len(right)), np.zeros((0, len(right)))
    if len(rows):
        length, touched = np.linalg.norm(rows, axis=1), rows.any(axis=0)
        left, size, short = np.linalg.svd(rows[:, touched] / length[:, None], full_matrices=False)
        rank = int(np.count_nonzero(size > 1e-9 * size[0]))
        directions = np.zeros((rank, len(right)))
        directions[:, touched] = short[:rank]
        fixed = -directions.T @ ((left[:, :rank].T @ (values / length)) / size[:rank])
        right = right - normal @ fixed
    covariance = _constrained_inverse(normal, directions)
    return fixed + covariance @ right, covariance


def _constrained_inverse(normal: BlockSum, directions: Floats) -> ParameterCovariance:
    """Covariance (p, p) of parameters that do not move in orthonormal ``directions`` (q, p).

    Alone the normal matrix need not be definite. So a few parameters that the directions touch are held in addition,
    weakly, and let go again (Woodbury's identity).
    """
    weight = np.where(directions.any(axis=0), _HOLDING_SHARE * normal.diagonal(), 0.0)
    held = np.flatnonzero(weight)
    last = max(len(held) - CAMERA_PARAMETERS, 0)
    held = np.unique([held[first : first + CAMERA_PARAMETERS] for first in (0, last // 2, last)])
    weight[np.setdiff1d(np.arange(normal.size), held)] = 0.0
    try:
        factored = (normal + BlockSum(weight)).factored()
    except np.linalg.LinAlgError:  # some parameter is hardly determined: pivots of the whole matrix are safer
        factored = None
    if factored is None:
        if not len(directions):
            return DenseCovariance(np.asarray(np.linalg.inv(normal.dense()), dtype=np.float64))
        tangent = _complement(directions)
        inside = np.linalg.inv(tangent.T @ normal.dense() @ tangent)
        return DenseCovariance(np.asarray(tangent @ inside @ tangent.T, dtype=np.float64))
    across = factored.solve(directions.T)
    fixing = -np.linalg.inv(directions @ across)
    units = np.zeros((normal.size, len(held)))
    units[held, np.arange(len(held))] = 1.0
    along = factored.solve(units) + across @ (fixing @ across[held].T)
    release = np.linalg.inv(np.diag(1.0 / weight[held]) - along[held])
    low, middle = np.column_stack([across, along]), block_diag([fixing, release]).toarray()
    moves = np.where(np.square(directions).sum(axis=0) < 1.0 - _IS_HELD, 1.0, 0.0)
    return SparseCovariance(factored, low, middle, moves)


def _complement(fixed: Floats) -> csr_array[Any]:
    """Orthonormal directions (p, p - q) perpendicular to ``fixed`` (q, p): parameters that it does not touch, alone."""
    touched = fixed.any(axis=0)
    places = np.concatenate([np.flatnonzero(~touched), np.flatnonzero(touched)])
    mixed = np.linalg.svd(fixed[:, touched])[2][len(fixed) :].T
    return csr_array(block_diag([eye_array(int((~touched).sum())), mixed]))[np.argsort(places)]


def smallest_relative_stds(cov: CameraCovariance, problem: Problem, state: AdjustmentState) -> tuple[Floats, Floats]:
    """(n,) std [rad] of each camera's rotation and (n,) std [s] of its clock, relative to the camera to which it is
    known best: of a large network, among those that share a label with it."""
    count, middle = len(state.cameras), middles_of_overlap(problem, state)
    groups = [np.arange(count)]
    if count > LARGE_NETWORK:
        groups = [np.unique([rows.camera for rows in parts]) for parts in problem.by_label.values()]
    rotations, clocks = np.full((2, count), np.inf)
    for group in groups:
        of_group = replace(state, cameras=tuple(state.cameras[i] for i in group))
        within = middle[np.ix_(group, group)]
        for best, between in (
            (rotations, relative_rotation_stds(cov, of_group, group)),
            (clocks, _clock_stds(cov.of_each_camera(Column.OFFSET, Column.RATE, cameras=group), of_group, within)),
        ):
            np.fill_diagonal(between, np.inf)
            best[group] = np.minimum(best[group], between.min(axis=1))
    return rotations, clocks


def relative_rotation_stds(cov: CameraCovariance, state: AdjustmentState, cameras: Ints | None = None) -> Floats:
    """(n, n) largest std [rad] of the rotation between two cameras over all axes; independent of the gauge.

    cameras: (n,) indices of the state's cameras in the covariance; None = all.
    """
    count = len(state.cameras)
    out = np.zeros((count, count))
    blocks = cov.of_each_camera(0, 1, 2, cameras=cameras).reshape(count, 3, count, 3).transpose(0, 2, 1, 3)
    own = np.array([blocks[i, i] for i in range(count)])
    turned = np.array([camera.pose.rotation.T for camera in state.cameras])
    for i in range(1, count):
        relative = state.cameras[i].pose.rotation @ turned[:i]
        cross = blocks[i, :i] @ relative.transpose(0, 2, 1)
        between = own[i] + relative @ own[:i] @ relative.transpose(0, 2, 1) - cross - cross.transpose(0, 2, 1)
        out[i, :i] = out[:i, i] = np.sqrt(np.maximum(np.linalg.eigvalsh(between)[:, -1], 0.0))
    return out


def gauge_generators(poses: list[Pose]) -> Floats:
    """(18 n, 7): motion of all cameras under a small translation, rotation and scaling of the world."""
    rows = []
    for pose in poses:
        block = np.zeros((CAMERA_PARAMETERS, 7))
        block[3:6, :3] = np.eye(3)
        block[:3, 3:6] = -pose.rotation
        block[3:6, 3:6] = -so3.hat(pose.position)
        block[3:6, 6] = pose.position
        rows.append(block)
    return np.concatenate(rows)


def gauge_constraints(poses: list[Pose], control_information: BlockSum, longest: bool = False) -> Floats:
    """Constraint rows (q, 18 n) that fix the gauge directions that the control points leave free.

    They are the first camera's pose and the first baseline; where that is no convention, because control points give
    the scale or any datum serves (``longest``), the first camera's longest baseline: one much shorter than the rig is
    hardly known itself.
    """
    generators = gauge_generators(poses)
    scaled = generators / np.linalg.norm(generators, axis=0)  # to unit norm, so that one threshold serves all seven
    values, vectors = np.linalg.eigh(scaled.T @ (control_information @ scaled))
    baselines = np.array([pose.position - poses[0].position for pose in poses])
    length = np.linalg.norm(baselines, axis=1)
    second = int(np.argmax(length)) if longest or values[-1] > 0.0 else 1
    default = np.zeros((7, len(generators)))
    default[np.arange(6), np.arange(6)] = 1.0
    default[6, 3:6] = -baselines[second] / length[second]
    default[6, CAMERA_PARAMETERS * second + 3 : CAMERA_PARAMETERS * second + 6] = baselines[second] / length[second]
    free_directions = vectors[:, values < 1e-6 * max(float(values[-1]), 1e-30)] if values[-1] > 0 else np.eye(7)
    return np.asarray(free_directions.T @ np.linalg.inv(default @ scaled) @ default)


def time_map_std(cov: Covariance, state: AdjustmentState, camera: int, reference: int) -> float:
    """Std [s] of the camera's map onto the reference camera's clock, in the middle of its observed span."""
    if camera == reference:
        return 0.0
    now, base = state.cameras[camera], state.cameras[reference]
    at = float(base.camera_time(np.array([now.offset]))[0])
    columns = [2 * camera, 2 * reference, 2 * reference + 1]
    row = np.array([1.0, -1.0, base.centre - at])
    return float(np.sqrt(max(float(row @ cov.clocks[np.ix_(columns, columns)] @ row), 0.0)) / base.rate)


def inner_constraints(a_inv_b: PathByCameras, state: AdjustmentState, datum_points: list[tuple[int, Floats]]) -> Floats:
    """(7, p) constraints over the free columns: the similarity fitted to the datum points does not move.

    The trajectory follows the cameras by -A^-1 B; the points' own noise averages out over many of them.
    """
    generators, jacobian = [], []
    for label, time in datum_points:
        path = state.trajectories[label]
        index, weights, _ = path.basis.weights(time)
        _, columns, part = a_inv_b.parts[label]
        control = part[3 * (index[:, None] + np.arange(weights.shape[1]))[:, :, None] + np.arange(3)]
        moved = np.zeros((3 * len(time), a_inv_b.width))
        moved[:, columns] = -np.einsum("na,naip->nip", weights, control).reshape(len(moved), len(columns))
        jacobian.append(moved)
        points = path.at(time)
        block = np.zeros((len(points), 3, 7))
        block[:, :, :3] = np.eye(3)
        block[:, :, 3:6] = -np.array([so3.hat(point) for point in points])
        block[:, :, 6] = points
        generators.append(block.reshape(-1, 7))
    along = np.concatenate(generators)
    found = np.linalg.lstsq(along / np.linalg.norm(along, axis=0), np.concatenate(jacobian), rcond=None)[0]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def clock_rate_std(cov: Covariance, state: AdjustmentState, camera: int, reference: int) -> float:
    """Std of the camera's clock rate relative to the reference camera's."""
    columns = 2 * np.array([camera, reference]) + 1
    (own, shared), (_, other) = cov.clocks[np.ix_(columns, columns)]
    return float(np.sqrt(max(own - 2.0 * shared + other, 0.0)) / state.cameras[reference].rate)


def relative_clock_stds(cov: CameraCovariance, problem: Problem, state: AdjustmentState) -> Floats:
    """Std [s] (cameras, cameras) of the relative clock offset of two cameras, in the middle of their common span.

    That is where their lag is used; away from it the uncertain rates increase the std. For cameras without a common
    span: in the middle of the gap. Diagonal 0.
    """
    return _clock_stds(cov.clocks, state, middles_of_overlap(problem, state))


def _clock_stds(clocks: Floats, state: AdjustmentState, middle: Floats) -> Floats:
    """The same of (2 n, 2 n) covariances of offset and rate, at internal times ``middle`` (n, n)."""
    offsets, rates = (np.array([getattr(camera, name) for camera in state.cameras]) for name in ("offset", "rate"))
    change = (middle - offsets[:, None]) / rates[:, None]  # of a camera's (first index) map by its rate
    offset, mixed, rate = (clocks[a::2, b::2] for a, b in ((0, 0), (1, 0), (1, 1)))
    own = np.diag(offset)[:, None] + 2.0 * change * np.diag(mixed)[:, None] + change**2 * np.diag(rate)[:, None]
    shared = offset + change * mixed + change.T * mixed.T + change * change.T * rate
    variance = own + own.T - 2.0 * shared
    np.fill_diagonal(variance, 0.0)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def middles_of_overlap(problem: Problem, state: AdjustmentState) -> Floats:
    """Internal reference time (cameras, cameras) in the middle of the common span of two, or of the gap between."""
    first, last = np.full(len(state.cameras), np.inf), np.full(len(state.cameras), -np.inf)
    for part in problem.rows:
        times = state.cameras[part.camera].reference_time(part.time)
        first[part.camera] = times.min(initial=first[part.camera])
        last[part.camera] = times.max(initial=last[part.camera])
    return np.asarray(0.5 * (np.maximum(first[:, None], first) + np.minimum(last[:, None], last)))


def position_std(cov: Covariance, camera: int) -> Floats:
    """Std (3,) of the camera's position."""
    variance = cov.variances[camera, 3:6]
    # A coordinate fixed by the gauge comes out of the null space as 1e-30: its variance is 0 by definition.
    return np.asarray(np.sqrt(np.where(variance > 1e-20 * float(cov.variances.max(initial=0.0)), variance, 0.0)))


def path_std(cov: Covariance, state: AdjustmentState, label: int, time: Floats) -> Floats:
    """Std (n,) of a path at internal reference times (n,): one for three axes, see `equivalent_std`."""
    index, weights, _ = state.trajectories[label].basis.weights(time)
    rows, columns, by_cameras = cov.a_inv_b.parts[label]
    free = cov.free.submatrix(columns)
    first = rows.start + 3 * index
    block, inside = first // BAND, first % BAND
    out = np.zeros((len(time), 3))
    for axis in range(3):
        for a in range(SUPPORT):
            for b in range(SUPPORT):
                values = cov.blocks[block, inside + 3 * a + axis, inside + 3 * b + axis]
                out[:, axis] += weights[:, a] * weights[:, b] * values
        a_inv_b = weighted_sums(by_cameras[axis::3], index, weights)
        out[:, axis] += ((a_inv_b @ free) * a_inv_b).sum(axis=1)
    return equivalent_std(np.sqrt(np.maximum(out, 0.0)))


def equivalent_std(axes: Floats) -> Floats:
    """One std (n,) for three axes with stds (n, 3): 95 % of the errors of all axes lie within 1.96 of it.

    The error of one axis is usually larger than those of the others, so the mean variance would be optimistic: for axes
    of 2, 0.5 and 0.5 mm only 92 % lie within 1.96 of its root.
    """
    low, high = axes.min(axis=1), axes.max(axis=1)
    least = np.maximum(axes, 1e-12 * np.maximum(high, 1e-300)[:, None])
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        inside = erf(_Z_95 / np.sqrt(2.0) * middle[:, None] / least).mean(axis=1)
        wide_enough = inside >= _COVERAGE_95
        low, high = np.where(wide_enough, low, middle), np.where(wide_enough, middle, high)
    return np.asarray(high)


def inverse_blocks(band: Floats) -> Floats:
    """Blocks (k, 24, 24) of the inverse of a banded matrix about its diagonal, by block recursion.

    Block i covers rows 12 i … 12 i + 23: every 12 neighbouring rows lie in one of them.
    """
    size = band.shape[1]
    count = -(-size // BAND)
    diagonal = np.tile(np.eye(BAND), (count, 1, 1))
    above = np.zeros((count, BAND, BAND))
    for distance in range(BAND):
        column = np.arange(distance, size)
        row = column - distance
        values = band[BAND - 1 - distance, distance:]
        same = row // BAND == column // BAND
        diagonal[row[same] // BAND, row[same] % BAND, column[same] % BAND] = values[same]
        diagonal[row[same] // BAND, column[same] % BAND, row[same] % BAND] = values[same]
        above[row[~same] // BAND, row[~same] % BAND, column[~same] % BAND] = values[~same]
    on_diagonal = np.einsum("kii->ki", diagonal)
    on_diagonal += regularisation(on_diagonal.ravel()).reshape(on_diagonal.shape)
    return BlockTridiagonal.of(diagonal, above, definite=False).inverse_blocks()
