"""Track initiation from unassociated detections of at least two cameras at different times.

A candidate has a position, a constant velocity over a fraction of a second, and a size. Whether other cameras that
should observe it also do so separates it from a false match.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter import kalman
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, STATE_DIM, VELOCITY
from hub.tracking.filter.measurement import (
    BLOCKS,
    FOOT,
    HEAD,
    POINT,
    predict_measurement,
    student_t_cost,
    student_t_inflation,
)
from hub.tracking.filter.target_models import TARGET_MODELS
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats, Ints

_MIN_SINE = 0.05
"""Of the angle between two rays: below it, their intersection does not determine the depth."""
_COLOUR_GATE = 75.0  # root mean square of the channels: once in 12,000 by chance at the largest std between cameras
_MAX_STARTS = 2  # intersections apart from each other that an anchor is fitted from: each costs a fit
_GAUSS_NEWTON_STEPS = 3  # the linear point is near
_GATE_SIGMAS = 3.5  # once in 2,000 by chance
_MAX_FLOOR_DISTANCE = 40.0
"""Of a person on the floor, in heights: further away, a pixel of the foot is metres on the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class UnassociatedDetection:
    """A detection that is associated with no target, its time, and its index in the frame.

    value, noise: as in `measurements_of`.
    """

    camera: TrackingCamera
    reference_ns: int
    value: Floats
    noise: Floats
    colour: Floats
    kind: int
    index: int = 0

    def heights_below(self, up: Floats) -> float:
        """How far the foot is below the camera, as a fraction of the person's height; NaN unless both ends are seen."""
        rays = (
            np.column_stack([self.value[HEAD.start : FOOT.stop].reshape(2, 2), np.ones(2)]) @ self.camera.pose.rotation
        )
        if not np.isfinite(rays).all():
            return np.nan
        # Distances d along the two rays, in heights: d_head r_head - d_foot r_foot = up, by least squares.
        distances, *_ = np.linalg.lstsq(np.column_stack([rays[0], -rays[1]]), up, rcond=None)
        return np.nan if distances[1] <= 0.0 else -float(distances[1] * rays[1] @ up)

    @property
    def ray(self) -> Floats:
        """Ray direction in world axes, at unit depth."""
        return np.append(self.value[POINT], 1.0) @ self.camera.pose.rotation


@dataclass(frozen=True, slots=True, eq=False)
class TrackCandidate:
    """An accepted candidate. mean, covariance: of the state at the anchor's time. existence: its probability."""

    mean: Floats
    covariance: Floats
    detections: tuple[UnassociatedDetection, ...]
    chi2_per_dof: float
    existence: float


@dataclass(frozen=True, slots=True)
class LengthScale:
    """Scale of the world. units_per_m: world units per metre. metric: whether that is known or only a guess."""

    units_per_m: float = 1.0
    metric: bool = True


def unassociated_detections(
    frame: FrameDetections, value: Floats, noise: Floats, which: Ints
) -> tuple[UnassociatedDetection, ...]:
    """The unassociated detections of a frame; which: their indices."""
    return tuple(
        UnassociatedDetection(
            frame.camera, frame.reference_ns, value[j], noise[j], frame.colour[j], int(frame.kind[j]), j
        )
        for j in which.tolist()
    )


def best_candidate(
    anchor: UnassociatedDetection,
    unassociated: dict[str, tuple[UnassociatedDetection, ...]],
    recent_cameras: dict[str, TrackingCamera],
    up: Floats | None,
    scale: LengthScale,
) -> TrackCandidate | None:
    """The best candidate that explains ``anchor`` and detections of other cameras; None if none is accepted.

    unassociated: by camera, the unassociated detections of its last frame. recent_cameras: cameras with a frame recent
    enough that it should contain the target.
    """
    others = [f for name, detections in unassociated.items() if name != anchor.camera.name for f in detections]
    others = [f for f in others if f.kind == anchor.kind and _similar_colour(anchor.colour, f.colour)]
    if not others:
        return None
    start, miss_distance, gate = _ray_intersections(anchor, others, scale)
    order = np.argsort(miss_distance / gate, kind="stable")
    order = order[(miss_distance / gate)[order] < 1.0]
    best: TrackCandidate | None = None
    tried: list[Floats] = []
    for index in order[: 3 * _MAX_STARTS].tolist():
        if any(np.linalg.norm(start[index] - p) < gate[index] for p in tried) or len(tried) >= _MAX_STARTS:
            continue
        tried.append(start[index])
        support = _nearest_per_camera(anchor, others, start[index], scale)
        found = _fit_with_rejection(anchor, support, start[index], recent_cameras, up, scale)
        if found is not None and (best is None or _is_better(found, best)):
            best = found
    return best


