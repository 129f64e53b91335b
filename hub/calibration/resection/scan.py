"""Lag of one camera against a known trajectory: resection at every lag, where a common clock bounds the right one.

A trajectory in 3-D says more about a camera than its pairs do: also motion in one plane, or of which each other camera
saw a part, determines its pose. But resection has six free parameters at every lag, so a wrong one may fit a short or
smooth motion. Therefore the best of all lags must also be the one that the times of arrival (or NTP, PTP) imply: two
independent sources agree, and neither a wrong arrival nor a wrong fit alone gives a wrong lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np
from numpy.fft import irfft, rfft

from hub.bundle.clock_steps import STEP_SIZES, best_split
from hub.bundle.initialisation import CameraInput, Reconstruction, observation_times, seen_by_two
from hub.bundle.problem import CameraState, Trajectory
from hub.clocks.clock_graph import TimeMapEstimate
from hub.sync.lag_scan import fast_length, grid_tracks
from hub.trajectory.image_tracks import ImageTrack, SmoothTrack
from protocols.geometry.types import Floats

_SAMPLES = 80
"""Points of a track, evenly along its path in the image: where the target rests, more of them tell nothing."""
MIN_POINTS = 16  # rows: more than the twelve unknowns of a linear resection
_STEP_S = 0.1  # s: of the lag scan, refined afterwards
_FINE_STEPS = 5  # finer by this factor, twice: to 4 ms
TRUNCATION_PX = 20.0
"""Residual from which a point counts as not explained; so does one outside the trajectory."""
_MIN_EXPLAINED = 0.3  # share of the truncated cost that the best lag has to remove
_DISTINCT_S = 0.5  # s: nearer lags are one candidate
_MIN_COST_RATIO = 1.1
"""Cost of the next best lag over the best one's."""
_CANDIDATES, _CANDIDATES_PER_OCTAVE = 12, 3
"""Lags that are verified in all, and per octave of support: each costs ten resections of some 0.3 ms."""
_MIN_COMMON_S = 3.0
"""Common motion [s] without which a lag is not scanned."""
_SCALES = [np.array([mirror * scale, scale]) for mirror in (1.0, -1.0) for scale in np.geomspace(0.5, 2.0, 17)]
"""Scales of an image about its centre, mirrored or not, that are tried where a camera fits at no lag: no view is so
wide or narrow that a lens is mistaken by more."""
_SMALLER_IMAGES = (2, 3, 4)  # whole parts of a picture that detectors are given to save time
_SCALE_STEPS = (1.04, 1.02, 1.01, 1.005)  # half of the step of _SCALES, then half of that, and so on
LIKELY_CANDIDATES, _MIN_SCALE_CHANGE = 4, 0.03
"""Candidates of the moment scan, which does not use the lens, whose scale is searched; scale that the lens gives."""
_TRIMS = 2  # fits of a pose to the better half of the points
MIN_INLIERS, MIN_CANDIDATE_RATIO = 0.8, 4.0
"""Share of the common rows that a time map without any bound from a clock has to explain, and cost of the next best."""


