"""One adjustment of everything: 3-D spline, poses, time maps, and where asked focal length and k1.

Levenberg-Marquardt on the reprojection error of the raw rows (every row at its own time: METHODS A.6),
with a motion prior on the spline's third differences whose strength comes from the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hub.points import PointBasis
from hub.poses.linear import (
    BorderedSystem,
    add_path_blocks,
    border_block,
    path_gradient,
    solve,
)
from hub.poses.motion import MotionPrior, motion_prior, motion_terms
from hub.poses.problem import (
    ASPECT,
    CAMERA_PARAMETERS,
    CENTRE,
    FOCAL,
    GIVEN_PARAMETERS,
    K1,
    K2,
    K3,
    OFFSET,
    P1,
    RATE,
    READOUT,
    CameraState,
    LensPrior,
    Problem,
    Rows,
    State,
    Trajectory,
)
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import AdjustmentStep

_WIDTH = 4.0  # Cauchy width in sigma of the 2-D residual: nearly efficient for Gaussian noise
_CUT = 5.0  # rows beyond this many sigma are false detections
_LEAST_SIGMA = 0.05  # px
# Knot intervals by which the path goes on beyond its ends while clocks move: a row that a step takes off the path costs
# as much as a gross error, so that one row at an end would hold every clock where it is.
_BEYOND = 0.5
_ROUGH, _FINE = 1e-4, 1e-7  # gain, as a share of the cost, at which a round and the last one end


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Rows of one camera and label at a state: residual (n, 2), derivatives, place in the spline."""

    residual: Floats
    by_point: Floats
    by_camera: Floats
    index: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    weights: Floats
    valid: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


def adjust(
    problem: Problem,
    state: State,
    *,
    iterations: int = 40,
    rounds: int = 4,
    roughly: bool = False,
    progress: Callable[[str], None] | None = None,
) -> tuple[Problem, State, MotionPrior]:
    """Solve: robust rounds first, then the rows that fit with full weight.

    roughly: for a start, which is adjusted again.
    Returns the problem with the rows that count marked, the state, and the motion prior used.
    """
    prior = motion_prior(problem, state, first=True)
    robust = True
    steps = list(state.steps)
    for turn in range(rounds):
        last = turn == rounds - 1
        most = iterations if last else max(4, iterations // 3)
        state = _minimise(problem, state, prior, robust, most, _ROUGH, steps, roughly)
        state = replace(state, sigma=noise(problem, state))
        prior = motion_prior(problem, state)
        if turn >= rounds - 2:
            problem = mark_inliers(problem, state)
            robust = False
        if progress is not None:
            progress(f"adjustment {turn + 1}/{rounds}: {float(np.median(state.sigma)):.2f} px")
    state = _minimise(problem, state, prior, robust, iterations, _ROUGH if roughly else _FINE, steps, roughly)
    return problem, replace(state, sigma=noise(problem, state), steps=tuple(steps)), prior


def predict(rows: Rows, camera: CameraState, path: Trajectory) -> Floats:
    """Pixels (n, 2) at which the camera should have seen the point; NaN where the path is not known."""
    points = path.at(camera.reference_time(camera.shot(rows.time, rows.pixels)))
    return camera.intrinsics.project(camera.pose.camera_from_world(points))


def residual_norms(rows: Rows, camera: CameraState, path: Trajectory) -> Floats:
    """Distances (n,) [px] of rows from their predictions; NaN where the path is not known."""
    return np.asarray(np.linalg.norm(predict(rows, camera, path) - rows.pixels, axis=1))


def noise(problem: Problem, state: State) -> Floats:
    """Robust noise (cameras,) of one pixel coordinate from the median residual.

    Separate points take up three of the few coordinates that see each of them: there one noise is shared
    (told apart, it would all be put on one camera) and corrected for what the points have absorbed.
    """
    sigma = state.sigma.copy()
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return np.full(len(sigma), _pooled_noise(problem, state))
    for camera in range(len(state.cameras)):
        parts = [
            residual_norms(rows, state.cameras[camera], state.trajectories[rows.label])[rows.use]
            for rows in problem.rows
            if rows.camera == camera
        ]
        values = np.concatenate(parts) if parts else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values) >= 8:
            sigma[camera] = max(_LEAST_SIGMA, float(np.median(values)) / 1.1774)
    return sigma


