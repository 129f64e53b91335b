"""The cloud of particles: cars on the ground that drive freely while the target is seen and along ways while not."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from edge.uav.ground.image_plane import transfer
from edge.uav.prediction.driver_model import Driving
from edge.uav.prediction.particles import AdaptiveNumber, effective_sample_size, systematic
from edge.uav.prediction.paths import Way
from edge.uav.target.motion_history import MotionFit
from protocols.geometry.types import Floats, Ints

FREE = -1
"""Of a particle that follows no way."""
_SIDEWAYS = 3.4  # acceleration that a driver accepts in a bend, where nothing else is known [units/s²]
_AHEAD = (1.0, 5.0, 10.0, 18.0)  # where on its way a driver looks for bends [units]
_BRAKING = 2.5  # for one [units/s²]
_MOST_SIDEWAYS = 6.0  # more makes tyres slip [units/s²]
_SETTLE_S = 2.5  # within which the speed goes back to what the driver likes
_HURRY = 2.0  # most acceleration for that [units/s²]
_FASTEST = 60.0
_UNKNOWN_BEND = 0.008  # std of the curvature of road that was never seen [1/unit]
_VELOCITY_STD = (0.7, 3.0)  # least and most of what a cloud is taken to know of its velocity [units/s]
_GOES_ON = 0.35  # of the acceleration at the last sighting
_TELLING = 1.5  # of its stds from which it tells something
_MEANT = 1.0  # a change of speed that is meant to last [units/s²]
_MOOD_S = 1.5  # how long a change of speed lasts


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """n cars. place: (n, 2) ground; heading, speed, acceleration, curvature: (n,); weights: (n,), sum 1.

    way: (n,) index of the way that each follows, or FREE; along, across: (n,) its place on it.
    cruise, sideways: (n,) speed that the driver likes [units/s], acceleration across that is accepted [units/s²].
    """

    place: Floats
    heading: Floats
    speed: Floats
    acceleration: Floats
    curvature: Floats
    way: Ints
    along: Floats
    across: Floats
    cruise: Floats
    sideways: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.weights)

    def take(self, index: Ints) -> Cloud:
        """The particles of an index (m,), of equal weight."""
        return Cloud(
            self.place[index],
            self.heading[index],
            self.speed[index],
            self.acceleration[index],
            self.curvature[index],
            self.way[index],
            self.along[index],
            self.across[index],
            self.cruise[index],
            self.sideways[index],
            np.full(len(index), 1.0 / len(index)),
        )

    def weighted(self, likelihood: Floats) -> Cloud:
        """Eq. (2.1): weights times likelihoods (n,), normalised."""
        weights = self.weights * likelihood
        total = float(weights.sum())
        if not (np.isfinite(total) and total > 1e-290):
            return self
        return replace(self, weights=weights / total)

    def resampled(self, rng: np.random.Generator, number: AdaptiveNumber) -> Cloud:
        """Low-variance resampling where the effective size fell below half; as many as the spread needs."""
        n = len(self)
        if effective_sample_size(self.weights) > 0.5 * n:
            return self
        chosen = systematic(self.weights, n, rng)
        wanted = number.of(self.place[chosen])
        if wanted != n:
            chosen = systematic(self.weights, wanted, rng)
        return self.take(chosen)

    def velocity(self) -> tuple[Floats, float]:
        """Mean (2,) and std of one coordinate, within _VELOCITY_STD [units/s]."""
        every = self.speed[:, None] * np.column_stack([np.cos(self.heading), np.sin(self.heading)])
        mean = self.weights @ every
        variance = float(self.weights @ np.square(every - mean).sum(axis=1)) / 2.0
        return np.asarray(mean), float(np.clip(np.sqrt(variance), *_VELOCITY_STD))

    def free(self) -> Cloud:
        """All off their ways."""
        return replace(self, way=np.full(len(self), FREE))

    def moved(self, new_from_old: Floats) -> Cloud:
        """Into another ground frame."""
        place = transfer(new_from_old, self.place)
        ahead = transfer(new_from_old, self.place + 0.5 * np.column_stack([np.cos(self.heading), np.sin(self.heading)]))
        step = ahead - place
        scale = np.hypot(step[:, 0], step[:, 1]) / 0.5
        return replace(
            self,
            place=place,
            heading=np.arctan2(step[:, 1], step[:, 0]),
            speed=self.speed * scale,
            cruise=self.cruise * scale,
            acceleration=self.acceleration * scale,
            curvature=self.curvature / np.maximum(scale, 1e-6),
            way=np.full(len(self), FREE),
        )


def scattered(place: Floats, std: float, count: int, rng: np.random.Generator) -> Cloud:
    """A cloud about a place (2,) that knows nothing of the motion yet."""
    zeros = np.zeros(count)
    places, headings = place + rng.normal(0.0, std, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    speed = np.abs(rng.normal(0.0, 14.0, count))
    return Cloud(
        places,
        headings,
        speed,
        zeros,
        zeros,
        np.full(count, FREE),
        zeros,
        zeros,
        speed,
        np.full(count, _SIDEWAYS),
        np.full(count, 1.0 / count),
    )


def drawn(
    fit: MotionFit, place: Floats, std: float, count: int, rng: np.random.Generator, goes_on: float = _GOES_ON
) -> Cloud:
    """A cloud about a place (2,) with the motion of a fit, as uncertain as the fit is.

    goes_on: share of the acceleration that does.
    """
    velocity = fit.velocity + rng.normal(0.0, fit.velocity_std, (count, 2))
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    shrink = 1.0 / (1.0 + np.square(fit.acceleration_std / max(2.0, 0.17 * fit.speed)))
    along = goes_on * shrink * fit.along + rng.normal(0.0, min(fit.acceleration_std, 1.0), count)
    curvature = np.full(count, fit.turn_rate / max(fit.speed, 2.0)) + rng.normal(0.0, 0.01, count)
    return Cloud(
        place + rng.normal(0.0, std, (count, 2)),
        heading,
        speed,
        along,
        np.clip(curvature, -0.15, 0.15),
        np.full(count, FREE),
        np.zeros(count),
        np.zeros(count),
        speed,
        np.full(count, _SIDEWAYS),
        np.full(count, 1.0 / count),
    )


def driven(cloud: Cloud, dt: float, ways: list[Way], seen: bool, rng: np.random.Generator) -> Cloud:
    """One step of eqs. (2.3) to (2.5) in ground units: place by speed and heading, both of which wander.

    seen: while the target is seen it may do anything; while not, it keeps its speed but for slow changes.
    """
    n = len(cloud)
    root = np.sqrt(max(dt, 1e-4))
    fade = np.exp(-dt / (0.7 if seen else _MOOD_S))
    acceleration = cloud.acceleration * fade
    wander = 2.5 if seen else 0.8
    liked = np.zeros(n) if seen else np.clip((cloud.cruise - cloud.speed) / _SETTLE_S, -_HURRY, _HURRY)
    speed = cloud.speed + (acceleration + liked) * dt + wander * root * rng.normal(size=n)
    speed = np.clip(speed, 0.0, _FASTEST)
    free = cloud.way == FREE
    swerve = cloud.curvature * np.exp(-dt / 1.2) + (0.0 if seen else 0.02 * root) * rng.normal(size=n)
    curvature = np.where(free, swerve, cloud.curvature)
    nimble = np.minimum(1.0, 0.1 + speed / 4.0)
    turn = curvature * speed * dt + (0.4 if seen else 0.08) * root * nimble * rng.normal(size=n)
    heading = cloud.heading + np.where(free, turn, 0.0)
    middle = cloud.heading + 0.5 * np.where(free, turn, 0.0)
    step = (speed * dt)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
    place = cloud.place + step + (0.04 if seen else 0.02) * rng.normal(size=(n, 2))
    along = cloud.along + speed * dt
    across = cloud.across + (0.0 if seen else 0.2) * root * rng.normal(size=n)
    for k, way in enumerate(ways):
        on = cloud.way == k
        if not on.any():
            continue
        limit = np.full(int(on.sum()), _FASTEST)
        for ahead in _AHEAD:
            bend = np.maximum(np.abs(way.bend(cloud.along[on] + ahead)), 1e-3)
            limit = np.minimum(limit, np.sqrt(cloud.sideways[on] / bend + _lost_by(ahead)))
        excess = np.maximum(speed[on] - limit, 0.0)
        speed[on] = speed[on] - np.minimum(excess, 3.5 * dt)
        along[on] = cloud.along[on] + speed[on] * dt
        # Past the known road nobody knows how it bends: each particle has its own idea.
        past = np.maximum(along[on] - way.known, 0.0)
        place[on], heading[on] = way.at(along[on], across[on] + 0.5 * curvature[on] * np.square(past))
        heading[on] += curvature[on] * past
    return replace(
        cloud,
        place=place,
        heading=heading,
        speed=speed,
        acceleration=acceleration,
        curvature=curvature,
        along=along,
        across=across,
    )


def on_ways(cloud: Cloud, ways: list[Way], share: float, rng: np.random.Generator) -> Cloud:
    """Put a share of the particles on ways that begin where they are, each way by its weight."""
    n = len(cloud)
    start, heading = ways[0].points[0], ways[0].headings[0]
    local = cloud.place - start
    along = local @ np.array([np.cos(heading), np.sin(heading)])
    across = local @ np.array([-np.sin(heading), np.cos(heading)])
    edges = np.cumsum([way.weight for way in ways])
    drawn_way = np.minimum(np.searchsorted(edges, rng.random(n)), len(ways) - 1)
    free = rng.random(n) >= share
    bend = np.where(free, cloud.curvature, rng.normal(0.0, _UNKNOWN_BEND, n))
    return replace(cloud, way=np.where(free, FREE, drawn_way), along=along, across=across, curvature=bend)


def unhurried(cloud: Cloud, ways: list[Way]) -> Cloud:
    """The cloud of a driver who does not brake: who would have to for a bend ahead accepts more across than thought."""
    sideways = cloud.sideways.copy()
    for k, way in enumerate(ways):
        on = cloud.way == k
        for ahead in _AHEAD:
            needed = np.abs(way.bend(cloud.along[on] + ahead)) * (np.square(cloud.speed[on]) - _lost_by(ahead))
            sideways[on] = np.maximum(sideways[on], np.minimum(needed, _MOST_SIDEWAYS))
    return replace(cloud, sideways=sideways)


def _lost_by(ahead: float) -> float:
    """By how much the square of the speed can fall before a bend so far ahead [units²/s²]."""
    return 2.0 * _BRAKING * max(ahead - _AHEAD[0], 0.0)


def rerouted(cloud: Cloud, old: list[Way], new: list[Way], rng: np.random.Generator) -> Cloud:
    """Go over to ways that were traced again from the same start; a new way gets its share of who can still take it."""
    follows = np.full(len(old), 0, dtype=np.int64)
    claimed = np.zeros(len(new), bool)
    for k, way in enumerate(old):
        gaps = []
        for other in new:
            m = min(len(way.points), len(other.points))
            gaps.append(float(np.linalg.norm(way.points[:m] - other.points[:m], axis=1).mean()))
        follows[k] = int(np.argmin(gaps))
        claimed[follows[k]] = True
    taken = np.where(cloud.way == FREE, FREE, follows[np.maximum(cloud.way, 0)])
    for k, other in enumerate(new):
        if claimed[k] or k == 0:
            continue
        base = new[0]
        m = min(len(base.points), len(other.points))
        apart = np.linalg.norm(base.points[:m] - other.points[:m], axis=1) > 2.0
        leaves = float(np.argmax(apart)) * 1.5 if apart.any() else 0.0
        can = (taken == 0) & (cloud.along < leaves)
        takes = can & (rng.random(len(cloud)) < other.weight / (other.weight + base.weight))
        taken = np.where(takes, k, taken)
    return replace(cloud, way=taken)


def pulled(
    cloud: Cloud, fit: MotionFit, ahead: float, strength: float, to_place: float, rng: np.random.Generator
) -> Cloud:
    """Motion drawn towards a fit, ``ahead`` seconds after it: an error at the exit grows linearly with time.

    strength: how much, 0 to 1; to_place: how much the cloud's place is.
    """
    velocity = fit.velocity + fit.acceleration * ahead + rng.normal(0.0, fit.velocity_std, (len(cloud), 2))
    own = cloud.speed[:, None] * np.column_stack([np.cos(cloud.heading), np.sin(cloud.heading)])
    mixed = own + strength * (velocity - own)
    slow = float(np.hypot(*fit.velocity)) < 0.7
    heading = cloud.heading if slow else np.arctan2(mixed[:, 1], mixed[:, 0])
    expected = fit.position + ahead * (fit.velocity + 0.5 * ahead * fit.acceleration)
    place = cloud.place + to_place * (expected - cloud.weights @ cloud.place)
    return replace(cloud, place=place, speed=np.hypot(mixed[:, 0], mixed[:, 1]), heading=heading)


def launched(
    cloud: Cloud,
    fit: MotionFit,
    ahead: float,
    count: int,
    rng: np.random.Generator,
    driving: Driving | None = None,
    on_ways: bool = True,
) -> Cloud:
    """The cloud that loses sight of its target: places as they are, motion of the fit, as uncertain as it is.

    driving: what is known of how it drives. on_ways: whether ways are known, whose bends say how its speed goes on;
    where they are not, a change of speed that is surely seen is meant to last.
    """
    chosen = cloud.take(systematic(cloud.weights, count, rng))
    sure = 0.0 if on_ways else float(np.clip(abs(fit.along) / max(fit.acceleration_std, 1e-6) - _TELLING, 0.0, 1.0))
    sent = drawn(fit, np.zeros(2), 0.0, count, rng, _GOES_ON + (1.0 - _GOES_ON) * sure)
    if fit.speed < 0.7:
        return replace(chosen, speed=sent.speed, acceleration=0.0 * sent.acceleration, way=sent.way)
    mood = _moods(count, rng)
    acceleration = sent.acceleration + mood
    speed = np.maximum(sent.speed + sent.acceleration * ahead, 0.0)
    habits = (driving or Driving()).habits(fit, speed, rng)
    return replace(
        chosen,
        heading=sent.heading,
        speed=speed,
        # Who changes the speed now means it.
        cruise=np.maximum(
            habits.cruise + np.where(np.abs(mood) > _MEANT, _MOOD_S * mood, 0.0) + sure * _MOOD_S * sent.acceleration,
            0.0,
        ),
        sideways=habits.sideways,
        acceleration=acceleration,
        curvature=sent.curvature,
        way=sent.way,
    )


def _moods(count: int, rng: np.random.Generator) -> Floats:
    """What drivers do next (count,) [units/s²]: most go on, some change their speed, a few brake for a light."""
    kind = rng.random(count)
    changing, braking = rng.normal(0.0, 2.0, count), rng.uniform(-6.0, -1.0, count)
    going = rng.normal(0.0, 0.3, count)
    return np.where(kind < 0.68, going, np.where(kind < 0.92, changing, braking))


def joined(cloud: Cloud, place: Floats, motion: tuple[Floats, float], weight: float, rng: np.random.Generator) -> Cloud:
    """The cloud with some particles instead of others: about a place (2,), with a velocity (2,) and its std."""
    n = max(len(cloud) // 20, 8)
    velocity = motion[0] + rng.normal(0.0, motion[1], (n, 2))
    new = scattered(place, 0.3, n, rng)
    speed, heading = np.hypot(velocity[:, 0], velocity[:, 1]), np.arctan2(velocity[:, 1], velocity[:, 0])
    new = replace(new, speed=speed, cruise=speed, heading=heading, weights=np.full(n, weight / n))
    parts = ((getattr(cloud, f.name), getattr(new, f.name)) for f in fields(Cloud))
    whole = Cloud(*(np.concatenate(pair) for pair in parts))
    return replace(whole, weights=whole.weights / whole.weights.sum())


def turned(cloud: Cloud, heading: float, std: float, rng: np.random.Generator) -> Cloud:
    """The cloud heading one way, but for ``std`` [rad]."""
    return replace(cloud, heading=heading + rng.normal(0.0, std, len(cloud)))


def gathered(cloud: Cloud, place: Floats, std: float, rng: np.random.Generator) -> Cloud:
    """The cloud of a target that was found again: about its place (2,), with the motion that led there."""
    chosen = cloud.take(systematic(cloud.weights, len(cloud), rng))
    return replace(chosen, place=place + rng.normal(0.0, std, (len(cloud), 2)), way=np.full(len(cloud), FREE))