def scan_resection(
    camera: CameraInput, reconstruction: Reconstruction, expected: TimeMapEstimate, window: float
) -> tuple[TimeMapEstimate | None, str]:
    """The camera's time map if one lag explains its track by far best and agrees with the expected one; else why not.

    expected: time map onto the reconstruction's internal time by a common clock, right within ``window`` [s].
    """
    tracks = [
        (number, track)
        for number, label in enumerate(reconstruction.labels)
        if isinstance(track := camera.tracks.get(label), SmoothTrack)
    ]
    samples = [(number, *along_path(track)) for number, track in tracks]
    if not samples:
        return None, "no label that the others saw"
    state = CameraState(
        camera.intrinsics, reconstruction.state.cameras[0].pose, expected.rate, expected.offset, expected.centre
    )
    begin = min(path.basis.begin for path in reconstruction.state.trajectories)
    end = max(path.basis.end for path in reconstruction.state.trajectories)
    own = np.concatenate([state.reference_time(time) for _, time, _ in samples])
    lags = np.arange(np.ceil((begin - own.max()) / _STEP_S), np.floor((end - own.min()) / _STEP_S) + 1) * _STEP_S
    focal = camera.intrinsics.focal
    costs = np.array([_cost(samples, reconstruction, state, lag, focal) for lag in lags])
    if not len(costs) or not np.isfinite(costs).any():
        return None, "too little seen together with the other cameras"
    fine, best = float(lags[int(np.argmin(costs))]), float(costs.min())
    for step in (_STEP_S / _FINE_STEPS, _STEP_S / _FINE_STEPS**2):
        near = fine + step * np.arange(1 - _FINE_STEPS, _FINE_STEPS)
        near_costs = [_cost(samples, reconstruction, state, lag, focal) for lag in near]
        fine, best = float(near[int(np.argmin(near_costs))]), min(best, float(np.min(near_costs)))
    if best > (1.0 - _MIN_EXPLAINED) * TRUNCATION_PX**2:
        return None, "its view of the trajectory agrees with no lag yet"
    other = float(costs[np.abs(lags - fine) > _DISTINCT_S].min(initial=np.inf))
    if abs(fine) > window:
        return None, "the lag that fits best is not the one of the arrival times"
    if other < _MIN_COST_RATIO * best:
        return None, f"another lag fits nearly as well (cost ratio {other / max(best, 1e-9):.1f})"
    return replace(expected, offset=expected.offset + fine), ""


def along_path(track: ImageTrack) -> tuple[Floats, Floats]:
    """Times (m,) and normalised points (m, 2) evenly along the track's path in the image."""
    steps = np.linalg.norm(np.diff(track.points, axis=0), axis=1)
    steps = np.minimum(steps, 3.0 * float(np.median(steps)) + 1e-12)  # false detections are long jumps
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], _SAMPLES))
    index = np.unique(np.clip(at, 0, len(travelled) - 1))
    return track.time[index], track.points[index]


def _cost(
    samples: list[tuple[int, Floats, Floats]],
    reconstruction: Reconstruction,
    state: CameraState,
    lag: float,
    focal: float,
) -> float:
    """Mean truncated squared residual [px²] of the best pose at a lag; inf without enough points."""
    world, image, count = [], [], 0
    for number, time, points in samples:
        where = reconstruction.state.trajectories[number].at(state.reference_time(time) + lag)
        good = np.isfinite(where).all(axis=1)
        world.append(where[good])
        image.append(points[good])
        count += len(time)
    positions, seen = np.concatenate(world), np.concatenate(image)
    if len(positions) < MIN_POINTS:
        return float("inf")
    residual = resected_residuals(positions, seen, positions, seen, focal)
    if not np.isfinite(residual).any():
        return float("inf")
    explained = np.minimum(residual, TRUNCATION_PX) ** 2
    return float((explained.sum() + (count - len(positions)) * TRUNCATION_PX**2) / count)


@dataclass(frozen=True, slots=True)
class TimeMapCandidate:
    """One lag of the moment scan. rate: internal seconds per second of the camera's track. offset: internal time [s] of
    track time 0. score: cost over the median cost at lags with similar support."""

    rate: float
    offset: float
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class SeenLabel:
    """A label of the camera: its track, the path that the others give, and their times of it by camera."""

    track: SmoothTrack
    path: Trajectory
    observed: list[Floats]


Sample: TypeAlias = tuple[SeenLabel, Floats, Floats]
"""A label, and times (n,) and normalised points (n, 2) evenly along its track."""


@dataclass(frozen=True, slots=True, eq=False)
class _PathMoments:
    """The paths on a grid from internal time ``begin``: products (10, labels, times) of the homogeneous points."""

    begin: float
    products: Floats


