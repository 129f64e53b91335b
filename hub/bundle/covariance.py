"""Covariances of the adjusted cameras, clocks and trajectories, in the published gauge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import block_diag, csr_array, eye_array
from scipy.special import erf

from hub.bundle.bordered_system import BAND, PathByCameras, eliminate, regularisation
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, OFFSET, RATE, AdjustmentState, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from hub.trajectory.splines import SUPPORT, weighted_sums
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_Z_95 = 1.96  # 97.5 % quantile of the standard normal distribution
_COVERAGE_95 = float(erf(_Z_95 / np.sqrt(2.0)))
_HALVINGS = 24  # of the interval: to 1e-7 of its width


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Joint covariance of all camera parameters, and the blocks needed for that of the path.

    cameras: (18 n, 18 n), zero where a parameter is fixed. a_inv_b: (3 m, p) A⁻¹ B over the free columns.
    free: (p, p) covariance of the free columns. blocks: (k, 24, 24) blocks of A⁻¹ about the diagonal.
    """

    cameras: Floats
    a_inv_b: PathByCameras
    free: Floats
    blocks: Floats


def covariance(
    problem: Problem,
    state: AdjustmentState,
    prior: SmoothnessPrior,
    control_information: Floats | None = None,
    datum_points: list[tuple[int, Floats]] | None = None,
    exact: Floats | None = None,
) -> Covariance:
    """Covariance at the solution.

    control_information: (18 n, 18 n) information of control points: surveyed positions, attitudes and distances. Gauge
    directions that they leave free are fixed by convention: the first camera's pose and the first baseline, or, with
    datum_points (label index, internal times), by inner constraints over these points of the trajectories. exact:
    (q, 18 n) directions in which nothing is uncertain, because control points without std fix them.
    """
    system, _ = build_system(problem, state, prior, robust=False)
    parts = eliminate(system)
    columns = problem.free_columns()
    information = parts.reduced
    constraints = np.zeros((0, len(columns)))
    if problem.free_parameters.pose:
        prior_information = (
            np.zeros((len(state.cameras) * CAMERA_PARAMETERS,) * 2)
            if control_information is None
            else control_information
        )
        information = information + prior_information[np.ix_(columns, columns)]
        if datum_points:
            constraints = inner_constraints(parts.a_inv_b, state, datum_points)
        else:
            constraints = gauge_constraints([camera.pose for camera in state.cameras], prior_information)[:, columns]
        if exact is not None:
            constraints = np.concatenate([constraints, exact[:, columns]])
    _, free = constrained_step(information, np.zeros(len(columns)), constraints, np.zeros(len(constraints)))
    width = len(state.cameras) * CAMERA_PARAMETERS
    full = np.zeros((width, width))
    full[np.ix_(columns, columns)] = free
    return Covariance(full, parts.a_inv_b, free, _inverse_blocks(system.band))


def constrained_step(normal: Floats, right: Floats, rows: Floats, values: Floats) -> tuple[Floats, Floats]:
    """The step (p,) that solves ``normal @ step = right`` subject to ``rows @ step = -values``, and its covariance.

    Rows may repeat each other; ones that contradict each other are met in the least-squares sense.
    """
    if not len(rows):
        covariance: Floats = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        return covariance @ right, covariance
    length, touched = np.linalg.norm(rows, axis=1), rows.any(axis=0)
    left, size, short = np.linalg.svd(rows[:, touched] / length[:, None], full_matrices=False)
    rank = int(np.count_nonzero(size > 1e-9 * size[0]))
    vt = np.zeros((rank, rows.shape[1]))
    vt[:, touched] = short[:rank]
    fixed = -vt.T @ ((left[:, :rank].T @ (values / length)) / size[:rank])
    tangent = _complement(vt)
    covariance = np.asarray(tangent @ np.linalg.inv(tangent.T @ normal @ tangent) @ tangent.T, dtype=np.float64)
    return fixed + covariance @ (right - normal @ fixed), covariance


def _complement(fixed: Floats) -> csr_array[Any]:
    """Orthonormal directions (p, p - q) perpendicular to ``fixed`` (q, p): parameters that it does not touch, alone."""
    touched = fixed.any(axis=0)
    places = np.concatenate([np.flatnonzero(~touched), np.flatnonzero(touched)])
    mixed = np.linalg.svd(fixed[:, touched])[2][len(fixed) :].T
    return csr_array(block_diag([eye_array(int((~touched).sum())), mixed]))[np.argsort(places)]


def relative_rotation_stds(cameras: Floats, state: AdjustmentState) -> Floats:
    """(n, n) largest std [rad] of the rotation between two cameras over all axes; independent of the gauge.

    cameras: (18 n, 18 n) covariance of their parameters.
    """
    count = len(state.cameras)
    out = np.zeros((count, count))
    blocks = cameras.reshape(count, CAMERA_PARAMETERS, count, CAMERA_PARAMETERS)[:, :3, :, :3].transpose(0, 2, 1, 3)
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