def _pooled_noise(problem: Problem, state: State) -> float:
    parts, points = [], 0
    for label, path in enumerate(state.trajectories):
        seen = np.zeros(path.basis.size, dtype=np.bool_)
        for rows in problem.rows:
            if rows.label == label:
                norms = residual_norms(rows, state.cameras[rows.camera], path)
                good = rows.use & np.isfinite(norms)
                parts.append(norms[good])
                index = path.basis.locate(state.cameras[rows.camera].reference_time(rows.time[good]))[0]
                seen[index] = True
        points += int(seen.sum())
    norms = np.concatenate(parts)
    left = max(2 * len(norms) - 3 * points, 0.05 * len(norms))
    return max(_LEAST_SIGMA, float(np.median(norms)) / 1.1774 * float(np.sqrt(2 * len(norms) / left)))


def mark_inliers(problem: Problem, state: State) -> Problem:
    """The problem with only those rows in use that lie within the cut."""
    out = []
    for rows in problem.rows:
        norms = residual_norms(rows, state.cameras[rows.camera], state.trajectories[rows.label])
        with np.errstate(invalid="ignore"):
            out.append(rows.using(norms < _CUT * state.sigma[rows.camera]))
    return replace(problem, rows=tuple(_without_single_views(out, state)))


def _without_single_views(parts: list[Rows], state: State) -> list[Rows]:
    """Separate points need two cameras each: one ray alone leaves the point free along it."""
    out = list(parts)
    for label, path in enumerate(state.trajectories):
        if not isinstance(path.basis, PointBasis):
            continue
        mine = [i for i, rows in enumerate(out) if rows.label == label]
        places = {i: path.basis.locate(state.cameras[out[i].camera].reference_time(out[i].time))[0] for i in mine}
        count = np.zeros(path.basis.size)
        for i in mine:
            count += np.bincount(places[i][out[i].use], minlength=path.basis.size) > 0
        for i in mine:
            out[i] = out[i].using(out[i].use & (count[places[i]] >= 2))
    return out


def linearise(rows: Rows, camera: CameraState, path: Trajectory, columns: int = CAMERA_PARAMETERS) -> Linearised:
    """Residuals of the used rows and their derivatives by the point (n, 2, 3) and the camera (n, 2, columns)."""
    pixels = rows.pixels[rows.use]
    time = camera.shot(rows.time[rows.use], pixels)
    index, weights, slopes, inside = path.basis.weights_both(camera.reference_time(time), _BEYOND)
    around = path.control[index[:, None] + np.arange(weights.shape[1])]
    point = np.einsum("nk,nki->ni", weights, around)
    velocity = np.einsum("nk,nki->ni", slopes, around)
    local = (point - camera.pose.position) @ camera.pose.rotation.T
    z = local[:, 2]
    valid = inside & (z > 1e-9)
    over = 1.0 / np.where(valid, z, 1.0)
    flat = np.where(valid[:, None], local[:, :2] * over[:, None], 0.0)
    lens = camera.intrinsics
    projected = lens.project_normalised(flat)
    valid &= np.isfinite(projected).all(axis=1)
    flat = np.where(valid[:, None], flat, 0.0)
    projected = np.where(valid[:, None], projected, lens.matrix[:2, 2])
    by_local = np.empty((len(time), 2, 3))
    by_local[:, :, :2] = lens.pixel_jacobian(flat) * over[:, None, None]
    by_local[:, :, 2] = -by_local[:, :, 0] * flat[:, :1] - by_local[:, :, 1] * flat[:, 1:]
    by_point = (by_local.reshape(-1, 3) @ camera.pose.rotation).reshape(-1, 2, 3)
    by_camera = np.empty((len(time), 2, columns))
    # A turn by w moves the point by w × local.
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        by_camera[:, :, k] = local[:, i, None] * by_local[:, :, j] - local[:, j, None] * by_local[:, :, i]
    by_camera[:, :, 3:6] = -by_point
    along = (by_point * velocity[:, None, :]).sum(axis=2)
    by_camera[:, :, OFFSET] = along
    by_camera[:, :, RATE] = along * (time - camera.centre)[:, None]
    by_camera[:, :, READOUT] = along * (camera.rate * camera.below_middle(pixels))[:, None]
    by_camera[:, :, FOCAL] = projected - lens.matrix[:2, 2]
    radius2 = (flat**2).sum(axis=1)
    if lens.fisheye:
        radius = np.sqrt(radius2)
        angle = np.arctan(radius)
        by_camera[:, :, K1] = flat * (angle**3 / np.maximum(radius, 1e-12))[:, None] * np.diag(lens.matrix)[:2]
    else:
        by_camera[:, :, K1] = (flat * radius2[:, None]) @ lens.matrix[:2, :2].T
    if columns > GIVEN_PARAMETERS:
        by_camera[:, :, CENTRE : CENTRE + 2] = np.eye(2)
        factor = angle**2 if lens.fisheye else radius2
        by_camera[:, :, K2] = by_camera[:, :, K1] * factor[:, None]
        by_camera[:, :, K3] = by_camera[:, :, K2] * factor[:, None]
        by_camera[:, :, ASPECT] = by_camera[:, :, FOCAL] * [-0.5, 0.5]
        x, y = flat.T
        tangents = np.stack([2 * x * y, radius2 + 2 * y * y, radius2 + 2 * x * x, 2 * x * y], axis=-1).reshape(-1, 2, 2)
        by_camera[:, :, P1:] = 0.0 if lens.fisheye else (tangents @ lens.matrix[:2, :2].T).transpose(0, 2, 1)
    return Linearised(projected - pixels, by_point, by_camera, index, weights, valid)