def find_time_map(
    camera: CameraInput, reconstruction: Reconstruction, rates: Sequence[float]
) -> tuple[TimeMapEstimate | None, str]:
    """Time map of a camera from its view of a solved path, over all lags and the given rates; else why there is none.

    With both, its clock seems to step, and the map holds for the longer part.

    rates: the nominal one first; where no lag fits at it, the camera is also tried with other focal lengths.

    The resection of every lag comes from the same sums over the rows (`moment_scan`), so a rate costs as much as some
    correlations. The best candidates are verified by a calibrated resection, which has to be by far the best of all
    lags, to explain most of the common rows, and to predict either half of them from the other half. Where none does,
    the same is asked of candidates with a clock step.
    """
    labels = seen_labels(camera, reconstruction)
    if not labels:
        return None, "no label that the others saw"
    moments, samples = path_moments(labels), [(one, *along_path(one.track)) for one in labels]
    nominal = sorted(moment_scan(labels, moments, rates[0]), key=lambda one: one.score)
    verified = [verify(one, samples, camera) for one in nominal[:LIKELY_CANDIDATES]]
    if verified and _misfit(verified):
        reason = _other_image(camera, samples, nominal[:LIKELY_CANDIDATES], verified)
        if reason:
            return None, reason
    found = [candidate for rate in rates[1:] for candidate in moment_scan(labels, moments, rate)]
    found = sorted([*found, *nominal[LIKELY_CANDIDATES:]], key=lambda one: one.score)[: _CANDIDATES - len(verified)]
    verified += [verify(one, samples, camera) for one in found]
    if not verified:
        return None, "too little seen together with the other cameras"
    if reason := _misfit(verified):
        likely = nominal[:LIKELY_CANDIDATES]
        verified += [one for candidate in likely for one in _verify_with_step(candidate, samples, camera)]
        if _misfit(verified):
            return None, reason
    best, reason = _best_and_next(verified)[0], ""
    if best.step is not None:
        size, at = 1e3 * (best.step.after - best.step.before), best.step.time + labels[0].track.time_origin
        reason = f"its clock seems to step by {size:+.0f} ms at its time {at:.1f} s"
    centre = 0.5 * (min(float(one.track.time[0]) for one in labels) + max(float(one.track.time[-1]) for one in labels))
    return TimeMapEstimate(best.rate, best.rate * centre + best.offset, centre), reason


def seen_labels(camera: CameraInput, reconstruction: Reconstruction) -> list[SeenLabel]:
    """The labels of a camera whose path two others give: where it and one other see it, the path follows both."""
    own = reconstruction.names.index(camera.name) if camera.name in reconstruction.names else None
    return [
        SeenLabel(track, reconstruction.state.trajectories[i], observed)
        for i, label in enumerate(reconstruction.labels)
        if isinstance(track := camera.tracks.get(label), SmoothTrack)
        for observed in [observation_times(reconstruction.problem, reconstruction.state, i, own)]
    ]


def path_moments(labels: list[SeenLabel]) -> _PathMoments | None:
    """Moments of the paths where two cameras saw them; None where that is nowhere."""
    begin, end = min(one.path.basis.begin for one in labels), max(one.path.basis.end for one in labels)
    time = np.asarray(begin + _STEP_S * np.arange(int((end - begin) / _STEP_S) + 1), dtype=np.float64)
    world = np.stack([one.path.at(time) for one in labels])
    present = np.isfinite(world).all(axis=2) & np.stack([seen_by_two(one.observed, time) for one in labels])
    if not present.any():
        return None
    middle, spread = world[present].mean(axis=0), float(world[present].std()) or 1.0
    scaled = np.where(present[:, :, None], (world - middle) / spread, 0.0)
    homogeneous = np.concatenate([scaled, present[:, :, None]], axis=2)
    first, second = np.triu_indices(4)
    return _PathMoments(begin, (homogeneous[:, :, first] * homogeneous[:, :, second]).transpose(2, 0, 1))


