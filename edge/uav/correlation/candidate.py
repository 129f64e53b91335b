"""A place that may show the target again: tested over several frames before it is believed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.image_motion.scene_motion import Motion
from protocols.geometry.types import Floats

_ACCEPT = 1.0  # log odds of a re-detection
_TENTATIVE = -3.0  # log odds below which a place is not tested further
_MAX_TESTS = 8  # frames for which a place is tested
_HITS = 3  # consecutive frames of a re-detection


@dataclass(slots=True)
class Candidate:
    """A re-detection under test: its log prior, for how many frames it has held, and their mean evidence.

    steps: its velocities over the scene [px/s]; origin: (2,) where the scene alone would have moved it.
    """

    box: OrientedBox
    prior: float
    hits: int = 0
    evidence: float = 0.0
    origin: Floats | None = None
    steps: list[Floats] = field(default_factory=list)

    def move(self, motion: Motion, reach: float, dt: float) -> None:
        """Predict it into the next frame: with the scene, and at its own velocity."""
        linear = motion.matrix[:, :2]
        self.origin = motion.at(self.box.centre, reach)
        place = self.origin + (np.median(self.steps, axis=0) * dt if self.steps else 0.0)
        moved = self.box.at(place).sized(self.box.sides * motion.zoom)
        self.box = moved.turned(float(np.arctan2(linear[1, 0], linear[0, 0])))

    def add(self, box: OrientedBox, evidence: float, dt: float) -> None:
        """Add one frame: where it was found, and its log likelihood ratio.

        Further frames show the same look-alike, if it is one: they make the evidence surer, not larger.
        """
        self.hits += 1
        self.evidence += (evidence - self.evidence) / self.hits
        self.box = box
        if self.origin is not None and self.hits > 1:
            self.steps.append((box.centre - self.origin) / dt)

    @property
    def hopeless(self) -> bool:
        """Whether further frames will hardly make it the target."""
        return self.prior + self.evidence < _TENTATIVE or self.hits > _MAX_TESTS

    @property
    def accepted(self) -> bool:
        """Whether it is the target."""
        return self.hits >= _HITS and self.prior + self.evidence > _ACCEPT