def build_system(problem: Problem, state: State, prior: MotionPrior, robust: bool) -> tuple[BorderedSystem, float]:
    """Normal equations over all labels' control points and the free camera parameters, and the cost."""
    sizes = [3 * path.basis.size for path in state.trajectories]
    bases = np.r_[0, np.cumsum(sizes)].astype(int)
    columns = problem.free_columns()
    width = len(state.cameras) * CAMERA_PARAMETERS
    system = BorderedSystem(
        np.zeros((12, bases[-1])),
        np.zeros((bases[-1], len(columns))),
        np.zeros((width, width)),
        np.zeros(bases[-1]),
        np.zeros(width),
    )
    place = np.full(width, -1)
    place[columns] = np.arange(len(columns))
    cost = 0.0
    for label, path in enumerate(state.trajectories):
        part = slice(bases[label], bases[label + 1])
        band, gradient, value = motion_terms(path, prior.weights[label], prior.scales[label] if prior.scales else None)
        system.band[:, part] += band
        system.gradient_path[part] += gradient
        cost += value
    for rows in problem.rows:
        part = slice(bases[rows.label], bases[rows.label + 1])
        count = GIVEN_PARAMETERS if problem.lens_prior(rows.camera) is None else CAMERA_PARAMETERS
        line = linearise(rows, state.cameras[rows.camera], state.trajectories[rows.label], count)
        variance = state.sigma[rows.camera] ** 2
        squared = (line.residual**2).sum(axis=1) / variance
        if robust:
            ratio = squared / _WIDTH**2
            weight = np.where(line.valid, 1.0 / (1.0 + ratio), 0.0) / variance
            losses = _WIDTH**2 * np.log1p(ratio)
        else:
            weight = np.where(line.valid, 1.0, 0.0) / variance
            losses = squared
        # A point behind the camera or off the path costs what a gross outlier does, and pulls nothing.
        gross = _WIDTH**2 * np.log1p((100.0 / _WIDTH) ** 2) if robust else 100.0**2
        cost += float(np.where(line.valid, losses, gross).sum())
        weighted = line.by_point * weight[:, None, None]
        blocks = _outer(weighted, line.by_point)
        add_path_blocks(system.band[:, part], line.index, line.weights, blocks)
        pull = (weighted * line.residual[:, :, None]).sum(axis=1)
        system.gradient_path[part] += path_gradient(line.index, line.weights, pull, sizes[rows.label])
        base = rows.camera * CAMERA_PARAMETERS
        mine = slice(base, base + count)
        flat = line.by_camera.reshape(-1, count)
        flat_weight = np.repeat(weight, 2)
        system.corner[mine, mine] += (flat * flat_weight[:, None]).T @ flat
        system.gradient_cameras[mine] += (flat * flat_weight[:, None]).T @ line.residual.reshape(-1)
        free = place[mine] >= 0
        if free.any() and len(line.index):
            cross = _outer(weighted, line.by_camera[:, :, free])
            system.border[part, place[mine][free]] += border_block(line.index, line.weights, cross, sizes[rows.label])
    cost += _add_camera_priors(problem, state, system)
    system.corner = system.corner[np.ix_(columns, columns)]
    system.gradient_cameras = system.gradient_cameras[columns]
    return system, cost