def moment_scan(
    labels: list[SeenLabel], moments: _PathMoments | None, rate: float, part: tuple[float, float] = (0.0, 1.0)
) -> list[TimeMapCandidate]:
    """The best lags in each octave of support by the direct linear transform, from 40 correlations by FFT.

    part: of the camera's rows only those between these shares of its time.

    Over the camera matrix with rows p1, p2, p3 the squared image residual is that of p1 X - u p3 X and p2 X - v p3 X
    over (p3 X)². p1 and p2 follow from p3 (Schur complement), which leaves a generalised eigenvalue of order four.
    """
    if moments is None:
        return []
    products, instants = moments.products, moments.products.shape[2]
    grid = grid_tracks([one.track.scaled(rate) for one in labels], _STEP_S, 0.5)
    u, v = grid.points[:, :, 0], grid.points[:, :, 1]
    share = (np.arange(u.shape[1]) + 0.5) / u.shape[1]
    weight = grid.weight * ((share > part[0]) & (share < part[1]))
    image = weight * np.stack([np.ones_like(u), u, v, u**2 + v**2])
    length = fast_length(instants + u.shape[1])
    spectra, others = rfft(products, length), np.conj(rfft(image, length))
    sums = np.stack([irfft(np.einsum("plm,lm->pm", spectra, one), length) for one in others])
    lags = np.arange(-(u.shape[1] - 1), instants)
    sums = sums[:, :, lags % length]
    support = sums[0, -1] * _STEP_S
    enough = np.flatnonzero(support > _MIN_COMMON_S)
    if not len(enough):
        return []
    first, second = np.triu_indices(4)
    index = np.zeros((4, 4), dtype=np.int64)
    index[first, second] = index[second, first] = np.arange(len(first))
    one, by_u, by_v, square = (part[index][:, :, enough].transpose(2, 0, 1) for part in sums)
    one = one + 1e-6 * np.trace(one, axis1=1, axis2=2)[:, None, None] * np.eye(4)
    inverse = np.linalg.inv(one)
    reduced = square - by_u @ inverse @ by_u - by_v @ inverse @ by_v
    root = np.linalg.inv(np.linalg.cholesky(one))
    cost = np.maximum(np.linalg.eigvalsh(root @ reduced @ root.transpose(0, 2, 1))[:, 0], 1e-9)
    out: list[TimeMapCandidate] = []
    octave = np.floor(np.log2(support[enough]))
    for value in np.unique(octave):
        mine = np.flatnonzero(octave == value)
        typical = float(np.median(cost[mine]))
        taken: list[int] = []
        for k in mine[np.argsort(cost[mine], kind="stable")]:
            if all(abs(enough[k] - enough[other]) * _STEP_S > _DISTINCT_S for other in taken):
                taken.append(int(k))
                offset = moments.begin + lags[enough[k]] * _STEP_S - grid.begin
                out.append(TimeMapCandidate(rate, float(offset), float(cost[k]) / typical))
            if len(taken) == _CANDIDATES_PER_OCTAVE:
                break
    return out


@dataclass(frozen=True, slots=True)
class _Step:
    """What a clock step adds to camera times [s] before and from ``time`` on; one of them is 0."""

    time: float
    before: float
    after: float


@dataclass(frozen=True, slots=True)
class _Verified:
    """A candidate after resection at the best lag near it.

    scale: (2,) of the image against the given lens's. cost: mean truncated squared residual [px²] of the common rows;
    inliers: share of them below the truncation; predicts: whether either half of them predicts the other.
    """

    rate: float
    offset: float
    scale: Floats
    cost: float
    inliers: float
    predicts: bool
    step: _Step | None = None

    @property
    def fits(self) -> bool:
        return self.inliers >= MIN_INLIERS and self.predicts


def common_rows(
    samples: list[Sample], rate: float, offset: float, step: _Step | None = None
) -> tuple[Floats, Floats, Floats]:
    """Positions (n, 3), image points (n, 2) and internal times (n,) of the rows where two others saw the path."""
    world, image, times = [], [], []
    for label, time, points in samples:
        even = time if step is None else time - np.where(time < step.time, step.before, step.after)
        internal = np.asarray(rate * even + offset, dtype=np.float64)
        where = label.path.at(internal)
        good = np.isfinite(where).all(axis=1) & seen_by_two(label.observed, internal)
        world.append(where[good])
        image.append(points[good])
        times.append(internal[good])
    return np.concatenate(world), np.concatenate(image), np.concatenate(times)


