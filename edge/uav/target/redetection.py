"""A look over the whole picture for the target, when it has been out of sight: the cloud may have taken a wrong turn.

Spots of the target's colour are found at once in the working picture and followed for some frames. Only what drives
about as fast as the target did, away from where that was last seen and about as far from there as it can have come, is
looked at closely.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.ground.localisation import Placing
from edge.uav.target.appearance import Candidate
from edge.uav.target.motion_history import MotionFit
from edge.uav.target.target import Target
from edge.uav.target.tracklets import Tracklet, Tracklets
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]

_MOST = 8  # spots a frame
_LEAST = 0.35  # of the target's usual colour response
_AGE = 4  # frames that a spot must drive alike
_SLOWEST, _FASTEST = 0.4, 1.6  # times the target's speed
_STRETCH = 0.18  # std of the way that it has driven, over that at its last speed
_FARTHEST_OFF = 2.5  # stds
_ALONG = 0.35  # change of course below which the way is the straight distance [rad]


class Survey:
    """Of one absence of the target."""

    def __init__(self) -> None:
        self._spots = Tracklets()

    def clear(self) -> None:
        """The target is seen, or the ground frame is another one."""
        self._spots.clear()

    def look(
        self, image: Picture, small: Picture, placing: Placing, target: Target, fit: MotionFit, time: float
    ) -> list[tuple[Tracklet, Candidate, float]]:
        """What drives as the target may: how it moves, how it looks, and how well it fits the way driven (0 to 1)."""
        spots = self._spots.update(time, self._coloured(small, placing, target))
        out = []
        for spot in spots:
            course = spot.course()
            if spot.age < _AGE or course is None:
                continue
            fits = plausible(spot, fit, target.length, time)
            if fits <= 0.0:
                continue
            found = target.search(image, spot.places[-1], 1.1, course)
            if found:
                out.append((spot, found[0], fits))
        return out

    def _coloured(self, small: Picture, placing: Placing, target: Target) -> list[Candidate]:
        """Spots of the target's size and colour in the working picture, the best first."""
        pixels = target.scale / placing.factor
        side = max(3, round(pixels * float(np.sqrt(target.looks.length * target.looks.width))))
        if min(small.shape[:2]) < 3 * side:
            return []
        ratios = target.looks.ratios(placing.light.undone(small, target.shade.value))
        inner = cv2.blur(ratios, (side, side))
        outer = cv2.blur(ratios, (2 * side + 1, 2 * side + 1))
        like = np.asarray((inner - 0.5 * outer) / target.looks.colour_scale, np.float32)
        around = np.ones((2 * side + 1, 2 * side + 1), np.uint8)
        rows, columns = np.nonzero((like >= cv2.dilate(like, around)) & (like > _LEAST))
        order = np.argsort(like[rows, columns], kind="stable")[::-1][:_MOST]
        at = np.column_stack([columns, rows])[order].astype(np.float64)
        ground = placing.body_ground((at + 0.5) * placing.factor - 0.5)
        scores = np.minimum(like[rows[order], columns[order]], 1.0)
        return [
            Candidate(place, float(score), float(score), 0.0, 1.0)
            for place, score in zip(ground, scores, strict=True)
            if np.isfinite(place).all()
        ]


def plausible(spot: Tracklet, fit: MotionFit, length: float, time: float) -> float:
    """How well the way from the last sighting to ``spot`` and its motion now fit one turn at most; 0 = not at all.

    length: of the target, as slack.
    """
    motion = spot.velocity()
    if motion is None or fit.speed < 1.0:
        return 0.0
    speed = float(np.hypot(*motion[0]))
    if not _SLOWEST * fit.speed < speed < _FASTEST * fit.speed:
        return 0.0
    before, now = fit.velocity / fit.speed, motion[0] / max(speed, 1e-6)
    offset: Floats = spot.places[-1] - fit.position
    cross = float(before[0] * now[1] - before[1] * now[0])
    if abs(cross) < np.sin(_ALONG):
        if float(before @ now) < 0.0:
            return 0.0
        legs = (float(offset @ before), 0.0)
    else:
        # So far on the old course, so far on the new one.
        legs = (
            float(offset[0] * now[1] - offset[1] * now[0]) / cross,
            float(before[0] * offset[1] - before[1] * offset[0]) / cross,
        )
    if min(legs) < -length:
        return 0.0
    driven = fit.speed * (time - fit.time)
    off = (sum(legs) - driven) / (_STRETCH * driven + length)
    return float(np.exp(-0.5 * off * off)) if abs(off) < _FARTHEST_OFF else 0.0