def _outer(left: Floats, right: Floats) -> Floats:
    """``leftᵀ right`` (n, p, q) of (n, 2, p) and (n, 2, q)."""
    out = left[:, 0, :, None] * right[:, 0, None, :]
    out += left[:, 1, :, None] * right[:, 1, None, :]
    return out


def _add_camera_priors(problem: Problem, state: State, system: BorderedSystem) -> float:
    """Priors on rate and lens, on the diagonal of the cameras' corner; their cost."""
    freedom, cost = problem.freedom, 0.0
    for camera, (now, nominal) in enumerate(zip(state.cameras, problem.nominal, strict=True)):
        base = camera * CAMERA_PARAMETERS
        terms = [(RATE, now.rate - 1.0, freedom.rate_std)]
        if freedom.readout:
            terms.append((READOUT, now.readout, freedom.readout_std))
        guess = problem.lens_prior(camera)
        if guess is not None:
            terms.append((FOCAL, float(np.log(now.intrinsics.focal / guess.focal)), guess.focal_std))
            off = now.intrinsics.matrix[:2, 2] - guess.centre
            terms += [(CENTRE, float(off[0]), guess.centre_std), (CENTRE + 1, float(off[1]), guess.centre_std)]
            terms.append((K1, float(now.intrinsics.distortions[0] - guess.k1), guess.k1_std))
            terms.append((K2, float(now.intrinsics.distortions[1] - guess.k2), guess.k2_std))
            terms += _finer_priors(now.intrinsics, nominal, guess)
        elif freedom.lens:
            terms.append((FOCAL, float(np.log(now.intrinsics.focal / nominal.focal)), freedom.focal_std))
            terms.append((K1, float(now.intrinsics.distortions[0] - nominal.distortions[0]), freedom.k1_std))
        for column, value, std in terms:
            system.corner[base + column, base + column] += 1.0 / std**2
            system.gradient_cameras[base + column] += value / std**2
            cost += (value / std) ** 2
    return cost


def _finer_priors(now: Intrinsics, nominal: Intrinsics, guess: LensPrior) -> list[tuple[int, float, float]]:
    """Column, difference and std of what a lens has beside focal length, centre, k1 and k2."""
    third = 2 if now.fisheye else 4
    aspect = np.log(now.matrix[1, 1] / now.matrix[0, 0] / nominal.matrix[1, 1] * nominal.matrix[0, 0])
    terms = [
        (K3, float(now.distortions[third] - nominal.distortions[third]), guess.k3_std),
        (ASPECT, float(aspect), guess.aspect_std),
    ]
    if not now.fisheye:
        off = now.distortions[2:4] - nominal.distortions[2:4]
        terms += [(P1, float(off[0]), guess.tangential_std), (P1 + 1, float(off[1]), guess.tangential_std)]
    return terms