def verify(
    candidate: TimeMapCandidate,
    samples: list[Sample],
    camera: CameraInput,
    scales: Sequence[Floats] = (),
    step: _Step | None = None,
) -> _Verified:
    """The candidate at the best lag near it, with the lens as it is given or at the best of ``scales``."""

    @lru_cache(maxsize=1)
    def common(offset: float) -> tuple[Floats, Floats, Floats]:
        return common_rows(samples, candidate.rate, offset, step)

    def cost(offset: float, scale: Floats) -> float:
        positions, seen, _ = common(offset)
        if len(positions) < MIN_POINTS:
            return TRUNCATION_PX**2
        seen, focal = seen * scale, camera.intrinsics.focal / float(scale[1])
        residual = resected_residuals(positions, seen, positions, seen, focal)
        return float((np.minimum(residual, TRUNCATION_PX) ** 2).mean())

    scale, offset = min(scales, key=lambda one: cost(candidate.offset, one), default=np.ones(2)), candidate.offset
    lowest = cost(offset, scale)
    for change in (_STEP_S / 2, _STEP_S / 4, _STEP_S / 8, _STEP_S / 16):
        for trial in (offset - change, offset + change):
            there = cost(trial, scale)
            if there < lowest:
                offset, lowest = trial, there
    for factor in _SCALE_STEPS if len(scales) else ():
        scale = min((scale, scale * factor, scale / factor), key=lambda one: cost(offset, one))
    positions, seen, when = common(offset)
    seen, focal = seen * scale, camera.intrinsics.focal / float(scale[1])
    if len(positions) < MIN_POINTS:
        return _Verified(candidate.rate, offset, scale, TRUNCATION_PX**2, 0.0, False, step)
    residual = resected_residuals(positions, seen, positions, seen, focal)
    late = when > np.median(when)
    halves = (
        resected_residuals(positions[part], seen[part], positions[~part], seen[~part], focal) for part in (late, ~late)
    )
    predicts = all(float(np.median(one)) < TRUNCATION_PX for one in halves)
    truncated = float((np.minimum(residual, TRUNCATION_PX) ** 2).mean())
    inliers = float((residual < TRUNCATION_PX).mean())
    return _Verified(candidate.rate, offset, scale, truncated, inliers, predicts, step)


def _verify_with_step(candidate: TimeMapCandidate, samples: list[Sample], camera: CameraInput) -> list[_Verified]:
    """The candidate with the clock step that fits best where either half of its rows gives pose and lag.

    A step is in one of the halves; the other one, which it does not touch, is of the longer part.
    """
    times = np.concatenate([time for _, time, _ in samples])
    image = np.concatenate([points for _, _, points in samples])
    order, middle, out = np.argsort(times, kind="stable"), float(np.median(times)), []
    for late in (False, True):
        half = [(label, time[part], at[part]) for label, time, at in samples for part in [(time >= middle) == late]]
        placed = verify(candidate, half, camera)
        if placed.inliers < MIN_INLIERS:
            continue
        near = replace(candidate, offset=placed.offset)
        pose, costs = resect(*common_rows(half, near.rate, near.offset)[:2]), []
        for size in STEP_SIZES:
            moved = [label.path.at(near.rate * (time - size) + near.offset) for label, time, _ in samples]
            residual = _reprojection(pose, np.concatenate(moved), image, camera.intrinsics.focal)
            costs.append(np.minimum(residual, TRUNCATION_PX)[order] ** 2)
        out.append(verify(near, samples, camera, step=_Step(*best_split(times[order], np.array(costs))[:3])))
    return out


def _misfit(verified: list[_Verified]) -> str:
    """Why none of the candidates is by far the best and fits; "" where one is and does."""
    best, other = _best_and_next(verified)
    if not best.fits:
        return "its view of the path that the others agree on fits at no lag and no frame rate"
    if best.cost * MIN_CANDIDATE_RATIO > other:
        return f"another lag fits nearly as well (cost ratio {other / max(best.cost, 1e-9):.1f})"
    return ""


