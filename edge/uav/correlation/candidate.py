"""A place that may show the target again: tested over several frames before it is believed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.image_motion.scene_motion import Motion
from protocols.geometry.types import Floats

_ACCEPT = 2.7  # log odds of a re-detection: 2, and ln 2 since each search tries two views
_TENTATIVE = -3.0  # log odds below which a place is not tested further
_HITS = 3  # consecutive frames of a re-detection
_PLACE_STD = 0.05  # of a place measured twice, in target lengths
KEEPS, _TURNS, _STOPS = 0.75, 0.15, 0.1  # probabilities of what a target has done while away
_STOOD = 0.3  # speed below which it stood and may go on to, in lengths a second
_STILL, _STILL_STD = 0.5, 0.1  # share of the look-alikes that stand, and std of their speed, in lengths a second
_SLOWEST = 0.35  # std of the velocity of what moves, at least, one coordinate, in lengths a second


@dataclass(frozen=True, slots=True)
class Kinematics:
    """How the target was predicted to move over the scene: velocity (2,) and its std [px/s]; its length [px]."""

    velocity: Floats
    std: float
    length: float

    def log_ratio(self, velocity: Floats, std: float) -> float:
        """log p(velocity | target) - log p(velocity | look-alike): look-alikes stand, or move at any such speed.

        velocity: (2,) measured with ``std``, one coordinate [px/s].
        """
        wide = np.sqrt(0.5 * np.square(self.velocity).sum() + self.std**2 + (_SLOWEST * self.length) ** 2)
        keeps = _normal(velocity - self.velocity, np.hypot(self.std, std))
        moves = _normal(velocity, np.hypot(wide, std))
        stands = _normal(velocity, np.hypot(_STILL_STD * self.length, std))
        stood = 0.5 * KEEPS * np.exp(-0.5 * np.square(self.velocity).sum() / (_STOOD * self.length) ** 2)
        target = (KEEPS - stood) * keeps + _TURNS * moves + (_STOPS + stood) * stands
        return float(np.log(target + 1e-300) - np.log(_STILL * stands + (1.0 - _STILL) * moves + 1e-300))


def _normal(deviation: Floats, std: float) -> float:
    return float(np.exp(-0.5 * np.square(deviation).sum() / std**2) / (2.0 * np.pi * std**2))


@dataclass(slots=True)
class Candidate:
    """A re-detection under test: its log prior, for how many frames it has held, and their mean evidence.

    moved: (2,) by how much it has moved over the scene since its first hit, in ``time`` seconds.
    """

    box: OrientedBox
    prior: float
    expected: Kinematics
    hits: int = 0
    evidence: float = 0.0
    last: float = 0.0
    origin: Floats | None = None
    moved: Floats = field(default_factory=lambda: np.zeros(2))
    time: float = 0.0

    def move(self, motion: Motion, reach: float, dt: float) -> None:
        """Predict it into the next frame: with the scene, and at its own velocity."""
        linear = motion.matrix[:, :2]
        self.moved = linear @ self.moved
        self.origin = motion.at(self.box.centre, reach)
        speed = self.moved / self.time if self.time else self.expected.velocity * 0.0
        self.box = motion.moved(self.box.at(self.origin + speed * dt))

    def add(self, box: OrientedBox, evidence: float, dt: float) -> None:
        """Add one frame: where it was found, and its log likelihood ratio.

        Further frames show the same look-alike, if it is one: they make the evidence surer, not larger.
        """
        self.hits += 1
        self.last = evidence
        self.evidence += (evidence - self.evidence) / self.hits
        self.box = box
        if self.origin is not None and self.hits > 1:
            self.moved = self.moved + box.centre - self.origin
            self.time += dt

    def covers(self, other: OrientedBox) -> bool:
        """Whether another box is about the same place."""
        return bool((np.abs(self.box.centre - other.centre) < 0.5 * np.maximum(self.box.extent, other.extent)).all())

    def velocity(self) -> tuple[Floats, float]:
        """Over the scene (2,), and its std, one coordinate [px/s]; as expected where it was seen once."""
        if self.time == 0.0:
            return self.expected.velocity, self.expected.std
        return self.moved / self.time, np.sqrt(2.0) * (_PLACE_STD * self.expected.length + 0.3) / self.time

    @property
    def log_odds(self) -> float:
        """That it is the target: by its place, what it looks like, and how it moves."""
        motion = self.expected.log_ratio(*self.velocity()) if self.time else 0.0
        return self.prior + self.evidence + motion

    @property
    def promising(self) -> bool:
        """Whether further frames may make it the target."""
        return self.evidence > 0.0 and self.log_odds >= _TENTATIVE

    @property
    def accepted(self) -> bool:
        """Whether it is the target, and the last frame shows it."""
        return self.hits >= _HITS and self.log_odds > _ACCEPT and self.last > 0.0