def gauge_tangent(problem: Problem, state: State) -> Floats | None:
    """Orthonormal directions (p, q) in which the free camera parameters may move without touching the gauge.

    Held: pose of the first anchor, distance between the two anchors. None where poses are fixed.
    """
    if not problem.freedom.pose:
        return None
    columns = problem.free_columns()
    first, second = problem.anchors
    width = len(state.cameras) * CAMERA_PARAMETERS
    held = np.zeros((7, width))
    held[np.arange(6), first * CAMERA_PARAMETERS + np.arange(6)] = 1.0
    apart = state.cameras[second].pose.position - state.cameras[first].pose.position
    apart = apart / np.linalg.norm(apart)
    held[6, second * CAMERA_PARAMETERS + 3 : second * CAMERA_PARAMETERS + 6] = apart
    _, _, vt = np.linalg.svd(held[:, columns])
    return np.asarray(vt[7:].T)


def moved(problem: Problem, state: State, path_step: Floats, camera_step: Floats) -> State:
    """The state after a step of the free parameters."""
    full = np.zeros(len(state.cameras) * CAMERA_PARAMETERS)
    full[problem.free_columns()] = camera_step
    cameras = tuple(
        _moved_camera(camera, full[i * CAMERA_PARAMETERS : (i + 1) * CAMERA_PARAMETERS])
        for i, camera in enumerate(state.cameras)
    )
    paths, at = [], 0
    for path in state.trajectories:
        size = 3 * path.basis.size
        paths.append(replace(path, control=path.control + path_step[at : at + size].reshape(-1, 3)))
        at += size
    return replace(state, cameras=cameras, trajectories=tuple(paths))


def _moved_camera(camera: CameraState, step: Floats) -> CameraState:
    pose = Pose(so3.exp(step[:3]) @ camera.pose.rotation, camera.pose.position + step[3:6])
    lens = camera.intrinsics
    if np.any(step[FOCAL:]):
        matrix = lens.matrix.copy()
        matrix[:2, :2] *= np.exp(step[FOCAL])
        matrix[:2, 2] += step[CENTRE : CENTRE + 2]
        distortions = lens.distortions.copy()
        distortions[0] += step[K1]
        distortions[1] += step[K2]
        distortions[2 if lens.fisheye else 4] += step[K3]
        matrix[0, 0] *= np.exp(-0.5 * step[ASPECT])
        matrix[1, 1] *= np.exp(0.5 * step[ASPECT])
        if not lens.fisheye:
            distortions[2:4] += step[P1:]
        lens = Intrinsics(lens.width, lens.height, matrix, distortions, lens.fisheye)
    return replace(
        camera,
        pose=pose,
        intrinsics=lens,
        offset=camera.offset + float(step[OFFSET]),
        rate=camera.rate + float(step[RATE]),
        readout=camera.readout + float(step[READOUT]),
    )


def _minimise(
    problem: Problem,
    state: State,
    prior: MotionPrior,
    robust: bool,
    iterations: int,
    least_gain: float,
    steps: list[AdjustmentStep],
    growing: bool,
) -> State:
    """Levenberg-Marquardt; appends where it begins and every step that it takes to ``steps``."""
    damping = 1e-4
    system, cost = build_system(problem, state, prior, robust)
    counting = max(2 * sum(len(part.time) if robust else int(part.use.sum()) for part in problem.rows), 1)
    stage = (
        "first poses" if growing else "free lenses" if problem.freedom.lens else "robust" if robust else "fitting rows"
    )
    pixels = float(np.sqrt(np.mean(state.sigma**2)))
    steps.append(AdjustmentStep(stage, pixels * float(np.sqrt(max(cost, 0.0) / counting))))
    for _ in range(iterations):
        try:
            path_step, camera_step = solve(system, damping, gauge_tangent(problem, state))
        except np.linalg.LinAlgError:
            damping *= 10.0
            continue
        trial = moved(problem, state, path_step, camera_step)
        trial_system, trial_cost = build_system(problem, trial, prior, robust)
        if np.isfinite(trial_cost) and trial_cost < cost:
            gain = cost - trial_cost
            state, system, cost = trial, trial_system, trial_cost
            steps.append(AdjustmentStep(stage, pixels * float(np.sqrt(max(cost, 0.0) / counting))))
            damping = max(damping / 10.0, 1e-12)
            if gain < least_gain * abs(cost):  # below 0 where the prior's pull on the scale outweighs the rows
                break
        else:
            damping = max(damping * 10.0, 1e-8)
            if damping > 1e6:
                break
    return state
