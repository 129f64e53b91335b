"""Self-calibration of lenses without measured intrinsics: initial focal lengths, refined by the bundle adjustment.

Pairs of such cameras give lags and fundamental matrices without intrinsics. An essential matrix has two equal singular
values; the focal lengths for which all pairs' matrices come nearest to that are the initial values (Mendonça and
Cipolla, "A simple technique for self-calibration", 1999), within a prior: the data sheet's field of view, or 60° with a
wide std. The adjustment then estimates all intrinsics of these cameras under priors; cameras whose focal length stays
too uncertain are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hub.bundle.initialisation import CameraInput
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import LensPrior
from hub.sync.hypothesis import PairFit, PairSolution
from hub.sync.pair_solver import solve_pair
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack, smooth_only, smooth_track
from hub.two_view import relative_pose
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

UNKNOWN_FOCAL_STD = 0.4
"""Prior std of log focal length without any information: 60° across the larger side, 41° to 84° (1 std)."""
MAX_FOCAL_STD = 0.02
"""Largest relative std of an estimated focal length; above it the camera is refused."""
_DEFAULT_FIELD_OF_VIEW = np.deg2rad(60.0)
_PRINCIPAL_POINT_STD = 0.012  # of the larger image side: distance of principal points from the image centre
_K1_STD, _K2_STD = 0.15, 0.05  # priors of distortion: typical of lenses up to 100 degrees
_SINGULAR_VALUE_NOISE = 0.02  # relative difference of the singular values due to noise
_LOG_FOCAL_STARTS = (-0.5, -0.25, 0.0, 0.25, 0.5)  # of two prior stds from the prior mean of log focal length
LEAST_CAMERAS = 3  # two unknown lenses are undetermined if the optical axes intersect
_FOCAL_TOLERANCE = 0.01  # relative change of the focal length below which it has converged,
_PIXEL_TOLERANCE = 0.01  # px: likewise for the rms change of ball centres that it causes


def initial_self_calibration(
    rig: Rig, prepared: PreparedSession, pairs: list[PairSolution]
) -> tuple[PreparedSession, list[PairSolution]]:
    """The session with its uncalibrated cameras among those to be placed, at initial focal lengths; and its pairs.

    Session and pairs are returned unchanged where no estimate is possible: only the timing of these cameras is known.
    """
    solved = [pair for pair in pairs if pair.solved and pair.fit is not None and pair.fundamental is None]
    connected = {name for pair in solved for name in (pair.a, pair.b)}
    names = [name for name in prepared.uncalibrated if name in connected]
    if prepared.shared_clock or not names:
        return prepared, pairs
    without_nominal = sum(rig.cameras[name].intrinsics is None for name in names)
    if without_nominal and len(connected) < LEAST_CAMERAS:
        return prepared, pairs
    priors = {name: focal_prior(rig, name) for name in names}
    focals = initial_focal_lengths(priors, {name: prepared.camera(name).intrinsics for name in connected}, solved)
    lenses = {name: _with_focal(prepared.uncalibrated[name].intrinsics, focals[name]) for name in names}
    updated = {name: with_lens(prepared, name, lenses[name], priors[name]) for name in names}
    return with_cameras(prepared, updated), [_with_relative_pose(pair, prepared, updated) for pair in pairs]


def focal_prior(rig: Rig, name: str) -> LensPrior:
    """Prior of a lens that was not measured: from the rig (data sheet), or that of an unknown lens."""
    camera = rig.cameras[name]
    lens = camera.intrinsics
    width, height = camera.size
    centre, centre_std = (0.5 * (width - 1), 0.5 * (height - 1)), _PRINCIPAL_POINT_STD * max(width, height)
    k1, k2 = 0.0, 0.0
    focal, std = 0.5 * max(camera.size) / float(np.tan(0.5 * _DEFAULT_FIELD_OF_VIEW)), UNKNOWN_FOCAL_STD
    if lens is not None:
        focal, std = lens.focal, camera.focal_std
        centre = float(lens.matrix[0, 2]), float(lens.matrix[1, 2])
        k1, k2 = float(lens.distortions[0]), float(lens.distortions[1])
    return LensPrior(focal, std, centre, centre_std, k1, _K1_STD, k2, _K2_STD)


def initial_focal_lengths(
    priors: Mapping[str, LensPrior], lenses: Mapping[str, Intrinsics], pairs: list[PairSolution]
) -> dict[str, float]:
    """Focal lengths [px] for which the pairs' matrices come nearest to essential matrices.

    priors: of the uncalibrated cameras. lenses: intrinsics in whose normalised coordinates the pairs' matrices are.
    """
    names = list(priors)
    index_of = {name: i for i, name in enumerate(names)}
    nominal = np.array([lenses[name].focal for name in names])
    mean = np.log(np.array([prior.focal for prior in priors.values()]))
    std = np.array([prior.focal_std for prior in priors.values()])
    terms = [
        (index_of.get(pair.a, -1), index_of.get(pair.b, -1), pair.fit.geometry.matrix)
        for pair in pairs
        if pair.fit is not None and (pair.a in index_of or pair.b in index_of)
    ]
    first = np.array([a for a, _, _ in terms])
    second = np.array([b for _, b, _ in terms])
    matrices = np.array([matrix for _, _, matrix in terms])

    def residual(log_focal: Floats) -> Floats:
        factor = np.r_[np.exp(log_focal) / nominal, 1.0]  # the last: given intrinsics
        scaled = matrices.copy()
        # m_bᵀ M m_a = 0 in coordinates normalised by the nominal focal length; another one scales them by its ratio.
        scaled[:, :2, :] *= factor[second][:, None, None]
        scaled[:, :, :2] *= factor[first][:, None, None]
        values = np.linalg.svd(scaled, compute_uv=False)
        imbalance = (values[:, 0] - values[:, 1]) / (values[:, 0] + values[:, 1])
        # Cauchy's loss as a residual, robust against pairs with a wrong matrix.
        return np.concatenate([np.sqrt(np.log1p((imbalance / _SINGULAR_VALUE_NOISE) ** 2)), (log_focal - mean) / std])

    from scipy.optimize import least_squares  # a tenth of a second to import, only needed without measured lenses

    found = [least_squares(residual, mean + np.minimum(std, 1.0) * 2.0 * shift) for shift in _LOG_FOCAL_STARTS]
    best = min(found, key=lambda one: float(one.cost))
    return {name: float(np.exp(value)) for name, value in zip(names, best.x, strict=True)}


def with_cameras(prepared: PreparedSession, updated: Mapping[str, CameraInput]) -> PreparedSession:
    """The session with these cameras, at their intrinsics, among those to be placed."""
    both = {**prepared.cameras, **updated}
    return replace(
        prepared,
        cameras={name: both[name] for name in prepared.camera_order if name in both},
        rows=prepared.rows | {name: prepared.rows_through(name, camera.intrinsics) for name, camera in updated.items()},
        uncalibrated={name: camera for name, camera in prepared.uncalibrated.items() if name not in updated},
        refused={name: reason for name, reason in prepared.refused.items() if name not in updated},
    )


def with_updated_lenses(
    prepared: PreparedSession, pairs: list[PairSolution], lenses: Mapping[str, Intrinsics]
) -> tuple[PreparedSession, list[PairSolution], bool]:
    """The session with the uncalibrated lenses as an adjustment estimated them, and whether that changed any."""
    changed = {
        name: with_lens(prepared, name, lens, prepared.cameras[name].lens_prior)
        for name, lens in lenses.items()
        if prepared.cameras[name].lens_prior is not None and _lens_changed(prepared, name, lens)
    }
    if not changed:
        return prepared, pairs, False
    return with_cameras(prepared, changed), [_with_relative_pose(pair, prepared, changed) for pair in pairs], True


def _lens_changed(prepared: PreparedSession, name: str, lens: Intrinsics) -> bool:
    """Whether a camera's lens differs from the one with which its tracks were made."""
    if abs(np.log(lens.focal / prepared.cameras[name].intrinsics.focal)) > _FOCAL_TOLERANCE:
        return True
    current = [part.pixels for part in prepared.rows[name]]
    again = [part.pixels for part in prepared.rows_through(name, lens)]
    return bool(np.sqrt(np.mean((np.concatenate(current) - np.concatenate(again)) ** 2)) > _PIXEL_TOLERANCE)