def other_image(camera: CameraInput, reconstruction: Reconstruction) -> str:
    """What is wrong with a camera that was not accepted, if with another lens, or as another image, it fits the path of
    the others; else ""."""
    labels = seen_labels(camera, reconstruction)
    if not labels:
        return ""
    samples = [(one, *along_path(one.track)) for one in labels]
    likely = sorted(moment_scan(labels, path_moments(labels), 1.0), key=lambda one: one.score)[:LIKELY_CANDIDATES]
    return _other_image(camera, samples, likely, [verify(one, samples, camera) for one in likely]) if likely else ""


def _other_image(
    camera: CameraInput, samples: list[Sample], likely: list[TimeMapCandidate], verified: list[_Verified]
) -> str:
    """What is wrong with a camera whose image fits by far best at another scale than its lens's; "" if none fits.

    verified: the ``likely`` candidates with the lens as it is given.
    """
    for factor in _SMALLER_IMAGES:
        shift = (factor - 1.0) * camera.intrinsics.matrix[:2, 2] / np.diag(camera.intrinsics.matrix)[:2]
        enlarged = [(label, time, factor * points + shift) for label, time, points in samples]
        if not _misfit([verify(one, enlarged, camera) for one in likely]):
            return (
                f"its rows are pixels of pictures of 1/{factor} the size: so they fit the path that the others agree on"
            )
    if not _misfit(verified):
        return ""
    scaled = [verify(one, samples, camera, _SCALES) for one in likely]
    scale = _best_and_next(scaled)[0].scale
    if _misfit(scaled) or abs(scale[0] - 1.0) < _MIN_SCALE_CHANGE:
        return ""
    if scale[0] < 0.0:
        return "its image is mirrored: so it fits the path that the others agree on"
    return (
        "its lens is wrong: its view of the path that the others agree on fits with a focal length "
        f"{1.0 / scale[1]:.2f} times the given one"
    )


def _best_and_next(verified: list[_Verified]) -> tuple[_Verified, float]:
    """The verified candidate that costs least, and the cost of the next one at another time map."""
    best = min(verified, key=lambda one: one.cost)
    others = (
        one.cost for one in verified if abs(one.rate - best.rate) > 1e-3 or abs(one.offset - best.offset) > _DISTINCT_S
    )
    return best, min(others, default=TRUNCATION_PX**2)


def resected_residuals(positions: Floats, seen: Floats, others: Floats, others_seen: Floats, focal: float) -> Floats:
    """Residuals [px] of ``others`` under the pose that fits ``positions`` best; inf behind the camera.

    Where not all points are explained, the pose is fitted again to the better half: one false detection in twenty, far
    off and always in one place, displaces a pose by 7 to 17 px.
    """
    pose = resect(positions, seen)
    for _ in range(_TRIMS):
        residual = _reprojection(pose, positions, seen, focal)
        typical = float(np.median(residual))
        if float(residual.max()) < TRUNCATION_PX or not np.isfinite(typical):
            break
        pose = resect(positions[residual <= typical], seen[residual <= typical])
    return _reprojection(pose, others, others_seen, focal)


def resect(positions: Floats, seen: Floats) -> tuple[Floats, Floats] | None:
    """Rotation and shift of a camera by its view of points; None where there is none."""
    try:
        found, rotation, shift = cv2.solvePnP(positions, seen, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # all points in one place
        return None
    return (np.asarray(cv2.Rodrigues(rotation)[0]), np.asarray(shift.ravel())) if found else None


def _reprojection(pose: tuple[Floats, Floats] | None, positions: Floats, seen: Floats, focal: float) -> Floats:
    if pose is None:
        return np.full(len(positions), np.inf)
    local = positions @ pose[0].T + pose[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = focal * np.linalg.norm(local[:, :2] / local[:, 2:] - seen, axis=1)
    return np.where((local[:, 2] > 0) & np.isfinite(residual), residual, np.inf)
