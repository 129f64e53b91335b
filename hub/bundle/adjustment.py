"""One adjustment of everything: 3-D spline, poses, time maps, and where asked focal length and k1.

Levenberg-Marquardt on the reprojection error of the raw rows (every row at its own time: METHODS A.6),
with a motion prior on the spline's third differences whose strength comes from the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hub.bundle.bordered_system import solve
from hub.bundle.normal_equations import assemble, build_system, weighed
from hub.bundle.problem import (
    ASPECT,
    CAMERA_PARAMETERS,
    CENTRE,
    FOCAL,
    K1,
    K2,
    K3,
    OFFSET,
    P1,
    RATE,
    READOUT,
    CameraState,
    Problem,
    Rows,
    State,
)
from hub.bundle.residuals import Linearised, linearise, predict, residual_norms
from hub.trajectory.discrete import PointBasis
from hub.trajectory.smoothness_prior import MotionPrior, motion_prior
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import AdjustmentStep

_CUT = 5.0  # rows beyond this many sigma are false detections
_LEAST_SIGMA = 0.05  # px
_ROUGH, _FINE = 1e-4, 1e-7  # gain, as a share of the cost, at which a round and the last one end


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
    now = weighed(problem, state, prior, robust)
    cost, system = now.cost, None
    counting = max(2 * sum(len(part.time) if robust else int(part.use.sum()) for part in problem.rows), 1)
    stage = (
        "first poses" if growing else "free lenses" if problem.freedom.lens else "robust" if robust else "fitting rows"
    )
    pixels = float(np.sqrt(np.mean(state.sigma**2)))
    steps.append(AdjustmentStep(stage, pixels * float(np.sqrt(max(cost, 0.0) / counting))))
    for _ in range(iterations):
        system = system or assemble(problem, state, prior, now)
        try:
            path_step, camera_step = solve(system, damping, gauge_tangent(problem, state))
        except np.linalg.LinAlgError:
            damping *= 10.0
            continue
        trial = moved(problem, state, path_step, camera_step)
        there = weighed(problem, trial, prior, robust)
        if np.isfinite(there.cost) and there.cost < cost:
            gain = cost - there.cost
            state, now, cost, system = trial, there, there.cost, None
            steps.append(AdjustmentStep(stage, pixels * float(np.sqrt(max(cost, 0.0) / counting))))
            damping = max(damping / 10.0, 1e-12)
            if gain < least_gain * cost:
                break
        else:
            damping = max(damping * 10.0, 1e-8)
            if damping > 1e6:
                break
    return state


__all__ = [
    "Linearised",
    "MotionPrior",
    "adjust",
    "build_system",
    "gauge_tangent",
    "linearise",
    "mark_inliers",
    "motion_prior",
    "moved",
    "noise",
    "predict",
    "residual_norms",
]