def _with_focal(lens: Intrinsics, focal: float) -> Intrinsics:
    matrix = lens.matrix.copy()
    matrix[:2, :2] *= focal / lens.focal
    return replace(lens, matrix=matrix)


def with_lens(prepared: PreparedSession, name: str, lens: Intrinsics, prior: LensPrior | None) -> CameraInput:
    """A camera with another lens: its tracks are smoothed again from the raw rows."""
    camera = prepared.camera(name)
    tracks = dict(camera.tracks)
    for part in prepared.rows_through(name, lens):
        label = prepared.labels[part.label]
        smooth = smooth_track(part.time, lens.unproject(part.pixels), lens.focal, 0.0, part.relative_std)
        if smooth is not None:
            tracks[label] = smooth
    return CameraInput(name, lens, tracks, prior, stated_std=camera.stated_std)


def _with_relative_pose(
    pair: PairSolution, prepared: PreparedSession, updated: Mapping[str, CameraInput]
) -> PairSolution:
    """A solved pair with a new lens: relative pose estimated again at its lag, or decomposed from its matrix."""
    if pair.fit is None or not pair.solved or not {pair.a, pair.b} & set(updated):
        return pair
    both = [updated.get(name) or prepared.camera(name) for name in (pair.a, pair.b)]
    if any(name in prepared.uncalibrated and name not in updated for name in (pair.a, pair.b)):
        return pair
    a, b = (smooth_only(camera.tracks) for camera in both)
    solution = solve_pair(
        a, b, (pair.a, pair.b), PairSettings(standalone=False), calibrated=True, predicted_lag=pair.fit.lag
    )
    if solution.solved:
        return solution
    # With a focal length a few percent wrong a calibrated pair may fail its tests: the adjustment decides.
    return replace(
        pair, fit=_with_decomposed_pose(pair.fit, [prepared.camera(n) for n in (pair.a, pair.b)], both, a, b)
    )


def _with_decomposed_pose(
    fit: PairFit,
    before: list[CameraInput],
    current: list[CameraInput],
    a: Mapping[str, SmoothTrack],
    b: Mapping[str, SmoothTrack],
) -> PairFit:
    """The fit with the pose nearest to its matrix in the normalised coordinates of the new lenses."""
    factors = [new.intrinsics.focal / old.intrinsics.focal for old, new in zip(before, current, strict=True)]
    matrix = np.diag([factors[1], factors[1], 1.0]) @ fit.geometry.matrix @ np.diag([factors[0], factors[0], 1.0])
    seen_a, seen_b = [], []
    for label in set(a) & set(b):
        points = a[label].at(a[label].time)
        others = b[label].at((a[label].time - fit.offset) / fit.rate)
        good = np.isfinite(points).all(axis=1) & np.isfinite(others).all(axis=1)
        seen_a.append(points[good])
        seen_b.append(others[good])
    pose = relative_pose.decompose_essential(matrix, np.concatenate(seen_a), np.concatenate(seen_b))
    angle = relative_pose.parallax(pose, np.concatenate(seen_a), np.concatenate(seen_b))
    return replace(fit, geometry=pose, parallax=angle)
