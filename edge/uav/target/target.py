"""The target on the ground: appearance model, footprint, orientation of its patch and local photometric gain."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from edge.uav.base import Box
from edge.uav.ground.localisation import CameraLocaliser
from edge.uav.ground.photometric import TargetGain
from edge.uav.target import footprint
from edge.uav.target.appearance import AppearanceModel, Candidate
from edge.uav.target.ground_patch import GroundPatch, rectify_patch
from edge.uav.target.motion_history import MotionFit
from protocols.core.errors import InputError
from protocols.geometry.types import Floats, Image

_LEARNING_RATE = 0.04  # of a frame: a mean over 25, in which one wrong patch hardly shows
_CENTRE_HEIGHT_RATIO = 0.155  # height of a car's centre over its length
_RELEARN_SHARE = 0.12  # increase of the visible share at which the appearance is learnt again
_FULL_SHARE = 0.97  # visible share that counts as complete
_MAX_HALF_CELLS = 100  # half size of a patch
_OCCLUSION_MARGIN = 0.1  # decrease of the score below its typical value without occlusion
_OCCLUSION_STD = 0.6  # std of the position in target lengths, per unit of score beyond that margin
_MAX_BODY_ERROR = 0.35  # of an axis found by colour: the course, where it is nearer, is exacter [rad]
_TYPICAL_RATE_UP, _TYPICAL_RATE_DOWN = 0.1, 0.02  # of the typical score, per frame


class Target:
    """The target model, learnt from its box in the first image."""

    def __init__(self, image: Image, localiser: CameraLocaliser, box: Box) -> None:
        self._localiser = localiser
        centre = np.array([[box.x + 0.5 * (box.width - 1.0), box.y + 0.5 * (box.height - 1.0)]])
        approximate = localiser.target_ground(centre)[0]
        if not np.isfinite(approximate).all():
            raise InputError("the lens distortion has no inverse at the target", remedy="correct distortions in --rig")
        ground_from_pixel = np.linalg.inv(footprint.pixel_jacobian(localiser.plane, localiser.matrix, approximate))
        localiser.target_height = _CENTRE_HEIGHT_RATIO * max(
            box.width * float(np.hypot(*ground_from_pixel.T[0])), box.height * float(np.hypot(*ground_from_pixel.T[1]))
        )
        self.position = localiser.target_ground(centre)[0]
        axes = footprint.pixel_jacobian(localiser.plane, localiser.target_matrix, self.position)
        right, down = np.linalg.inv(axes).T  # the image axes on the ground
        self._box = (box.width * float(np.hypot(*right)), box.height * float(np.hypot(*down)))
        self.angle = float(np.arctan2(right[1], right[0]))
        """Direction of the patch's x axis on the ground [rad]."""
        self._box_angle = self.angle  # of the box as drawn
        self.aligned = False
        """Whether the patch is aligned with the heading, which is estimated once the car has moved."""
        self.crab_angle = 0.0
        """Angle of the body from the course [rad]: not all that moves moves along its axis."""
        self._oriented = False  # whether the patch is aligned with the body's axis before the heading is known
        self.scale = float(np.sqrt(abs(np.linalg.det(axes))))
        """Pixels per ground unit at the target."""
        self.appearance = AppearanceModel(*self._box, 1.0 / self.scale)
        self.local_gain = TargetGain()
        self._typical_score = 1.0
        self._learnt_share = 0.0  # visible share when it was learnt
        self._learn(image, 1.0)
        self._orient(image)

    @property
    def length(self) -> float:
        """The longer side [ground units]."""
        return max(self.appearance.length, self.appearance.width)

    def position_std(self, visible_share: float, score: float = 1.0) -> float:
        """Std of a detected position, one coordinate [ground units].

        visible_share: share of the footprint in the image. score: below its typical value part of the target is
        occluded, which shifts the position of the match.
        """
        unoccluded = max(0.05 * self.length, 0.6 / self.scale)
        missing = min(max(self._typical_score - _OCCLUSION_MARGIN - score, 0.0), 0.5)
        occluded = _OCCLUSION_STD * self.length * missing
        return unoccluded * (1.0 + 5.0 * max(0.0, 0.97 - visible_share)) + occluded

    def is_unoccluded(self, score: float) -> bool:
        """Whether a score is close to the typical one; always True before the heading is known."""
        return not self.aligned or score > self._typical_score - _OCCLUSION_MARGIN

    def update_typical_score(self, score: float) -> None:
        """Update the typical score from a certain, complete detection; slowly if it is lower."""
        rate = _TYPICAL_RATE_UP if score > self._typical_score else _TYPICAL_RATE_DOWN
        self._typical_score += rate * (min(score, 1.0) - self._typical_score)

    def patch(self, image: Image, centre: Floats, half: float, angle: float | None = None) -> GroundPatch | None:
        """A rectified patch about a ground point (2,), ``half`` target lengths to each side; None if not in view."""
        localiser, cell = self._localiser, self.appearance.cell_size
        sides = (min(half * self.length, _MAX_HALF_CELLS * cell),) * 2
        angle = self.angle if angle is None else angle
        gain = partial(localiser.photometric.corrected, log_gain=self.local_gain.log_gain)
        return rectify_patch(image, localiser.plane, localiser.target_matrix, centre, angle, sides, cell, gain)

    def update_resolution(self, position: Floats) -> None:
        """Adapt scale and cell size to the resolution at the target's position."""
        axes = footprint.pixel_jacobian(self._localiser.plane, self._localiser.target_matrix, position)
        if not np.isfinite(axes).all():
            return
        scale = math.sqrt(abs(axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]))
        if scale > 1e-6:
            self.scale = scale
            self.appearance.set_cell_size(1.0 / scale)

    def search(self, image: Image, centre: Floats, half: float, angle: float | None = None) -> list[Candidate]:
        """Candidates about a ground point."""
        patch = self.patch(image, centre, half, angle)
        return [] if patch is None else self.appearance.candidates(patch)

    def _orient(self, image: Image) -> None:
        """Turn the patch to the body's axis where the colours in the box show it: its corners are then background."""
        patch = self.patch(image, self.position, 0.6)
        if patch is None or not patch.complete:
            return
        ratio = self.appearance.colour_log_ratios(patch.cells)
        rows, columns = np.indices(ratio.shape)
        cells = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        local = (cells - patch.to_cells(self.position[None])) * patch.cell_size
        found = footprint.oriented_rectangle(local, ratio.ravel().astype(np.float64), self._box)
        if found is not None:
            turn, length, width = found
            self.angle, self._oriented = self.angle + turn, True
            self.appearance.reshape(length, width)
            self._learn(image, 1.0)

    def align(self, image: Image, fit: MotionFit) -> None:
        """Change from the box as drawn to the car's length and width, once its heading is known."""
        crab = (self.angle - fit.heading + 0.5 * np.pi) % np.pi - 0.5 * np.pi  # of an axis, which has no front
        self.crab_angle = float(crab) if self._oriented and abs(crab) > _MAX_BODY_ERROR else 0.0
        if not self.crab_angle:
            self.appearance.reshape(*footprint.footprint_from_box(*self._box, fit.heading - self._box_angle))
        self._localiser.target_height = _CENTRE_HEIGHT_RATIO * self.length
        self.angle, self.aligned = fit.heading + self.crab_angle, True
        self._learn(image, 1.0)

    def update_crab_angle(self, best: Candidate, course: float) -> None:
        """Take the body's angle from a certain, complete detection that matches at another angle than the course."""
        if self.appearance.shape_matches(best):
            self.crab_angle = float((best.angle - course + np.pi) % (2.0 * np.pi) - np.pi)

    def relearn_if_more_visible(self, image: Image, best: Candidate) -> None:
        """Learn a target again that was cut by the image border at first, as more of it becomes visible."""
        if self.aligned or best.visible_share < min(self._learnt_share + _RELEARN_SHARE, _FULL_SHARE):
            return
        if self._learnt_share < _FULL_SHARE:
            self.position = best.ground
            self._learn(image, 1.0)

    def update_local_gain(self, best: Candidate) -> None:
        """Update the photometric gain at the target if it is complete and its shape matches."""
        if best.patch is not None and best.visible_share >= _FULL_SHARE and self.appearance.shape_matches(best):
            self.local_gain.update(self.appearance.log_brightness(best.patch, best.ground))

    def update_appearance(self, image: Image, best: Candidate) -> None:
        """Adapt the appearance slightly to a certain, complete detection."""
        patch = self.patch(image, best.ground, 1.6)
        if patch is not None:
            self.appearance.learn(patch, best.ground, _LEARNING_RATE, self.aligned)
        self.appearance.calibrate(best.colour, best.shape, 0.05)

    def change_frame(self, position: Floats, jacobian: Floats) -> None:
        """Transform to another ground frame: (2,) new position, (2, 2) derivative there of new by old ground."""
        factor = float(np.sqrt(abs(np.linalg.det(jacobian))))
        for name in ("angle", "_box_angle"):
            direction = jacobian @ np.array([np.cos(getattr(self, name)), np.sin(getattr(self, name))])
            setattr(self, name, float(np.arctan2(direction[1], direction[0])))
        self._box = (self._box[0] * factor, self._box[1] * factor)
        self.appearance.rescale(factor)
        self._localiser.target_height = _CENTRE_HEIGHT_RATIO * self.length
        self.scale /= factor
        self.position = position

    def outline(self, position: Floats, heading: float, enlarged: float = 1.0) -> Floats:
        """(4, 2) ground corners of the footprint about a position, scaled by ``enlarged``."""
        orientation = heading + self.crab_angle if self.aligned else self.angle
        return footprint.corners(
            position, orientation, enlarged * self.appearance.length, enlarged * self.appearance.width
        )

    def _learn(self, image: Image, rate: float) -> None:
        patch = self.patch(image, self.position, 2.2)
        if patch is None:
            return
        if rate >= 1.0:
            self.appearance.reset()
        self.appearance.learn(patch, self.position, rate, self.aligned)
        self.local_gain.set_reference(self.appearance.log_brightness(patch, self.position))
        candidates = self.appearance.candidates(patch, min_score=-1.0)
        near = [c for c in candidates if np.linalg.norm(c.ground - self.position) < 0.3 * self.length]
        if near:
            self._learnt_share = near[0].visible_share
            self.appearance.calibrate(near[0].colour, near[0].shape, rate)
