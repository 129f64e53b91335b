"""Particle set of the target's state on the ground: free motion while visible, motion along road paths while not."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from edge.uav.ground.image_plane import apply_homography
from edge.uav.prediction.driver_model import LATERAL_MEDIAN, DriverModel
from edge.uav.prediction.particle_filter import KldSampleSize, effective_sample_size, systematic_resample
from edge.uav.prediction.paths import RoadPath
from edge.uav.target.motion_history import MotionFit
from protocols.geometry.types import Floats, Ints

NO_PATH = -1
"""Path index of a particle that follows no path."""
_LOOKAHEADS = (1.0, 5.0, 10.0, 18.0)  # distances along the path at which a driver considers curvature [units]
_BRAKING_DECELERATION = 2.5  # before a bend [units/s²]
_MAX_LATERAL_LIMIT = 6.0  # friction limit of tyres [units/s²]
_CRUISE_TIME_CONSTANT_S = 2.5  # of the return to the cruise speed
_MAX_CRUISE_ACCELERATION = 2.0  # of that return [units/s²]
_MAX_SPEED = 60.0  # [units/s] 216 km/h where a unit is a metre: faster than cars on roads
_VELOCITY_STD_LIMITS = (0.7, 3.0)  # of a particle set's velocity [units/s]
_ACCELERATION_PERSISTENCE = 0.35  # share of the acceleration at the last detection that persists
_MIN_SIGNIFICANCE = 1.5  # of an acceleration, in stds
_MIN_INTENDED_ACCELERATION = 1.0  # of a lasting change of speed [units/s²]
_ACCELERATION_TIME_CONSTANT_S = 1.5  # of a change of speed


@dataclass(frozen=True, slots=True, eq=False)
class ParticleSet:
    """n weighted car states. position: (n, 2) ground; heading, speed, acceleration, curvature: (n,).

    path: (n,) index of the path followed, or NO_PATH; arc_length, lateral_offset: (n,) coordinates on it.
    cruise_speed, lateral_limit: (n,) driver parameters [units/s], [units/s²]. weights: (n,), sum 1.
    """

    position: Floats
    heading: Floats
    speed: Floats
    acceleration: Floats
    curvature: Floats
    path: Ints
    arc_length: Floats
    lateral_offset: Floats
    cruise_speed: Floats
    lateral_limit: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.weights)

    def select(self, index: Ints) -> ParticleSet:
        """The particles of an index (m,), of equal weight."""
        chosen = {one.name: getattr(self, one.name)[index] for one in fields(self)}
        return ParticleSet(**chosen | {"weights": np.full(len(index), 1.0 / len(index))})

    def reweighted(self, likelihood: Floats) -> ParticleSet:
        """Background-aware tracking paper, eq. 2.1: weights times likelihoods (n,), normalised."""
        weights = self.weights * likelihood
        total = float(weights.sum())
        if not (np.isfinite(total) and total > 1e-290):
            return self
        return replace(self, weights=weights / total)

    def resampled(self, rng: np.random.Generator, number: KldSampleSize) -> ParticleSet:
        """Systematic resampling if the effective sample size is below half; the number follows the spread."""
        n = len(self)
        if effective_sample_size(self.weights) > 0.5 * n:
            return self
        indices = systematic_resample(self.weights, n, rng)
        wanted = number.size_for(self.position[indices])
        if wanted != n:
            indices = systematic_resample(self.weights, wanted, rng)
        return self.select(indices)

    def mean_velocity(self) -> tuple[Floats, float]:
        """Mean (2,) and std of one coordinate, within _VELOCITY_STD_LIMITS [units/s]."""
        velocities = self.speed[:, None] * np.column_stack([np.cos(self.heading), np.sin(self.heading)])
        mean = self.weights @ velocities
        variance = float(self.weights @ np.square(velocities - mean).sum(axis=1)) / 2.0
        return np.asarray(mean), float(np.clip(np.sqrt(variance), *_VELOCITY_STD_LIMITS))

    def without_paths(self) -> ParticleSet:
        """All particles in free motion."""
        return replace(self, path=np.full(len(self), NO_PATH))

    def transformed(self, new_from_old: Floats) -> ParticleSet:
        """Transformed to another ground frame."""
        position = apply_homography(new_from_old, self.position)
        interval = apply_homography(
            new_from_old, self.position + 0.5 * np.column_stack([np.cos(self.heading), np.sin(self.heading)])
        )
        step = interval - position
        scale = np.hypot(step[:, 0], step[:, 1]) / 0.5
        return replace(
            self,
            position=position,
            heading=np.arctan2(step[:, 1], step[:, 0]),
            speed=self.speed * scale,
            cruise_speed=self.cruise_speed * scale,
            acceleration=self.acceleration * scale,
            curvature=self.curvature / np.maximum(scale, 1e-6),
            path=np.full(len(self), NO_PATH),
        )


def initialise(position: Floats, std: float, count: int, rng: np.random.Generator) -> ParticleSet:
    """Particles about a position (2,) with unknown motion."""
    zeros = np.zeros(count)
    positions, headings = position + rng.normal(0.0, std, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    return _off_paths(positions, headings, np.abs(rng.normal(0.0, 14.0, count)), zeros, zeros)


def _off_paths(
    position: Floats, heading: Floats, speed: Floats, acceleration: Floats, curvature: Floats
) -> ParticleSet:
    """Particles that follow no path."""
    zeros, path, limit = 0.0 * speed, np.full(len(speed), NO_PATH), np.full(len(speed), LATERAL_MEDIAN)
    weights = np.full(len(speed), 1.0 / len(speed))
    return ParticleSet(position, heading, speed, acceleration, curvature, path, zeros, zeros, speed, limit, weights)


def sample_from_fit(
    fit: MotionFit,
    position: Floats,
    std: float,
    count: int,
    rng: np.random.Generator,
    persistence: float = _ACCELERATION_PERSISTENCE,
) -> ParticleSet:
    """Particles about a position (2,) sampled from the motion fit and its uncertainty.

    persistence: share of the acceleration that persists.
    """
    velocity = fit.velocity + rng.normal(0.0, fit.velocity_std, (count, 2))
    shrink = 1.0 / (1.0 + np.square(fit.acceleration_std / max(2.0, 0.17 * fit.speed)))
    noise = rng.normal(0.0, min(fit.acceleration_std, 1.0), count)
    curvature = np.clip(fit.turn_rate / max(fit.speed, 2.0) + rng.normal(0.0, 0.01, count), -0.15, 0.15)
    return _off_paths(
        position + rng.normal(0.0, std, (count, 2)),
        np.arctan2(velocity[:, 1], velocity[:, 0]),
        np.hypot(velocity[:, 0], velocity[:, 1]),
        persistence * shrink * fit.longitudinal_acceleration + noise,
        curvature,
    )


def propagate(
    particles: ParticleSet, dt: float, paths: list[RoadPath], visible: bool, rng: np.random.Generator
) -> ParticleSet:
    """One time step: background-aware tracking paper, eqs. 2.3 to 2.5, in ground units.

    visible: while the target is visible, speed and heading have large process noise; otherwise the speed changes
    slowly.
    """
    n = len(particles)
    sqrt_dt = np.sqrt(max(dt, 1e-4))
    decay = np.exp(-dt / (0.7 if visible else _ACCELERATION_TIME_CONSTANT_S))
    acceleration = particles.acceleration * decay
    speed_noise = 2.5 if visible else 0.8
    wanted = (particles.cruise_speed - particles.speed) / _CRUISE_TIME_CONSTANT_S
    most = 0.0 if visible else _MAX_CRUISE_ACCELERATION
    cruise_acceleration = np.clip(wanted, -most, most)
    speed = particles.speed + (acceleration + cruise_acceleration) * dt + speed_noise * sqrt_dt * rng.normal(size=n)
    speed = np.clip(speed, 0.0, _MAX_SPEED)
    free = particles.path == NO_PATH
    free_curvature = particles.curvature * np.exp(-dt / 1.2) + (0.0 if visible else 0.02 * sqrt_dt) * rng.normal(size=n)
    curvature = np.where(free, free_curvature, particles.curvature)
    steering_share = np.minimum(1.0, 0.1 + speed / 4.0)
    turn = curvature * speed * dt + (0.4 if visible else 0.08) * sqrt_dt * steering_share * rng.normal(size=n)
    heading = particles.heading + np.where(free, turn, 0.0)
    mid_heading = particles.heading + 0.5 * np.where(free, turn, 0.0)
    step = (speed * dt)[:, None] * np.column_stack([np.cos(mid_heading), np.sin(mid_heading)])
    position = particles.position + step + (0.04 if visible else 0.02) * rng.normal(size=(n, 2))
    arc_length = particles.arc_length + speed * dt
    lateral_offset = particles.lateral_offset + (0.0 if visible else 0.2) * sqrt_dt * rng.normal(size=n)
    for k, path in enumerate(paths):
        selected = particles.path == k
        if not selected.any():
            continue
        ahead = path.curvature_at(particles.arc_length[selected] + np.array(_LOOKAHEADS)[:, None])
        allowances = np.array([_braking_allowance(distance) for distance in _LOOKAHEADS])[:, None]
        limits = np.sqrt(particles.lateral_limit[selected] / np.maximum(np.abs(ahead), 1e-3) + allowances)
        excess = np.maximum(speed[selected] - np.minimum(limits.min(axis=0), _MAX_SPEED), 0.0)
        speed[selected] = speed[selected] - np.minimum(excess, 3.5 * dt)
        arc_length[selected] = particles.arc_length[selected] + speed[selected] * dt
        # Beyond the known road each particle has its own sampled curvature.
        beyond = np.maximum(arc_length[selected] - path.known_length, 0.0)
        position[selected], heading[selected] = path.pose_at(
            arc_length[selected], lateral_offset[selected] + 0.5 * curvature[selected] * np.square(beyond)
        )
        heading[selected] += curvature[selected] * beyond
    return replace(
        particles,
        position=position,
        heading=heading,
        speed=speed,
        acceleration=acceleration,
        curvature=curvature,
        arc_length=arc_length,
        lateral_offset=lateral_offset,
    )


def raise_lateral_limits(particles: ParticleSet, paths: list[RoadPath]) -> ParticleSet:
    """Particles of a driver who does not brake: the lateral limit is raised where it would demand braking."""
    lateral_limit = particles.lateral_limit.copy()
    for k, path in enumerate(paths):
        selected = particles.path == k
        for distance in _LOOKAHEADS:
            needed = np.abs(path.curvature_at(particles.arc_length[selected] + distance)) * (
                np.square(particles.speed[selected]) - _braking_allowance(distance)
            )
            lateral_limit[selected] = np.maximum(lateral_limit[selected], np.minimum(needed, _MAX_LATERAL_LIMIT))
    return replace(particles, lateral_limit=lateral_limit)


def _braking_allowance(distance: float) -> float:
    """Possible decrease of the squared speed over a distance [units²/s²]."""
    return 2.0 * _BRAKING_DECELERATION * max(distance - _LOOKAHEADS[0], 0.0)


def nudge_to_fit(
    particles: ParticleSet,
    fit: MotionFit,
    interval: float,
    velocity_gain: float,
    position_gain: float,
    rng: np.random.Generator,
) -> ParticleSet:
    """Velocity nudged towards a motion fit, ``interval`` seconds after it: a velocity error at the exit grows linearly.

    velocity_gain: 0 to 1; position_gain: of the mean position.
    """
    velocity = fit.velocity + fit.acceleration * interval + rng.normal(0.0, fit.velocity_std, (len(particles), 2))
    current = particles.speed[:, None] * np.column_stack([np.cos(particles.heading), np.sin(particles.heading)])
    mixed = current + velocity_gain * (velocity - current)
    slow = float(np.hypot(*fit.velocity)) < 0.7
    heading = particles.heading if slow else np.arctan2(mixed[:, 1], mixed[:, 0])
    expected = fit.position + interval * (fit.velocity + 0.5 * interval * fit.acceleration)
    position = particles.position + position_gain * (expected - particles.weights @ particles.position)
    return replace(particles, position=position, speed=np.hypot(mixed[:, 0], mixed[:, 1]), heading=heading)


def initialise_prediction(
    particles: ParticleSet,
    fit: MotionFit,
    interval: float,
    count: int,
    rng: np.random.Generator,
    driver: DriverModel | None = None,
    paths_known: bool = True,
) -> ParticleSet:
    """Particles at the start of an occlusion: positions kept, motion sampled from the fit and its uncertainty.

    driver: model of the driver. paths_known: whether there are paths, whose curvature determines the speed; without
    them a significant change of speed is assumed to last.
    """
    selected = particles.select(systematic_resample(particles.weights, count, rng))
    excess = abs(fit.longitudinal_acceleration) / max(fit.acceleration_std, 1e-6) - _MIN_SIGNIFICANCE
    significance = 0.0 if paths_known else float(np.clip(excess, 0.0, 1.0))
    sampled = sample_from_fit(
        fit, np.zeros(2), 0.0, count, rng, _ACCELERATION_PERSISTENCE + (1.0 - _ACCELERATION_PERSISTENCE) * significance
    )
    if fit.speed < 0.7:
        return replace(selected, speed=sampled.speed, acceleration=0.0 * sampled.acceleration, path=sampled.path)
    manoeuvre = _sample_accelerations(count, rng)
    acceleration = sampled.acceleration + manoeuvre
    speed = np.maximum(sampled.speed + sampled.acceleration * interval, 0.0)
    parameters = (driver or DriverModel()).sample(fit, speed, rng)
    return replace(
        selected,
        heading=sampled.heading,
        speed=speed,
        # A present change of speed is intended: it shifts the cruise speed.
        cruise_speed=np.maximum(
            parameters.cruise_speed
            + np.where(np.abs(manoeuvre) > _MIN_INTENDED_ACCELERATION, _ACCELERATION_TIME_CONSTANT_S * manoeuvre, 0.0)
            + significance * _ACCELERATION_TIME_CONSTANT_S * sampled.acceleration,
            0.0,
        ),
        lateral_limit=parameters.lateral_limit,
        acceleration=acceleration,
        curvature=sampled.curvature,
        path=sampled.path,
    )


def _sample_accelerations(count: int, rng: np.random.Generator) -> Floats:
    """Future accelerations of drivers (count,) [units/s²]: most keep their speed, some change it, a few brake."""
    kind = rng.random(count)
    changing, braking = rng.normal(0.0, 2.0, count), rng.uniform(-6.0, -1.0, count)
    going = rng.normal(0.0, 0.3, count)
    return np.where(kind < 0.68, going, np.where(kind < 0.92, changing, braking))


def inject_particles(
    particles: ParticleSet, position: Floats, motion: tuple[Floats, float], weight: float, rng: np.random.Generator
) -> ParticleSet:
    """Add particles of a total weight about a position (2,), with a velocity (2,) and its std."""
    n = max(len(particles) // 20, 8)
    velocity = motion[0] + rng.normal(0.0, motion[1], (n, 2))
    new = initialise(position, 0.3, n, rng)
    speed, heading = np.hypot(velocity[:, 0], velocity[:, 1]), np.arctan2(velocity[:, 1], velocity[:, 0])
    new = replace(new, speed=speed, cruise_speed=speed, heading=heading, weights=np.full(n, weight / n))
    parts = ((getattr(particles, f.name), getattr(new, f.name)) for f in fields(ParticleSet))
    whole = ParticleSet(*(np.concatenate(pair) for pair in parts))
    return replace(whole, weights=whole.weights / whole.weights.sum())


def reinitialise_at(particles: ParticleSet, position: Floats, std: float, rng: np.random.Generator) -> ParticleSet:
    """Particles of a re-acquired target: about its position (2,), with resampled motion."""
    selected = particles.select(systematic_resample(particles.weights, len(particles), rng))
    return replace(
        selected, position=position + rng.normal(0.0, std, (len(particles), 2)), path=np.full(len(particles), NO_PATH)
    )
