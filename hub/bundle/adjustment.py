"""Continuous-time bundle adjustment: 3-D spline, poses, time maps, and optionally focal length and k1.

Levenberg-Marquardt on the reprojection error of the raw rows, each at its own time (asynchronous calibration paper,
section A.6), with a motion prior on the spline's third differences whose weight is estimated from the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hub.bundle.bordered_system import solve
from hub.bundle.noise.noise_scale import residual_std, with_noise
from hub.bundle.normal_equations import assemble, weigh_residuals
from hub.bundle.problem import (
    CAMERA_PARAMETERS,
    LARGE_NETWORK,
    AdjustmentState,
    CameraState,
    Column,
    Problem,
    TrackObservations,
    Trajectory,
)
from hub.bundle.residuals import residual_norms
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.trajectory.discrete import PointBasis
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import AdjustmentStep

_OUTLIER_SIGMA = 5.0  # rows beyond this many sigma are rejected as outliers
_LEAST_DEPTH = 0.01  # of the camera's median: targets come to a tenth of it, and paths that collapse to 1e-14
_DAMPING, _LEAST_DAMPING = 1e-9, 1e-12
"""Of the diagonal: first one of robust rounds, and of all others. What bends a chain hardly changes the cost: with 1e-4
rounds ended before it was moved, and 160 cameras were 53 mm off (rms) in place of 35 (`tests.bench.street`)."""
_ENOUGH_GAIN = 1.0
"""Of a large network's cost, chi-squared: less moves none of its thousands of parameters by a std."""
_FAR = 0.5
"""Share of the predicted gain below which a step is too long: it is cut to the minimum of the parabola through the
cost's slope and its end. Robust losses and the smoothness prior's metric, which follows the path, bend the cost more
than the normal equations say: of 999 cameras the final adjustment took 43 s without, 32 s with it."""
_COARSE_TOLERANCE, _FINE_TOLERANCE = 1e-4, 1e-7  # relative decrease of the cost that ends a round, and the last one
_MORE_ITERATIONS = 10
"""Times those of a round, in the last of all rounds. Through narrow lenses a turn about the scene hardly changes the
cost, and steps are short: with 1 7 of 150 simulated rigs of two and three cameras ended beyond 5 stds (up to
23°), so 3 (CPU +10 %)."""


