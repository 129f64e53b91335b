"""Re-detection of the target over the full frame after it was out of view: the particle set may be in the wrong place.

Blobs of the target's colour are detected in the working image and tracked for some frames. Only blobs that move about
as fast as the target did, at a distance from its last detection that it can have travelled, are matched closely.
"""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.ground.localisation import CameraLocaliser
from edge.uav.target.appearance import Candidate
from edge.uav.target.motion_history import MotionFit
from edge.uav.target.target import Target
from edge.uav.target.tracklets import Tracklet, Tracklets
from protocols.geometry.types import Floats, Image

_MAX_BLOBS = 8  # per frame
_MIN_COLOUR_RESPONSE = 0.35  # relative to the target's typical one
_MIN_AGE = 4  # frames for which a blob must have moved consistently
_MIN_SPEED_RATIO, _MAX_SPEED_RATIO = 0.4, 1.6  # times the target's speed
_RELATIVE_LENGTH_STD = 0.18  # of the distance travelled, over that at the last known speed
_GATE = 2.5  # of that distance, in stds
_MAX_STRAIGHT_ANGLE = 0.35  # change of course below which the path is taken as straight [rad]


class Redetector:
    """Full-frame search during one absence of the target."""

    def __init__(self) -> None:
        self._blobs = Tracklets()

    def reset(self) -> None:
        """Start over: the target was detected, or the ground frame has changed."""
        self._blobs.reset()

    def detect(
        self, image: Image, working: Image, localiser: CameraLocaliser, target: Target, fit: MotionFit, time: float
    ) -> list[tuple[Tracklet, Candidate, float]]:
        """Moving candidates: tracklet, match, and how plausible the distance travelled is (0 to 1)."""
        blobs = self._blobs.update(time, self._colour_blobs(working, localiser, target))
        out = []
        for blob in blobs:
            course = blob.course()
            if blob.age < _MIN_AGE or course is None:
                continue
            plausibility = path_plausibility(blob, fit, target.length, time)
            if plausibility <= 0.0:
                continue
            found = target.search(image, blob.positions[-1], 1.1, course + target.crab_angle)
            if found:
                out.append((blob, found[0], plausibility))
        return out

    def _colour_blobs(self, working: Image, localiser: CameraLocaliser, target: Target) -> list[Candidate]:
        """Blobs of the target's size and colour in the working image, the best first."""
        pixels = target.scale / localiser.downscale
        side = max(3, round(pixels * float(np.sqrt(target.appearance.length * target.appearance.width))))
        if min(working.shape[:2]) < 3 * side:
            return []
        ratios = target.appearance.colour_log_ratios(
            localiser.photometric.corrected(working, target.local_gain.log_gain)
        )
        inner = cv2.blur(ratios, (side, side))
        outer = cv2.blur(ratios, (2 * side + 1, 2 * side + 1))
        gain = 1.0 / target.appearance.colour_scale
        response = np.asarray(cv2.addWeighted(inner, gain, outer, -0.5 * gain, 0.0), np.float32)
        strong = (response > _MIN_COLOUR_RESPONSE).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(strong)
        x, y = max(x - side, 0), max(y - side, 0)  # what is beyond has no influence
        near = np.s_[y : y + height + 2 * side, x : x + width + 2 * side]
        strong[near] &= response[near] >= cv2.dilate(response[near], np.ones((2 * side + 1,) * 2, np.uint8))
        rows, columns = np.nonzero(strong)
        order = np.argsort(response[rows, columns], kind="stable")[::-1][:_MAX_BLOBS]
        at = np.column_stack([columns, rows])[order].astype(np.float64)
        ground = localiser.target_ground((at + 0.5) * localiser.downscale - 0.5)
        scores = np.minimum(response[rows[order], columns[order]], 1.0)
        return [
            Candidate(position, float(score), float(score), 0.0, 1.0)
            for position, score in zip(ground, scores, strict=True)
            if np.isfinite(position).all()
        ]


def path_plausibility(blob: Tracklet, fit: MotionFit, length: float, time: float) -> float:
    """Likelihood, up to a factor, of a path with at most one turn from the last detection to ``blob``; 0 = impossible.

    length: of the target, as tolerance.
    """
    motion = blob.velocity()
    if motion is None or fit.speed < 1.0:
        return 0.0
    speed = float(np.hypot(*motion[0]))
    if not _MIN_SPEED_RATIO * fit.speed < speed < _MAX_SPEED_RATIO * fit.speed:
        return 0.0
    heading_before, heading_now = fit.velocity / fit.speed, motion[0] / max(speed, 1e-6)
    offset: Floats = blob.positions[-1] - fit.position
    cross = float(heading_before[0] * heading_now[1] - heading_before[1] * heading_now[0])
    if abs(cross) < np.sin(_MAX_STRAIGHT_ANGLE):
        if float(heading_before @ heading_now) < 0.0:
            return 0.0
        legs = (float(offset @ heading_before), 0.0)
    else:
        # Distances along the old course and along the new one.
        legs = (
            float(offset[0] * heading_now[1] - offset[1] * heading_now[0]) / cross,
            float(heading_before[0] * offset[1] - heading_before[1] * offset[0]) / cross,
        )
    if min(legs) < -length:
        return 0.0
    expected_length = fit.speed * (time - fit.time)
    deviation = (sum(legs) - expected_length) / (_RELATIVE_LENGTH_STD * expected_length + length)
    return float(np.exp(-0.5 * deviation * deviation)) if abs(deviation) < _GATE else 0.0
