"""Lenses that nobody measured: focal lengths from the common path, refined by the adjustment, or refused.

The pairs of such cameras tell lags and fundamental matrices by themselves. An essential matrix has two equal singular
values; the focal lengths for which all pairs' matrices come nearest to that are the start (Mendonça and Cipolla, "A
simple technique for self-calibration", 1999), within a prior: the data sheet's field of view, or 60° give or take.
The adjustment then frees the whole lens of these cameras under priors, and what it is sure of decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hub.bundle.problem import LensPrior, Rows
from hub.calibration.initialisation import Camera
from hub.calibration.preprocessing import Prepared
from hub.sync.alignment import PairFit, PairSettings
from hub.sync.pair_solver import PairSolution, solve_pair
from hub.trajectory.image_tracks import SmoothTrack, smooth_only, smooth_track
from hub.two_view import relative_pose
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

ANY_LENS = 0.4
"""Std of log focal length where nothing is known: 60° across, 41° to 84° (std)."""
LARGEST_STD = 0.02
"""A focal length that the path tells no better is refused."""
_ANY_ANGLE = np.deg2rad(60.0)
_CENTRE_STD = 0.012  # of the picture's width: how far principal points are from its middle
_K1_STD, _K2_STD = 0.15, 0.05
_EQUAL = 0.02  # what noise leaves of the difference of the singular values, relative
_SCALES = (-0.5, -0.25, 0.0, 0.25, 0.5)  # of log focal length, where the search begins
_LEAST_CAMERAS = 3  # two lenses of which nothing is known: axes that meet leave them open
_SAME = 0.01  # a focal length that moved less is settled,
_SAME_PX = 0.01  # and so are balls whose centres moved less by it


def self_calibrated(rig: Rig, prepared: Prepared, pairs: list[PairSolution]) -> tuple[Prepared, list[PairSolution]]:
    """The session with its unmeasured cameras among those to be placed, at a first focal length; and its pairs.

    The same session and pairs where nothing can be told: then only the timing of these cameras is known.
    """
    solved = [pair for pair in pairs if pair.solved and pair.fit is not None and pair.fundamental is None]
    tied = {name for pair in solved for name in (pair.a, pair.b)}
    names = [name for name in prepared.lensless if name in tied]
    if prepared.shared_clock or not names:
        return prepared, pairs
    blind = sum(rig.cameras[name].intrinsics is None for name in names)
    if blind and len(tied) < _LEAST_CAMERAS:
        return prepared, pairs
    priors = {name: prior_of(rig, name) for name in names}
    focals = first_focals(priors, {name: prepared.camera(name).intrinsics for name in tied}, solved)
    guessed = {
        name: _with_lens(prepared, name, _of_focal(prepared.lensless[name].intrinsics, focals[name]), priors[name])
        for name in names
    }
    return moved_in(prepared, guessed), [_with_pose(pair, prepared, guessed) for pair in pairs]


def prior_of(rig: Rig, name: str) -> LensPrior:
    """What the rig tells of a lens that was not measured, or what all lenses have in common."""
    camera = rig.cameras[name]
    lens = camera.intrinsics
    width, height = camera.size
    centre, bent, spread = (0.5 * (width - 1), 0.5 * (height - 1)), (0.0, 0.0), _CENTRE_STD * max(width, height)
    focal, std = 0.5 * max(camera.size) / float(np.tan(0.5 * _ANY_ANGLE)), ANY_LENS
    if lens is not None:
        focal, std = lens.focal, camera.focal_std
        centre = float(lens.matrix[0, 2]), float(lens.matrix[1, 2])
        bent = float(lens.distortions[0]), float(lens.distortions[1])
    return LensPrior(focal, std, centre, spread, bent[0], _K1_STD, bent[1], _K2_STD)


def first_focals(
    priors: Mapping[str, LensPrior], lenses: Mapping[str, Intrinsics], pairs: list[PairSolution]
) -> dict[str, float]:
    """Focal lengths [px] for which the pairs' matrices come nearest to essential ones.

    priors: of the unknown cameras. lenses: those in whose normalised coordinates the pairs' matrices are.
    """
    names = list(priors)
    place = {name: i for i, name in enumerate(names)}
    nominal = np.array([lenses[name].focal for name in names])
    mean = np.log(np.array([prior.focal for prior in priors.values()]))
    std = np.array([prior.focal_std for prior in priors.values()])
    terms = [
        (place.get(pair.a, -1), place.get(pair.b, -1), pair.fit.geometry.matrix)
        for pair in pairs
        if pair.fit is not None and (pair.a in place or pair.b in place)
    ]
    first = np.array([a for a, _, _ in terms])
    second = np.array([b for _, b, _ in terms])
    matrices = np.array([matrix for _, _, matrix in terms])

    def residual(log_focal: Floats) -> Floats:
        factor = np.r_[np.exp(log_focal) / nominal, 1.0]  # the last: given lenses
        scaled = matrices.copy()
        # m_bᵀ M m_a = 0 in coordinates of the nominal focal length; those of another are a factor smaller.
        scaled[:, :2, :] *= factor[second][:, None, None]
        scaled[:, :, :2] *= factor[first][:, None, None]
        values = np.linalg.svd(scaled, compute_uv=False)
        unequal = (values[:, 0] - values[:, 1]) / (values[:, 0] + values[:, 1])
        return np.concatenate([_robust(unequal / _EQUAL), (log_focal - mean) / std])

    from scipy.optimize import least_squares  # a tenth of a second, which rigs of measured lenses are spared

    found = [least_squares(residual, mean + np.minimum(std, 1.0) * 2.0 * shift) for shift in _SCALES]
    best = min(found, key=lambda one: float(one.cost))
    return {name: float(np.exp(value)) for name, value in zip(names, best.x, strict=True)}


def moved_in(prepared: Prepared, guessed: Mapping[str, Camera]) -> Prepared:
    """The session with these cameras, at these lenses, among those to be placed."""
    both = {**prepared.cameras, **guessed}
    return replace(
        prepared,
        cameras={name: both[name] for name in prepared.order if name in both},
        rows=prepared.rows | {name: prepared.seen_through(name, camera.intrinsics) for name, camera in guessed.items()},
        lensless={name: camera for name, camera in prepared.lensless.items() if name not in guessed},
        refused={name: reason for name, reason in prepared.refused.items() if name not in guessed},
    )


def refocused(
    prepared: Prepared, pairs: list[PairSolution], lenses: Mapping[str, Intrinsics]
) -> tuple[Prepared, list[PairSolution], bool]:
    """The session with the guessed lenses that an adjustment found, and whether that changed any."""
    changed = {
        name: _with_lens(prepared, name, lens, prepared.cameras[name].guess)
        for name, lens in lenses.items()
        if prepared.cameras[name].guess is not None and _differ(prepared, name, lens)
    }
    if not changed:
        return prepared, pairs, False
    return moved_in(prepared, changed), [_with_pose(pair, prepared, changed) for pair in pairs], True


def _differ(prepared: Prepared, name: str, lens: Intrinsics) -> bool:
    """Whether a camera's lens is another than the one that its tracks were made with."""
    if abs(np.log(lens.focal / prepared.cameras[name].intrinsics.focal)) > _SAME:
        return True
    now = [part.pixels for part in prepared.rows[name]]
    again = [part.pixels for part in prepared.seen_through(name, lens)]
    return bool(np.sqrt(np.mean((np.concatenate(now) - np.concatenate(again)) ** 2)) > _SAME_PX)


