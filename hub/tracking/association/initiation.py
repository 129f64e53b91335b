"""New targets from what no target explains: features of at least two cameras, at different times, that fit one body.

A hypothesis is a place, a velocity and a size that moves evenly over a fraction of a second; what other cameras
should then have seen decides between it and a wrong pairing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.tracking.camera_frame import Frame, TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, SIZE, VELOCITY
from hub.tracking.filter.measurement import FOOT, HEAD, PARTS, POINT, doubt, expect, heavy
from hub.tracking.filter.target_models import BODIES
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats, Ints

_LEAST_SINE = 0.05
"""Of the angle between two rays: below it, a crossing tells no distance."""
_COLOUR_REACH = 75.0
_TRIES = 2
_STEPS = 3
_REACH_SIGMAS = 3.5


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """One detection of one camera that no target explains, and when. Arrays as in `measure.measured`."""

    camera: TrackingCamera
    reference_ns: int
    value: Floats
    noise: Floats
    colour: Floats
    kind: int

    @property
    def ray(self) -> Floats:
        """Direction in the world, of depth 1."""
        return np.append(self.value[POINT], 1.0) @ self.camera.pose.rotation


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A hypothesis that holds. mean, covariance: of the state at the anchor's time. chances: cameras that should have
    seen it."""

    mean: Floats
    covariance: Floats
    features: tuple[Feature, ...]
    misfit: float
    chances: int


@dataclass(frozen=True, slots=True)
class Scale:
    """What is known of the world. metre: world units in a metre. metric: whether that is known or only a guess."""

    metre: float = 1.0
    metric: bool = True


def features_of(frame: Frame, value: Floats, noise: Floats, which: Ints) -> tuple[Feature, ...]:
    """The features of some detections of a frame."""
    return tuple(
        Feature(frame.camera, frame.reference_ns, value[j], noise[j], frame.colour[j], int(frame.kind[j]))
        for j in which.tolist()
    )


def hypothesis(
    anchor: Feature,
    pool: dict[str, tuple[Feature, ...]],
    fresh: dict[str, TrackingCamera],
    up: Floats | None,
    scale: Scale,
) -> Found | None:
    """The best new target that explains ``anchor`` and features of other cameras; None if nothing holds.

    pool: unexplained features of every camera's last frame. fresh: cameras with a frame so recent that it should
    show the target.
    """
    others = [f for name, features in pool.items() if name != anchor.camera.name for f in features]
    others = [f for f in others if f.kind == anchor.kind and _alike(anchor.colour, f.colour)]
    if not others:
        return None
    place, gap, reach = _crossings(anchor, others, scale)
    order = np.argsort(gap / reach, kind="stable")
    order = order[(gap / reach)[order] < 1.0]
    best: Found | None = None
    tried: list[Floats] = []
    for index in order[: 3 * _TRIES].tolist():
        if any(np.linalg.norm(place[index] - p) < reach[index] for p in tried) or len(tried) >= _TRIES:
            continue
        tried.append(place[index])
        chosen = _support(anchor, others, place[index], scale)
        found = _fitted(anchor, chosen, place[index], fresh, up, scale)
        if found is not None and (best is None or _better(found, best)):
            best = found
    return best


def _better(one: Found, other: Found) -> bool:
    more = len(one.features) / one.chances - len(other.features) / other.chances
    return more > 0.01 or (more > -0.01 and (-len(one.features), one.misfit) < (-len(other.features), other.misfit))


def _fitted(
    anchor: Feature,
    chosen: list[Feature],
    place: Floats,
    fresh: dict[str, TrackingCamera],
    up: Floats | None,
    scale: Scale,
) -> Found | None:
    """Fit all; while that doesn't hold, without the worst; None below two cameras or where too few of many saw it."""
    while chosen:
        mean, covariance, misfit, freedom, worst = fit((anchor, *chosen), place, up, scale)
        if misfit < chi2_limit(freedom):
            break
        if len(chosen) < 2:
            return None
        chosen = [f for number, f in enumerate(chosen) if number != max(worst - 1, 0)]
    else:
        return None
    names = {anchor.camera.name, *(f.camera.name for f in chosen)}
    chances = len(names)
    for name, camera in fresh.items():
        if name not in names:
            inside = camera.pose.camera_from_world(mean[None, POSITION])
            depth = inside[:, 2]
            with np.errstate(divide="ignore", invalid="ignore"):
                chances += int(camera.sees(inside[:, :2] / depth[:, None], depth)[0])
    if len(names) < 0.5 * chances:
        return None
    return Found(mean, covariance, (anchor, *chosen), misfit / max(freedom, 1), chances)