def _is_better(one: TrackCandidate, other: TrackCandidate) -> bool:
    more = one.existence - other.existence
    return more > 0.01 or (
        more > -0.01 and (-len(one.detections), one.chi2_per_dof) < (-len(other.detections), other.chi2_per_dof)
    )


def _fit_with_rejection(
    anchor: UnassociatedDetection,
    support: list[UnassociatedDetection],
    start: Floats,
    recent_cameras: dict[str, TrackingCamera],
    up: Floats | None,
    scale: LengthScale,
) -> TrackCandidate | None:
    """Fit all, rejecting the worst until chi2 passes; None below two cameras or if most viewing cameras disagree."""
    while support:
        mean, covariance, misfit, dof, worst = fit_state((anchor, *support), start, up, scale)
        if misfit < chi2_limit(dof):
            break
        if len(support) < 2:
            return None
        support = [f for number, f in enumerate(support) if number != max(worst - 1, 0)]
    else:
        return None
    names = {anchor.camera.name, *(f.camera.name for f in support)}
    opportunities = len(names)
    for name, camera in recent_cameras.items():
        if name not in names:
            inside = camera.pose.camera_from_world(mean[None, POSITION])
            depth = inside[:, 2]
            with np.errstate(divide="ignore", invalid="ignore"):
                opportunities += int(camera.sees(inside[:, :2] / depth[:, None], depth)[0])
    if len(names) < 0.5 * opportunities:
        return None
    share = len(names) / opportunities
    return TrackCandidate(
        mean, covariance, (anchor, *support), misfit / max(dof, 1), share * (1.0 - 0.5 ** len(support))
    )


def candidate_on(
    floor: Floor, detection: UnassociatedDetection, scale: LengthScale, prior_odds: float
) -> TrackCandidate | None:
    """A person at one detection, who stands on the floor; None if nobody of a person's height could.

    prior_odds: of a new person against a false detection, wherever it is.
    """
    camera, model = detection.camera, TARGET_MODELS[detection.kind]
    height, rotation = floor.height, camera.pose.rotation
    origin = camera.pose.position
    points = ((FOOT, 0.0), (HEAD, height), (POINT, (0.5 + model.point_offset) * height))
    rows, above = next(one for one in points if np.isfinite(detection.value[one[0]]).all())
    ray = np.append(detection.value[rows], 1.0) @ rotation
    centre = origin
    for _ in range(2):  # the second time at the floor's height there
        level = float(floor.heights(centre[None])[0][0]) + above
        down = float(ray @ floor.up)
        distance = (level - float(origin @ floor.up)) / down if down else -1.0
        if not 0.0 < distance < _MAX_FLOOR_DISTANCE * height:
            return None
        centre = origin + distance * ray + (0.5 * height - above) * floor.up
    mean = np.zeros(STATE_DIM)
    mean[POSITION], mean[LOG_SIZE] = centre, np.log(height)
    covariance = np.diag(
        [(_MAX_FLOOR_DISTANCE * height) ** 2] * 3
        + [(model.speed_std_m_s * scale.units_per_m) ** 2] * 3
        + [model.log_size_std**2]
    )
    _, jacobian, variance = floor.constraint(mean[None])
    one = np.ones((1, 1), dtype=np.bool_)
    means, covariances, *_ = kalman.update(
        mean[None], covariance[None], np.zeros((1, 1)), jacobian[:, None], variance[:, None, None], one
    )
    kind = np.array([detection.kind])
    predicted = predict_measurement(camera, means, kind, floor.up)
    used = np.isfinite(detection.value[None]) & np.isfinite(predicted.value)
    innovation = np.where(used, detection.value[None] - predicted.value, 0.0)
    noise = np.where(np.isfinite(detection.noise[None]), detection.noise[None], 0.0) + predicted.model_noise
    means, covariances, squared, _ = kalman.update(means, covariances, innovation, predicted.jacobian, noise, used)
    misfit, dof = float(squared[0]), int(used.sum())
    if not misfit < chi2_limit(dof):
        return None
    odds = prior_odds * np.exp(-0.5 * max(misfit - dof, 0.0))
    return TrackCandidate(means[0], covariances[0], (detection,), misfit / dof, float(odds / (1.0 + odds)))