def adjust(
    problem: Problem,
    state: AdjustmentState,
    *,
    iterations: int = 40,
    rounds: int = 4,
    coarse: bool = False,
    progress: Callable[[str], None] | None = None,
) -> tuple[Problem, AdjustmentState, SmoothnessPrior]:
    """Solve: robust rounds first, then the inliers with full weight.

    coarse: leave out the last, fine round, for an initial estimate that is adjusted again.
    Returns the problem with inliers marked, the state, and the motion prior used.
    """
    # One path's prior recovers from a weak start in two rounds. Those of people's keypoints, whose strengths differ by
    # orders of magnitude, do not: steps and readouts were invented from what the rounds after them gained.
    prior = estimate_smoothness(problem, state, weak=coarse or rounds > 2 or len(state.trajectories) == 1)
    robust = True
    steps = list(state.steps)
    for round_index in range(rounds):
        last = round_index == rounds - 1
        max_iterations = iterations if last else max(4, iterations // 3)
        state = minimise(problem, state, prior, robust, max_iterations, _COARSE_TOLERANCE, steps, coarse)
        if coarse:
            state = replace(state, sigma=residual_std(problem, state))
        else:
            state = with_noise(problem, state, prior)
        prior = estimate_smoothness(problem, state)
        if round_index >= rounds - 2:
            problem = mark_inliers(problem, state)
            robust = False
        if progress is not None:
            progress(f"adjustment {round_index + 1}/{rounds}: {float(np.median(state.sigma)):.2f} px")
    if not coarse:
        most = iterations if rounds <= 2 else _MORE_ITERATIONS * iterations
        state = minimise(problem, state, prior, robust, most, _FINE_TOLERANCE, steps, coarse)
        problem = without_collapsed(problem, state)
        state = with_noise(problem, state, prior)
    return problem, replace(state, steps=tuple(steps)), prior


def mark_inliers(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with only the rows within the outlier threshold in use."""
    out = []
    for rows in problem.rows:
        norms = residual_norms(rows, state.cameras[rows.camera], state.trajectories[rows.label])
        with np.errstate(invalid="ignore"):
            out.append(rows.using(norms < _OUTLIER_SIGMA * state.sigma[rows.camera]))
    return without_collapsed(replace(problem, rows=tuple(_reject_single_views(out, state))), state)


def without_collapsed(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem without the rows at which a path has collapsed onto the camera that sees it.

    Of a section that one camera alone sees, as of a false detection, any depth fits. At none the row fits whatever the
    others say, and seems to tell the camera's place and clock without error.
    """
    depths = [_depths(rows, state.cameras[rows.camera], state.trajectories[rows.label]) for rows in problem.rows]
    of_camera: dict[int, list[Floats]] = {}
    for rows, depth in zip(problem.rows, depths, strict=True):
        of_camera.setdefault(rows.camera, []).append(np.abs(depth[np.isfinite(depth)]))
    least = {i: _LEAST_DEPTH * float(np.median(np.concatenate([*z, np.zeros(1)]))) for i, z in of_camera.items()}
    parts = zip(problem.rows, depths, strict=True)
    return replace(problem, rows=tuple(rows.using(rows.use & ~(depth < least[rows.camera])) for rows, depth in parts))


def _depths(rows: TrackObservations, camera: CameraState, path: Trajectory) -> Floats:
    """How far (n,) the path is before the camera at each row; NaN where it is undefined."""
    return np.asarray(camera.pose.camera_from_world(path.at(camera.reference_time(rows.time)))[:, 2])


def _reject_single_views(parts: list[TrackObservations], state: AdjustmentState) -> list[TrackObservations]:
    """Reject separate points seen by one camera only: a single ray does not determine depth."""
    out = list(parts)
    for label, path in enumerate(state.trajectories):
        if not isinstance(path.basis, PointBasis):
            continue
        of_label = [i for i, rows in enumerate(out) if rows.label == label]
        indices = {i: path.basis.locate(state.cameras[out[i].camera].reference_time(out[i].time))[0] for i in of_label}
        count = np.zeros(path.basis.size)
        for i in of_label:
            count += np.bincount(indices[i][out[i].use], minlength=path.basis.size) > 0
        for i in of_label:
            out[i] = out[i].using(out[i].use & (count[indices[i]] >= 2))
    return out


def gauge(problem: Problem, state: AdjustmentState) -> Floats:
    """Orthonormal directions (7, p) in which the free camera parameters do not move: the pose of the first anchor and
    the distance between the two anchors. (0, p) where poses are not free, or those of some cameras are held."""
    columns = problem.free_columns
    if problem.held or not problem.free_parameters.pose:
        return np.zeros((0, len(columns)))
    first, second = problem.anchors
    width = len(state.cameras) * CAMERA_PARAMETERS
    constraints = np.zeros((7, width))
    constraints[np.arange(6), first * CAMERA_PARAMETERS + np.arange(6)] = 1.0
    baseline = state.cameras[second].pose.position - state.cameras[first].pose.position
    baseline = baseline / np.linalg.norm(baseline)
    constraints[6, second * CAMERA_PARAMETERS + 3 : second * CAMERA_PARAMETERS + 6] = baseline
    return constraints[:, columns]


def apply_step(problem: Problem, state: AdjustmentState, path_step: Floats, camera_step: Floats) -> AdjustmentState:
    """The state after a step of the free parameters."""
    full = np.zeros(len(state.cameras) * CAMERA_PARAMETERS)
    full[problem.free_columns] = camera_step
    cameras = tuple(
        camera if i in problem.held else apply_camera_step(camera, full[i * CAMERA_PARAMETERS :][:CAMERA_PARAMETERS])
        for i, camera in enumerate(state.cameras)
    )
    paths, at = [], 0
    for path in state.trajectories:
        size = 3 * path.basis.size
        paths.append(replace(path, control=path.control + path_step[at : at + size].reshape(-1, 3)))
        at += size
    return replace(state, cameras=cameras, trajectories=tuple(paths))


@np.errstate(over="ignore", invalid="ignore")  # of a step far too long, whose cost is no number
def apply_camera_step(camera: CameraState, step: Floats) -> CameraState:
    """The camera after a step (18,) of its parameters."""
    pose = Pose(so3.exp(step[:3]) @ camera.pose.rotation, camera.pose.position + step[3:6])
    lens = camera.intrinsics
    if np.any(step[Column.FOCAL :]):
        matrix = lens.matrix.copy()
        matrix[:2, :2] *= np.exp(step[Column.FOCAL])
        matrix[:2, 2] += step[Column.CENTRE : Column.CENTRE + 2]
        distortions = lens.distortions.copy()
        distortions[0] += step[Column.K1]
        distortions[1] += step[Column.K2]
        distortions[2 if lens.fisheye else 4] += step[Column.K3]
        matrix[0, 0] *= np.exp(-0.5 * step[Column.ASPECT])
        matrix[1, 1] *= np.exp(0.5 * step[Column.ASPECT])
        if not lens.fisheye:
            distortions[2:4] += step[Column.P1 :]
        lens = Intrinsics(lens.width, lens.height, matrix, distortions, lens.fisheye)
    return replace(
        camera,
        pose=pose,
        intrinsics=lens,
        offset=camera.offset + float(step[Column.OFFSET]),
        rate=camera.rate + float(step[Column.RATE]),
        readout=camera.readout + float(step[Column.READOUT]),
    )


def minimise(
    problem: Problem,
    state: AdjustmentState,
    prior: SmoothnessPrior,
    robust: bool,
    iterations: int,
    tolerance: float,
    steps: list[AdjustmentStep],
    incremental: bool,
) -> AdjustmentState:
    """Levenberg-Marquardt; appends the initial cost and every accepted step to ``steps``.

    Its damping follows the share of the predicted gain that a step has (Nielsen 1999): divided by 10 after each step,
    every second one was lost in networks of a thousand cameras.
    """
    damping, growth = _DAMPING if robust else _LEAST_DAMPING, 2.0
    current = weigh_residuals(problem, state, prior, robust)
    cost, system = current.cost, None
    residual_count = max(2 * sum(len(part.time) if robust else int(part.use.sum()) for part in problem.rows), 1)
    stage = (
        "first poses"
        if incremental
        else "free lenses"
        if problem.free_parameters.lens
        else "robust"
        if robust
        else "fitting rows"
    )
    pixels = float(np.sqrt(np.mean(state.sigma**2)))
    steps.append(AdjustmentStep(stage, pixels * float(np.sqrt(max(cost, 0.0) / residual_count))))
    last_gain, is_large = 0.0, len(state.cameras) > LARGE_NETWORK and not incremental
    enough = _ENOUGH_GAIN if is_large else 0.0
    for _ in range(iterations):
        system = system or assemble(problem, state, prior, current)
        try:
            path_step, camera_step = solve(system, damping, gauge(problem, state))
        except np.linalg.LinAlgError:
            damping, growth = damping * growth, 2.0 * growth
            continue
        trial = apply_step(problem, state, path_step, camera_step)
        trial_residuals = weigh_residuals(problem, trial, prior, robust)
        curved = float(system.band[-1] @ path_step**2 + system.corner.diagonal() @ camera_step**2)
        linear = float(system.gradient_path @ path_step + system.gradient_cameras @ camera_step)
        gain = cost - trial_residuals.cost
        ratio = gain / max(damping * curved - linear, 1e-300)
        if np.isfinite(gain) and linear < 0.0 and ratio < _FAR:
            share = linear / (gain + 2.0 * linear)
            shorter = apply_step(problem, state, share * path_step, share * camera_step)
            residuals = weigh_residuals(problem, shorter, prior, robust)
            if residuals.cost < trial_residuals.cost:
                trial, trial_residuals, gain = shorter, residuals, cost - residuals.cost
        if np.isfinite(trial_residuals.cost) and gain > 0.0:
            state, current, cost, system = trial, trial_residuals, trial_residuals.cost, None
            steps.append(AdjustmentStep(stage, pixels * float(np.sqrt(max(cost, 0.0) / residual_count))))
            damping, growth = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), _LEAST_DAMPING), 2.0
            # Near the minimum each step gains the same share of the last one's gain: what the next would.
            if gain * gain / max(gain, last_gain) < max(tolerance * cost, enough):
                break
            last_gain = gain
        else:
            damping, growth = damping * growth, 2.0 * growth
            if damping > 1e6:
                break
    return state