def fit(
    features: tuple[Feature, ...], place: Floats, up: Floats | None, scale: Scale
) -> tuple[Floats, Floats, float, int, int]:
    """The state (7,) at the first feature's time that explains all features, moving evenly: Gauss-Newton.

    Returns it, its covariance, chi2, its degrees of freedom, and the feature that fits worst.
    """
    body = BODIES[features[0].kind]
    kind = np.array([features[0].kind])
    size_std = body.log_size_std if scale.metric else max(body.log_size_std, 1.0)
    prior = np.zeros(SIZE)
    prior[LOG_SIZE] = np.log(body.size_m * scale.metre)
    information = np.zeros(SIZE)
    information[VELOCITY] = 1.0 / (body.speed_m_s * scale.metre) ** 2
    information[LOG_SIZE] = 1.0 / size_std**2
    information[POSITION] = 1.0 / (1e3 * scale.metre) ** 2
    prior[POSITION] = place
    mean = prior.copy()
    start = features[0].reference_ns
    for step in range(_STEPS + 1):
        hessian = np.diag(information)
        gradient = information * (prior - mean)
        misfits, counts = [], []
        for feature in features:
            elapsed = (feature.reference_ns - start) / NANOSECONDS
            forward = np.eye(SIZE)
            forward[POSITION, VELOCITY] = elapsed * np.eye(3)
            expected = expect(feature.camera, (forward @ mean)[None], kind, up)
            off = feature.value - expected.value[0]
            slope = expected.slope[0] @ forward
            noise = feature.noise + expected.body_noise[0]
            misfit, count = 0.0 if np.isfinite(off[POINT]).all() else np.inf, 0  # inf: behind the camera
            for rows in PARTS:
                if not np.isfinite(off[rows]).all():
                    continue
                weight = np.linalg.inv(noise[rows, rows])
                squared = off[rows] @ weight @ off[rows]
                if rows is HEAD or rows is FOOT:
                    weight, squared = weight / doubt(squared), heavy(squared)
                hessian = hessian + slope[rows].T @ weight @ slope[rows]
                gradient = gradient + slope[rows].T @ weight @ off[rows]
                misfit, count = misfit + float(squared), count + len(weight)
            misfits.append(misfit)
            counts.append(max(count, 1))
        if step < _STEPS:
            mean = mean + np.linalg.solve(hessian, gradient)
    chi2 = sum(misfits) + float((information * (mean - prior) ** 2)[VELOCITY.start :].sum())
    worst = int(np.argmax(np.array(misfits) / np.array(counts)))
    covariance = np.linalg.inv(hessian)
    return mean, 0.5 * (covariance + covariance.T), chi2, max(sum(counts) - 3, 1), worst


def chi2_limit(freedom: int) -> float:
    """What chi2 exceeds once in a thousand (Wilson and Hilferty's approximation)."""
    part = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - part + 3.09 * np.sqrt(part)) ** 3)


def _alike(one: Floats, other: Floats) -> bool:
    off = one - other
    return bool(np.isnan(off).any() or np.sqrt(np.mean(off**2)) < _COLOUR_REACH)


def _crossings(anchor: Feature, others: list[Feature], scale: Scale) -> tuple[Floats, Floats, Floats]:
    """Where the anchor's ray passes nearest to each other ray (n, 3), how near (n,), and how near it should be (n,)."""
    a = anchor.ray
    origin = anchor.camera.pose.position
    rays = np.array([f.ray for f in others])
    origins = np.array([f.camera.pose.position for f in others])
    between = origin - origins
    aa, ab, bb = a @ a, rays @ a, (rays**2).sum(axis=1)
    da, db = between @ a, (rays * between).sum(axis=1)
    determinant = aa * bb - ab**2
    flat = determinant < _LEAST_SINE**2 * aa * bb
    safe = np.where(flat, 1.0, determinant)
    depth_a = (ab * db - bb * da) / safe
    depth_b = (aa * db - ab * da) / safe
    on_a, on_b = origin + depth_a[:, None] * a, origins + depth_b[:, None] * rays
    gap = np.linalg.norm(on_a - on_b, axis=1)
    gap = np.where(flat | (depth_a <= 0.0) | (depth_b <= 0.0), np.inf, gap)
    blur = [_blur(anchor, abs(d)) + _blur(f, abs(e)) for d, e, f in zip(depth_a, depth_b, others, strict=True)]
    elapsed = np.array([f.reference_ns - anchor.reference_ns for f in others]) / NANOSECONDS
    moved = BODIES[anchor.kind].speed_m_s * scale.metre * np.abs(elapsed)
    body = BODIES[anchor.kind]
    loose = body.point_noise * body.size_m * scale.metre * (1.0 if scale.metric else 3.0)
    reach = _REACH_SIGMAS * np.sqrt(np.array(blur) + moved**2 + 2.0 * loose**2)
    return 0.5 * (on_a + on_b), gap, reach


def _blur(feature: Feature, depth: float) -> float:
    """Variance across the ray at a depth."""
    return float(0.5 * np.trace(feature.noise[POINT, POINT]) * depth**2)


def _support(anchor: Feature, others: list[Feature], place: Floats, scale: Scale) -> list[Feature]:
    """The feature of each other camera that is nearest to a place, where one is near enough."""
    best: dict[str, tuple[float, Feature]] = {}
    body = BODIES[anchor.kind]
    loose = body.point_noise * body.size_m * scale.metre * (1.0 if scale.metric else 3.0)
    for feature in others:
        inside = feature.camera.pose.camera_from_world(place[None])[0]
        if inside[2] <= 0.0:
            continue
        miss = float(np.linalg.norm(inside[:2] / inside[2] - feature.value[POINT]) * inside[2])
        moved = body.speed_m_s * scale.metre * abs(feature.reference_ns - anchor.reference_ns) / NANOSECONDS
        reach = _REACH_SIGMAS * np.sqrt(_blur(feature, inside[2]) + moved**2 + 2.0 * loose**2)
        name = feature.camera.name
        if miss < reach and (name not in best or miss / reach < best[name][0]):
            best[name] = (miss / reach, feature)
    return [feature for _, feature in best.values()]