def gauge_constraints(poses: list[Pose], control_information: Floats) -> Floats:
    """Constraint rows (q, 18 n) that fix the gauge directions that the control points leave free."""
    generators = gauge_generators(poses)
    default = np.zeros((7, len(generators)))
    default[np.arange(6), np.arange(6)] = 1.0
    baseline = poses[1].position - poses[0].position
    baseline = baseline / np.linalg.norm(baseline)
    default[6, 3:6] = -baseline
    default[6, CAMERA_PARAMETERS + 3 : CAMERA_PARAMETERS + 6] = baseline
    # Generators scaled to unit norm, so that one threshold serves all seven.
    scaled = generators / np.linalg.norm(generators, axis=0)
    prior_information = scaled.T @ control_information @ scaled
    values, vectors = np.linalg.eigh(prior_information)
    free_directions = vectors[:, values < 1e-6 * max(float(values[-1]), 1e-30)] if values[-1] > 0 else np.eye(7)
    return np.asarray(free_directions.T @ np.linalg.inv(default @ scaled) @ default)


def time_map_std(cov: Covariance, state: AdjustmentState, camera: int, reference: int) -> float:
    """Std [s] of the camera's map onto the reference camera's clock, in the middle of its observed span."""
    if camera == reference:
        return 0.0
    now, base = state.cameras[camera], state.cameras[reference]
    at = float(base.camera_time(np.array([now.offset]))[0])
    of_reference = reference * CAMERA_PARAMETERS
    columns = [camera * CAMERA_PARAMETERS + OFFSET, of_reference + OFFSET, of_reference + RATE]
    row = np.array([1.0, -1.0, base.centre - at])
    return float(np.sqrt(max(float(row @ cov.cameras[np.ix_(columns, columns)] @ row), 0.0)) / base.rate)


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
    columns = np.array([camera, reference]) * CAMERA_PARAMETERS + RATE
    (own, shared), (_, other) = cov.cameras[np.ix_(columns, columns)]
    return float(np.sqrt(max(own - 2.0 * shared + other, 0.0)) / state.cameras[reference].rate)


def relative_clock_stds(cov: Covariance, problem: Problem, state: AdjustmentState) -> Floats:
    """Std [s] (cameras, cameras) of the relative clock offset of two cameras, in the middle of their common span.

    That is where their lag is used; away from it the uncertain rates increase the std. For cameras without a common
    span: in the middle of the gap. Diagonal 0.
    """
    middle = middles_of_overlap(problem, state)
    offsets, rates = (np.array([getattr(camera, name) for camera in state.cameras]) for name in ("offset", "rate"))
    change = (middle - offsets[:, None]) / rates[:, None]  # of a camera's (first index) map by its rate
    both = ((OFFSET, OFFSET), (RATE, OFFSET), (RATE, RATE))
    offset, mixed, rate = (cov.cameras[a::CAMERA_PARAMETERS, b::CAMERA_PARAMETERS] for a, b in both)
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
    begin = camera * CAMERA_PARAMETERS + 3
    variance = np.diag(cov.cameras)[begin : begin + 3]
    # A coordinate fixed by the gauge comes out of the null space as 1e-30: its variance is 0 by definition.
    return np.asarray(np.sqrt(np.where(variance > 1e-20 * float(np.diag(cov.cameras).max(initial=0.0)), variance, 0.0)))


def path_std(cov: Covariance, state: AdjustmentState, label: int, time: Floats) -> Floats:
    """Std (n,) of a path at internal reference times (n,): one for three axes, see `equivalent_std`."""
    index, weights, _ = state.trajectories[label].basis.weights(time)
    rows, columns, by_cameras = cov.a_inv_b.parts[label]
    free = cov.free[np.ix_(columns, columns)]
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


def _inverse_blocks(band: Floats) -> Floats:
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
    pivots = np.empty_like(diagonal)
    pivots[0] = np.linalg.inv(diagonal[0])
    for i in range(1, count):
        pivots[i] = np.linalg.inv(diagonal[i] - above[i - 1].T @ pivots[i - 1] @ above[i - 1])
    out = np.zeros((count, 2 * BAND, 2 * BAND))
    last = pivots[-1]
    out[-1, :BAND, :BAND] = last
    for i in range(count - 2, -1, -1):
        carry = pivots[i] @ above[i]
        corner = -carry @ last
        now = pivots[i] - corner @ carry.T
        out[i, :BAND, :BAND], out[i, BAND:, BAND:] = now, last
        out[i, :BAND, BAND:], out[i, BAND:, :BAND] = corner, corner.T
        last = now
    return out