def fit_state(
    detections: tuple[UnassociatedDetection, ...], start: Floats, up: Floats | None, scale: LengthScale
) -> tuple[Floats, Floats, float, int, int]:
    """Gauss-Newton fit of a constant-velocity state (7,) at the time of the first detection to all detections.

    Returns the state, its covariance, chi2, its degrees of freedom, and the index of the detection that fits worst.
    """
    model = TARGET_MODELS[detections[0].kind]
    kind = np.array([detections[0].kind])
    size_std = model.log_size_std if scale.metric else max(model.log_size_std, 1.0)
    prior = np.zeros(STATE_DIM)
    prior[LOG_SIZE] = np.log(model.size_m * scale.units_per_m)
    information = np.zeros(STATE_DIM)
    information[VELOCITY] = 1.0 / (model.speed_std_m_s * scale.units_per_m) ** 2
    information[LOG_SIZE] = 1.0 / size_std**2
    information[POSITION] = 1.0 / (1e3 * scale.units_per_m) ** 2
    prior[POSITION] = start
    mean = prior.copy()
    start_ns = detections[0].reference_ns
    for step in range(_GAUSS_NEWTON_STEPS + 1):
        # Heights of adults, with the tails that children need: one of 0.9 m is 9 stds away.
        tall = information[LOG_SIZE] * (mean[LOG_SIZE] - prior[LOG_SIZE]) ** 2
        held = information.copy()
        held[LOG_SIZE] /= student_t_inflation(tall)
        hessian = np.diag(held)
        gradient = held * (prior - mean)
        misfits, counts = [], []
        for detection in detections:
            elapsed = (detection.reference_ns - start_ns) / NANOSECONDS
            forward = np.eye(STATE_DIM)
            forward[POSITION, VELOCITY] = elapsed * np.eye(3)
            predicted = predict_measurement(detection.camera, (forward @ mean)[None], kind, up)
            off = detection.value - predicted.value[0]
            jacobian = predicted.jacobian[0] @ forward
            noise = detection.noise + predicted.model_noise[0]
            misfit, count = 0.0 if np.isfinite(off[POINT]).all() else np.inf, 0  # inf: behind the camera
            for rows in BLOCKS:
                if not np.isfinite(off[rows]).all():
                    continue
                weight = np.linalg.inv(noise[rows, rows])
                squared = off[rows] @ weight @ off[rows]
                if rows is HEAD or rows is FOOT:
                    weight, squared = weight / student_t_inflation(squared), student_t_cost(squared)
                hessian = hessian + jacobian[rows].T @ weight @ jacobian[rows]
                gradient = gradient + jacobian[rows].T @ weight @ off[rows]
                misfit, count = misfit + float(squared), count + len(weight)
            misfits.append(misfit)
            counts.append(max(count, 1))
        if step < _GAUSS_NEWTON_STEPS:
            mean = mean + np.linalg.solve(hessian, gradient)
    chi2 = sum(misfits) + float((information * (mean - prior) ** 2)[VELOCITY].sum() + student_t_cost(tall))
    worst = int(np.argmax(np.array(misfits) / np.array(counts)))
    covariance = np.linalg.inv(hessian)
    return mean, 0.5 * (covariance + covariance.T), chi2, max(sum(counts) - 3, 1), worst


