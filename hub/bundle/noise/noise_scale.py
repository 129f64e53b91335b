"""Noise scale for the covariances: the median residual corrected for redundancy and for autocorrelation.

A trajectory with many knots absorbs part of the noise, so residuals are smaller than the noise (redundancy, trace of
the hat matrix). Errors of lenses and clocks are correlated from frame to frame, so the effective sample size is smaller
than the number of residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from hub.bundle.block_matrix import DenseCovariance
from hub.bundle.bordered_system import BAND
from hub.bundle.covariance import Covariance, covariance, inverse_blocks
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import (
    CAMERA_PARAMETERS,
    LARGE_NETWORK,
    AdjustmentState,
    Column,
    FreeParameters,
    Problem,
    TrackObservations,
    UsedRows,
)
from hub.bundle.residuals import (
    ResidualEvaluation,
    StackedTrajectories,
    evaluate_labels,
    evaluate_residuals,
    jacobians,
    relative_residuals,
    residual_norms,
)
from hub.bundle.smoothness_prior import SmoothnessPrior, determined_shares
from hub.trajectory.discrete import PointBasis
from protocols.geometry.types import Floats

_MAX_ROWS = 2000
"""Most rows of a camera over which the trace of the hat matrix is taken, evenly spaced."""
_MAX_ROWS_IN_ROUNDS = 200
"""The same while the adjustment goes on: gives the redundancy to a few percent."""
_COMMON_DEGREES = 8.0
"""Degrees of freedom of the noise that all cameras have in common, as the prior of each: where its own residuals have
fewer, they determine the variance worse than to half of itself."""
_MIN_SIGMA_PX = 0.05  # px: residuals of 0, in simulated data, would have infinite weight
MAX_LAG_S = 2.0
"""Largest lag [s] of the autocorrelation of residuals."""
_MAX_INFLATION = 1000.0  # rows per effective row: a bound
_MIN_PAIRS = 200
"""Fewest pairs of residuals at one lag for an estimate of their correlation."""
_SIGNIFICANCE_SIGMA = 3.0
"""Sigma by which a correlation must exceed 0 to count."""


def with_noise(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> AdjustmentState:
    """The state with ``sigma`` (cameras,), the robust noise of one pixel coordinate: residuals over their redundancy
    (Förstner 1979), and with the shares of the paths that are ``determined``. prior: of the fit.

    A path that follows the camera with the smallest residuals makes them smaller still: taken for its noise, they would
    end at 0. Of camera parameters, each counts for one coordinate.
    """
    noise = residual_std(problem, state)
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return replace(state, sigma=noise)
    fixed = replace(
        problem, free_parameters=FreeParameters(pose=False, clock=False), lens_priors=(), lens_tolerances=()
    )
    system, _ = build_system(fixed, state, prior, robust=False)
    blocks = inverse_blocks(system.band)
    found = Covariance(
        np.zeros(0, dtype=np.int64), len(state.cameras), DenseCovariance(np.zeros((0, 0))), system.border, blocks
    )
    parameters = np.bincount(problem.free_columns // CAMERA_PARAMETERS, minlength=len(noise)).astype(np.float64)
    noise = _over_redundancy(noise, fixed, state, found, parameters, _MAX_ROWS_IN_ROUNDS)
    shares = determined_shares(state, prior, blocks)
    paths = tuple(replace(path, determined=one) for path, one in zip(state.trajectories, shares, strict=True))
    return replace(state, sigma=noise, trajectories=paths)


def rescale_noise(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> AdjustmentState:
    """The state with ``sigma`` (cameras,) scaled for use in covariances; nothing else changes.

    Separate points (a shared clock) have their own correction (`residual_std`) and stay unchanged.
    """
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return state
    found, none = covariance(problem, state, prior, longest=True), np.zeros(len(state.cameras))
    # A camera's redundancy follows from few rows of it, and many cameras that see a label cost each of them more.
    most_rows = _MAX_ROWS if len(none) <= LARGE_NETWORK else _MAX_ROWS_IN_ROUNDS
    # Where frames have times of their own, these absorb the residuals along the motion: ``sigma`` is that across it.
    jitters = [any(rows.along_std is not None for rows in problem.of_camera(camera)) for camera in range(len(none))]
    noise = np.where(jitters, state.sigma, residual_std(problem, state))
    noise = _over_redundancy(noise, problem, state, found, none, most_rows)
    modelled = [modelled_inflation(problem, state, camera) for camera in range(len(state.cameras))]
    return replace(state, sigma=noise * np.sqrt(np.maximum(correlation_inflation(problem, state), modelled)))


def _over_redundancy(
    noise: Floats, problem: Problem, state: AdjustmentState, found: Covariance, absorbed: Floats, most_rows: int
) -> Floats:
    """Noise (cameras,) of residual stds, given how many coordinates of each camera are absorbed beside those found."""
    coordinates, absorbed = np.zeros(len(noise)), absorbed.copy()
    paths, nothing = StackedTrajectories.of(state.by_label), np.zeros((0, 0))
    # The cameras' share differs from label to label.
    groups = problem.by_label.values() if len(found.columns) else problem.by_camera.values()
    for group in groups:
        seeing = found.a_inv_b.parts[group[0].label][1]
        known = found.free.submatrix(seeing) if len(found.columns) else nothing
        for parts in [(rows,) for rows in group] if len(found.columns) else [group]:
            camera = parts[0].camera
            coordinates[camera] += 2.0 * sum(int(np.count_nonzero(rows.use)) for rows in parts)
            share = -(-most_rows // len(problem.of_camera(camera)))
            absorbed[camera] += _hat_matrix_trace(problem, state, paths, found, known, parts, share)
    degrees = np.maximum(coordinates - absorbed, 1.0)
    squares = np.square(noise) * np.maximum(coordinates, 1.0)
    common = float(squares.sum() / degrees.sum())
    return np.maximum(np.sqrt((squares + _COMMON_DEGREES * common) / (degrees + _COMMON_DEGREES)), _MIN_SIGMA_PX)


def residual_std(problem: Problem, state: AdjustmentState) -> Floats:
    """Robust std (cameras,) of one coordinate of the residuals, from their median.

    Each separate point absorbs three of the few coordinates that observe it. There all cameras share one noise:
    separate estimates would attribute all of it to one camera.
    """
    sigma = state.sigma.copy()
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return np.full(len(sigma), _pooled_noise(problem, state))
    by_camera: dict[int, list[Floats]] = {}
    for rows in problem.rows:
        norms = residual_norms(rows, state.cameras[rows.camera], state.trajectories[rows.label])
        by_camera.setdefault(rows.camera, []).append(norms[rows.use])
    for camera, parts in by_camera.items():
        values = np.concatenate(parts)
        values = values[np.isfinite(values)]
        if len(values) >= 8:
            sigma[camera] = max(_MIN_SIGMA_PX, float(np.median(values)) / 1.1774)
    return sigma


def _pooled_noise(problem: Problem, state: AdjustmentState) -> float:
    """Noise from the squared residuals of each point over the median of chi-squared at its redundancy.

    A point that two cameras see leaves one degree of freedom: its residuals are half-normal, not Rayleigh.
    """
    ratios = []
    for label, path in enumerate(state.trajectories):
        squares, rows_of = np.zeros(path.basis.size), np.zeros(path.basis.size)
        for rows in problem.of_label(label):
            norms = residual_norms(rows, state.cameras[rows.camera], path)
            good = rows.use & np.isfinite(norms)
            index = path.basis.locate(state.cameras[rows.camera].reference_time(rows.time[good]))[0]
            squares += np.bincount(index, norms[good] ** 2, path.basis.size)
            rows_of += np.bincount(index, minlength=path.basis.size)
        seen = rows_of >= 2
        ratios.append(squares[seen] / chdtri(2.0 * rows_of[seen] - 3.0, 0.5))
    return max(_MIN_SIGMA_PX, float(np.sqrt(np.median(np.concatenate(ratios)))))


def _hat_matrix_trace(
    problem: Problem,
    state: AdjustmentState,
    paths: StackedTrajectories,
    found: Covariance,
    known: Floats,
    parts: Sequence[TrackObservations],
    most_rows: int,
) -> float:
    """Trace of the hat matrix over the rows: how many of their residual coordinates the fit absorbs.

    parts: rows of one camera; of one label where camera parameters are among the found ones. known: covariance of the
    parameters of the cameras that see that label. most_rows: of each part, evenly spaced.
    """
    picked, times = list[TrackObservations](), list[Floats]()
    for rows in parts:
        used = np.flatnonzero(rows.use)
        if len(used):
            pick = used[np.unique(np.linspace(0, len(used) - 1, min(len(used), most_rows)).astype(np.int64))]
            use = np.zeros_like(rows.use)
            use[pick] = True
            picked.append(rows.using(use))
            times.append(np.full(len(pick), len(used) / len(pick)))
    if not picked:
        return 0.0
    number = picked[0].camera
    columns = CAMERA_PARAMETERS if len(found.columns) else 0
    seen = evaluate_labels(UsedRows.of(picked), state.cameras[number], paths)
    jacobian = jacobians(seen, state.cameras[number], range(columns))
    jacobian *= np.where(seen.valid, np.sqrt(seen.relative_information), 0.0) / float(state.sigma[number])
    jacobian = jacobian.transpose(2, 0, 1)
    # By the four control points of a row, (n, 2, 12).
    by_path = (seen.weights[:, None, :, None] * jacobian[:, :, None, :3]).reshape(-1, 2, BAND)
    block, inside = np.divmod(3 * seen.index, BAND)
    leverage = np.zeros(len(by_path))
    for first in range(0, BAND, 3):
        some = np.flatnonzero(inside == first)
        of_some, blocks = by_path[some], found.blocks[block[some], first : first + BAND, first : first + BAND]
        leverage[some] = (of_some @ blocks * of_some).sum(axis=(1, 2))
    if columns:
        shift = profiled_jacobian(problem, found, picked[0], seen, jacobian)
        shift = shift.reshape(-1, shift.shape[-1])
        leverage += (shift @ known * shift).reshape(len(by_path), -1).sum(axis=1)
    # A coordinate has 1 at most; where a path passes through the camera's plane, rounding made it thousands.
    return float(np.minimum(leverage, 2.0) @ np.concatenate(times))


def profiled_jacobian(
    problem: Problem, found: Covariance, rows: TrackObservations, seen: ResidualEvaluation, jacobian: Floats
) -> Floats:
    """Derivatives (n, 2, k) of residuals by the k free parameters of a label's cameras, its path adapting to them.

    rows: of the camera and label of the n residuals ``seen``. jacobian: (n, 2, 3 + 18) of `jacobians`, weighted.
    """
    rows_of_label, seeing, by_cameras = found.a_inv_b.parts[rows.label]
    by_path = (seen.weights[:, None, :, None] * jacobian[:, :, None, :3]).reshape(-1, 2, BAND)
    shift = -by_path @ by_cameras[3 * seen.index[:, None] - rows_of_label.start + np.arange(BAND)]
    parameters = problem.free_columns[seeing]
    own = np.flatnonzero(parameters // CAMERA_PARAMETERS == rows.camera)
    shift[:, :, own] += jacobian[:, :, 3 + parameters[own] % CAMERA_PARAMETERS]
    return np.asarray(shift)


def modelled_inflation(problem: Problem, state: AdjustmentState, camera: int) -> float:
    """Rows per effective row (n / effective n) by the estimated noise model; 1 without one."""
    if state.correlated_noise is None:
        return 1.0
    times = [np.unique(rows.time[rows.use]) for rows in problem.of_camera(camera)]
    if not any(len(time) > 1 for time in times):
        return 1.0
    white, correlated = (
        float(state.correlated_noise.white_std[camera]) ** 2,
        float(state.correlated_noise.correlated_std[camera]) ** 2,
    )
    step = float(np.median(np.concatenate([np.diff(time) for time in times])))
    correlation = float(np.exp(-step / state.correlated_noise.time_constant[camera]))
    weight = UsedRows.of(problem.of_camera(camera)).relative_information  # the scores' white variances are as it
    mean, square = float(weight.mean()), float(np.square(weight).mean())
    share = correlated * mean**2 / (white * mean + correlated * square)
    return 1.0 + 2.0 * share * correlation / max(1.0 - correlation, 1e-6)


@lru_cache(maxsize=2)  # every test of a solution needs it
def correlation_inflation(problem: Problem, state: AdjustmentState) -> Floats:
    """(cameras,) rows per effective row (n / effective n): serial inflation times inflation within a frame.

    1 + 2 sum of the autocorrelations over frames, and 1 + (labels - 1) times the correlation within a frame, as far as
    these are significant. Read-only.
    """
    inflation = np.array([_inflation_of(problem, state, camera) for camera in range(len(state.cameras))])
    inflation.flags.writeable = False
    return inflation


def _inflation_of(problem: Problem, state: AdjustmentState, camera: int) -> float:
    parts: list[tuple[Floats, Floats]] = []
    for rows in problem.of_camera(camera):
        if np.count_nonzero(rows.use) < 8:
            continue
        # As the rows' scores: residuals over their variances.
        residual = relative_residuals(rows, state.cameras[camera], state.trajectories[rows.label])[rows.use]
        residual *= np.sqrt(UsedRows.of([rows]).relative_information)[:, None]
        good = np.isfinite(residual).all(axis=1)
        parts.append((rows.stamps[rows.use][good], residual[good]))
    frames = _within_frame_inflation(parts)
    return frames * _serial_inflation(parts, frames)


def score_inflation(problem: Problem, state: AdjustmentState, camera: int, min_pairs: int = _MIN_PAIRS) -> float:
    """Rows per effective row in the score of a clock's offset: residuals times velocities.

    Where the motion turns from frame to frame, the residuals of a lasting time error do too, while these do not.
    """
    parts: list[tuple[Floats, Floats]] = []
    for rows in problem.of_camera(camera):
        if np.count_nonzero(rows.use) >= 8:
            seen = evaluate_residuals(rows, state.cameras[camera], state.trajectories[rows.label])
            by_time = jacobians(seen, state.cameras[camera], [Column.OFFSET])[:, 3]
            score = (seen.whitened(seen.residual) * by_time).sum(axis=0) * seen.relative_information
            parts.append((rows.stamps[rows.use][seen.valid], np.column_stack([score, score])[seen.valid]))
    frames = _within_frame_inflation(parts)
    return frames * _serial_inflation(parts, frames, min_pairs)


def _within_frame_inflation(parts: list[tuple[Floats, Floats]]) -> float:
    """Inflation by correlation between the labels of a frame; parts: stamps (n,) and residuals (n, 2) by label."""
    if len(parts) < 2:
        return 1.0
    residual = np.concatenate([part[1] for part in parts])
    stamps, frame = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    label_count = np.bincount(frame, minlength=len(stamps))
    others = label_count - 1.0
    pairs = float((label_count * others).sum()) / 2.0
    variance = float(np.mean(residual**2)) if pairs >= _MIN_PAIRS else 0.0
    if variance <= 0.0:
        return 1.0
    sums = np.stack([np.bincount(frame, column, len(stamps)) for column in residual.T])
    correlation = (float((sums**2).sum()) - float((residual**2).sum())) / (4.0 * pairs * variance)
    if correlation < _SIGNIFICANCE_SIGMA / np.sqrt(2.0 * pairs):
        return 1.0
    return 1.0 + float((label_count * others).sum() / label_count.sum()) * correlation


def _serial_inflation(parts: list[tuple[Floats, Floats]], frames: float = 1.0, min_pairs: int = _MIN_PAIRS) -> float:
    """Inflation by autocorrelation over frames; parts: as above, in any order; frames: inflation within a frame.

    Initial positive sequence of sums of two autocorrelations (Geyer 1992, section 3.3): that of one lag may be small
    where every second row is noisier.
    """
    parts = [
        (time[order], residual[order].T.copy())
        for time, residual in parts
        for order in [np.argsort(time, kind="stable")]
    ]
    steps = np.concatenate([np.diff(time) for time, _ in parts]) if parts else np.zeros(0)
    step = float(np.median(steps)) if len(steps) else 0.0
    residuals = [residual for _, residual in parts]
    variance = float(np.mean(np.concatenate(residuals, axis=1) ** 2)) if step > 0.0 else 0.0
    if step <= 0.0 or variance <= 0.0:
        return 1.0
    total, correlation, squared_std = 1.0, 0.0, 0.0
    for lag in range(1, round(MAX_LAG_S / step) + 1):
        product, pairs = 0.0, 0
        for time, residual in parts:
            if lag < len(time):
                near = np.abs(time[lag:] - time[:-lag] - lag * step) < 0.5 * step
                product += float(((residual[:, lag:] * residual[:, :-lag]) @ near).sum())
                pairs += int(np.count_nonzero(near))
        if pairs < min_pairs:
            break
        correlation += 0.5 * product / pairs / variance
        squared_std += frames / (2.0 * pairs)
        if lag % 2 == 0:
            if correlation < _SIGNIFICANCE_SIGMA * np.sqrt(squared_std):
                break
            total += 2.0 * correlation
            correlation = squared_std = 0.0
    return min(total, _MAX_INFLATION)