def _robust(ratio: Floats) -> Floats:
    """Cauchy's loss as a residual: a pair whose matrix is wrong shall not decide."""
    return np.asarray(np.sqrt(np.log1p(ratio**2)))


def _of_focal(lens: Intrinsics, focal: float) -> Intrinsics:
    matrix = lens.matrix.copy()
    matrix[:2, :2] *= focal / lens.focal
    return replace(lens, matrix=matrix)


def _with_lens(prepared: Prepared, name: str, lens: Intrinsics, prior: LensPrior | None) -> Camera:
    """A camera seen through another lens: its tracks are made again of the raw rows."""
    camera = prepared.camera(name)
    tracks = dict(camera.tracks)
    for part in prepared.seen_through(name, lens):
        label = prepared.labels[part.label]
        smooth = _smooth(part, lens)
        if smooth is not None:
            tracks[label] = smooth
    return Camera(name, lens, tracks, prior)


def _smooth(part: Rows, lens: Intrinsics) -> SmoothTrack | None:
    return smooth_track(part.time, lens.unproject(part.pixels), lens.focal, 0.0)


def _with_pose(pair: PairSolution, prepared: Prepared, guessed: Mapping[str, Camera]) -> PairSolution:
    """A solved pair of which a lens is new: at its lag the relative pose, asked for afresh or made of its matrix."""
    if pair.fit is None or not pair.solved or not {pair.a, pair.b} & set(guessed):
        return pair
    both = [guessed.get(name) or prepared.camera(name) for name in (pair.a, pair.b)]
    if any(name in prepared.lensless and name not in guessed for name in (pair.a, pair.b)):
        return pair
    a, b = (smooth_only(camera.tracks) for camera in both)
    answer = solve_pair(a, b, (pair.a, pair.b), PairSettings(firm=False), calibrated=True, near=pair.fit.lag)
    if answer.solved:
        return answer
    # A focal length a few percent off leaves too much for a calibrated pair: the adjustment decides.
    return replace(pair, fit=_decomposed(pair.fit, [prepared.camera(n) for n in (pair.a, pair.b)], both, a, b))


def _decomposed(
    fit: PairFit, before: list[Camera], now: list[Camera], a: Mapping[str, SmoothTrack], b: Mapping[str, SmoothTrack]
) -> PairFit:
    """The fit with the pose nearest to its matrix in the new lenses' coordinates."""
    factors = [new.intrinsics.focal / old.intrinsics.focal for old, new in zip(before, now, strict=True)]
    matrix = np.diag([factors[1], factors[1], 1.0]) @ fit.geometry.matrix @ np.diag([factors[0], factors[0], 1.0])
    seen_a, seen_b = [], []
    for label in set(a) & set(b):
        points = a[label].at(a[label].time)
        others = b[label].at((a[label].time - fit.offset) / fit.rate)
        good = np.isfinite(points).all(axis=1) & np.isfinite(others).all(axis=1)
        seen_a.append(points[good])
        seen_b.append(others[good])
    pose = relative_pose.decompose(matrix, np.concatenate(seen_a), np.concatenate(seen_b))
    angle = relative_pose.parallax(pose, np.concatenate(seen_a), np.concatenate(seen_b))
    return replace(fit, geometry=pose, parallax=angle)