def chi2_limit(dof: int) -> float:
    """The 99.9 % quantile of chi2 (Wilson and Hilferty's approximation)."""
    part = 2.0 / (9.0 * dof)
    return float(dof * (1.0 - part + 3.09 * np.sqrt(part)) ** 3)


def _similar_colour(one: Floats, other: Floats) -> bool:
    off = one - other
    return bool(np.isnan(off).any() or np.sqrt(np.mean(off**2)) < _COLOUR_GATE)


def _ray_intersections(
    anchor: UnassociatedDetection, others: list[UnassociatedDetection], scale: LengthScale
) -> tuple[Floats, Floats, Floats]:
    """Midpoints of the anchor's ray and each other ray (n, 3), their miss distances (n,), and gates for those (n,)."""
    a = anchor.ray
    origin = anchor.camera.pose.position
    rays = np.array([f.ray for f in others])
    origins = np.array([f.camera.pose.position for f in others])
    between = origin - origins
    aa, ab, bb = a @ a, rays @ a, (rays**2).sum(axis=1)
    da, db = between @ a, (rays * between).sum(axis=1)
    determinant = aa * bb - ab**2
    near_parallel = determinant < _MIN_SINE**2 * aa * bb
    safe = np.where(near_parallel, 1.0, determinant)
    depth_a = (ab * db - bb * da) / safe
    depth_b = (aa * db - ab * da) / safe
    on_a, on_b = origin + depth_a[:, None] * a, origins + depth_b[:, None] * rays
    miss_distance = np.linalg.norm(on_a - on_b, axis=1)
    miss_distance = np.where(near_parallel | (depth_a <= 0.0) | (depth_b <= 0.0), np.inf, miss_distance)
    blur = [
        _ray_variance(anchor, abs(d)) + _ray_variance(f, abs(e))
        for d, e, f in zip(depth_a, depth_b, others, strict=True)
    ]
    elapsed = np.array([f.reference_ns - anchor.reference_ns for f in others]) / NANOSECONDS
    moved = TARGET_MODELS[anchor.kind].speed_std_m_s * scale.units_per_m * np.abs(elapsed)
    model = TARGET_MODELS[anchor.kind]
    point_std = model.point_std * model.size_m * scale.units_per_m * (1.0 if scale.metric else 3.0)
    gate = _GATE_SIGMAS * np.sqrt(np.array(blur) + moved**2 + 2.0 * point_std**2)
    return 0.5 * (on_a + on_b), miss_distance, gate


def _ray_variance(detection: UnassociatedDetection, depth: float) -> float:
    """Variance across the ray at a depth [world units²]."""
    return float(0.5 * np.trace(detection.noise[POINT, POINT]) * depth**2)


def _nearest_per_camera(
    anchor: UnassociatedDetection, others: list[UnassociatedDetection], start: Floats, scale: LengthScale
) -> list[UnassociatedDetection]:
    """The detection of each other camera that is nearest to a position, where one is within the gate."""
    best: dict[str, tuple[float, UnassociatedDetection]] = {}
    model = TARGET_MODELS[anchor.kind]
    point_std = model.point_std * model.size_m * scale.units_per_m * (1.0 if scale.metric else 3.0)
    for detection in others:
        inside = detection.camera.pose.camera_from_world(start[None])[0]
        if inside[2] <= 0.0:
            continue
        miss = float(np.linalg.norm(inside[:2] / inside[2] - detection.value[POINT]) * inside[2])
        moved = (
            model.speed_std_m_s * scale.units_per_m * abs(detection.reference_ns - anchor.reference_ns) / NANOSECONDS
        )
        gate = _GATE_SIGMAS * np.sqrt(_ray_variance(detection, inside[2]) + moved**2 + 2.0 * point_std**2)
        name = detection.camera.name
        if miss < gate and (name not in best or miss / gate < best[name][0]):
            best[name] = (miss / gate, detection)
    return [detection for _, detection in best.values()]
