"""The target as a thing on the ground: its looks, its outline, and which way its patch is turned."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from edge.uav.ground.localisation import Placing
from edge.uav.ground.photometric import Shade
from edge.uav.target import footprint
from edge.uav.target.appearance import Appearance, Candidate, Patch, cut_patch
from edge.uav.target.motion_history import MotionFit
from edge.uav.tracker import Box
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]

_LEARN = 0.04
_BODY = 0.155  # height of a car's middle over its length
_MORE = 0.12  # of its share in the picture, by which it is worth learning again
_WHOLE = 0.97  # share of the footprint in the picture that is all of it
_MOST_CELLS = 100  # half size of a patch
_CLEAR = 0.1  # by how much the score may fall short of the usual one while nothing hides a part of the target
_HIDES = 0.6  # std of the place in target lengths, for each unit that the score is short beyond that
_USUAL_RATE, _USUAL_RATE_LESS = 0.1, 0.02  # of the usual score, a frame


class Target:
    """Learnt from its box in the first picture."""

    def __init__(self, image: Picture, placing: Placing, box: Box) -> None:
        self._placing = placing
        middle = np.array([[box.x + 0.5 * (box.width - 1.0), box.y + 0.5 * (box.height - 1.0)]])
        rough = placing.body_ground(middle)[0]
        if not np.isfinite(rough).all():
            raise InputError("the lens model has no image where the target is", remedy="correct distortions in --rig")
        unit = np.linalg.inv(footprint.local_axes(placing.plane, placing.matrix, rough))
        placing.body_height = _BODY * max(
            box.width * float(np.hypot(*unit.T[0])), box.height * float(np.hypot(*unit.T[1]))
        )
        self.place = placing.body_ground(middle)[0]
        axes = footprint.local_axes(placing.plane, placing.body_matrix, self.place)
        right, down = np.linalg.inv(axes).T  # the picture's axes on the ground
        self._box = (box.width * float(np.hypot(*right)), box.height * float(np.hypot(*down)))
        self.angle = float(np.arctan2(right[1], right[0]))
        """Of the patch's x axis on the ground [rad]."""
        self.aligned = False
        """Whether the patch is turned along the car, which is so once it has moved."""
        self.scale = float(np.sqrt(abs(np.linalg.det(axes))))
        """Pixels a ground unit at the target."""
        self.looks = Appearance(*self._box, 1.0 / self.scale)
        self.shade = Shade()
        self._usual = 1.0
        self._known = 0.0  # share of it that was in the picture when it was learnt
        self._teach(image, 1.0)

    @property
    def length(self) -> float:
        """The longer side [ground units]."""
        return max(self.looks.length, self.looks.width)

    def noise(self, seen: float, score: float = 1.0) -> float:
        """Std of a sighting, one coordinate [ground units]. seen: share of the footprint in the picture.

        score: where it is less than usual, something hides a part of the target, and the rest lies to one side.
        """
        whole = max(0.05 * self.length, 0.6 / self.scale)
        hidden = _HIDES * self.length * float(np.clip(self._usual - _CLEAR - score, 0.0, 0.5))
        return whole * (1.0 + 5.0 * max(0.0, 0.97 - seen)) + hidden

    def is_clear(self, score: float) -> bool:
        """Whether a sighting's score is about the usual one; before the target's direction is known, any is."""
        return not self.aligned or score > self._usual - _CLEAR

    def grow_used(self, score: float) -> None:
        """Take the score of a sure sighting of the whole target: what is usual follows it, slowly where it is less."""
        rate = _USUAL_RATE if score > self._usual else _USUAL_RATE_LESS
        self._usual += rate * (min(score, 1.0) - self._usual)

    def cut(self, image: Picture, middle: Floats, half: float, angle: float | None = None) -> Patch | None:
        """A patch about a ground point (2,), ``half`` target lengths to each side; None if not in view."""
        reach = min(half * self.length, _MOST_CELLS * self.looks.pitch)
        turned = self.angle if angle is None else angle
        placing = self._placing
        patch = cut_patch(image, placing.plane, placing.body_matrix, middle, turned, (reach, reach), self.looks.pitch)
        return None if patch is None else patch.relit(placing.light.undone(patch.cells, self.shade.value))

    def follow_scale(self, place: Floats) -> None:
        """Where the target is now decides how finely it is looked at."""
        axes = footprint.local_axes(self._placing.plane, self._placing.body_matrix, place)
        if not np.isfinite(axes).all():
            return
        scale = float(np.sqrt(abs(np.linalg.det(axes))))
        if scale > 1e-6:
            self.scale = scale
            self.looks.set_pitch(1.0 / scale)

    def search(self, image: Picture, middle: Floats, half: float, angle: float | None = None) -> list[Candidate]:
        """What looks like the target about a ground point."""
        patch = self.cut(image, middle, half, angle)
        return [] if patch is None else self.looks.candidates(patch)

    def align(self, image: Picture, fit: MotionFit) -> None:
        """From the box as it was drawn to the car's own length and width, now that its direction is known."""
        self.looks.reshape(*footprint.oriented(*self._box, fit.heading - self.angle))
        self._placing.body_height = _BODY * self.length
        self.angle, self.aligned = fit.heading, True
        self._teach(image, 1.0)

    def complete(self, image: Picture, best: Candidate) -> None:
        """Learn anew a target that was cut by the picture's border when it was learnt, as more of it comes in."""
        if self.aligned or best.seen < min(self._known + _MORE, _WHOLE):
            return
        if self._known < _WHOLE:
            self.place = best.ground
            self._teach(image, 1.0)

    def feel_light(self, image: Picture, best: Candidate) -> None:
        """How light it is where the target is, if that is surely the target by its shape."""
        if best.seen < _WHOLE or not self.looks.is_shaped(best):
            return
        patch = self.cut(image, best.ground, 0.7)
        if patch is not None:
            self.shade.update(self.looks.brightness(patch, best.ground))

    def study(self, image: Picture, best: Candidate) -> None:
        """Learn a little from a target that is surely and wholly seen."""
        patch = self.cut(image, best.ground, 1.6)
        if patch is not None:
            self.looks.learn(patch, best.ground, _LEARN)
        self.looks.calibrate(best.colour, best.shape, 0.05)

    def moved(self, place: Floats, jacobian: Floats) -> None:
        """Into another ground frame: (2,) where it is there, (2, 2) derivative there of new by old ground."""
        factor = float(np.sqrt(abs(np.linalg.det(jacobian))))
        direction = jacobian @ np.array([np.cos(self.angle), np.sin(self.angle)])
        self.angle = float(np.arctan2(direction[1], direction[0]))
        self._box = (self._box[0] * factor, self._box[1] * factor)
        self.looks.rescale(factor)
        self._placing.body_height = _BODY * self.length
        self.scale /= factor
        self.place = place

    def outline(self, place: Floats, heading: float, grown: float = 1.0) -> Floats:
        """(4, 2) ground corners of the footprint about a place, ``grown`` times its size."""
        turned = heading if self.aligned else self.angle
        return footprint.corners(place, turned, grown * self.looks.length, grown * self.looks.width)

    def _teach(self, image: Picture, rate: float) -> None:
        patch = self.cut(image, self.place, 2.2)
        if patch is None:
            return
        if rate >= 1.0:
            self.looks.forget()
        self.looks.learn(patch, self.place, rate)
        self.shade.teach(self.looks.brightness(patch, self.place))
        found = self.looks.candidates(patch, least=-1.0)
        near = [c for c in found if np.linalg.norm(c.ground - self.place) < 0.3 * self.length]
        if near:
            self._known = near[0].seen
            self.looks.calibrate(near[0].colour, near[0].shape, rate)
