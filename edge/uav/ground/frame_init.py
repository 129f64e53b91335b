"""Where the ground frame comes from: telemetry where it is there, else the first picture itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.ground.image_plane import ImagePlane, inverse, transfer
from edge.uav.ground.plane_motion import ChainPlane, PosePlane
from edge.uav.timing.telemetry_track import TelemetryClock
from edge.uav.tracker import Box
from protocols.geometry.types import Floats

CAR_LENGTH = 4.5
"""What the target's longer side is taken for where nothing gives the scale [ground units]."""
_SHORTEST_CAR, _LONGEST_CAR = 1.2, 30.0  # of what a target can be [m]
_LOWEST = 2.0  # height that can be meant [m]
_STEEPEST = 12.0  # distance on the ground over the height: beyond, the target is near the horizon


@dataclass(frozen=True, slots=True, eq=False)
class Root:
    """A start of the ground frame. kind: "metric", "attitude" (scale unknown) or "picture"."""

    motion: PosePlane | ChainPlane
    kind: str

    @property
    def rank(self) -> int:
        """The more is known, the higher."""
        return ("picture", "attitude", "metric").index(self.kind)


def root_from_telemetry(plane: ImagePlane, clock: TelemetryClock | None, time: float, target: Box) -> Root | None:
    """A pose over the plane from the attitude nearest to ``time``; None where there is none or it can't be meant."""
    if clock is None or plane.lens is None:
        return None
    found = clock.nearest(time, within=0.6)
    if found is None:
        return None
    rotation, position = found
    seen = plane.normalise(_corners(target))
    if position is not None and -position[2] > _LOWEST:
        motion = PosePlane(rotation, np.asarray(position, dtype=np.float64))
        if not _in_reach(motion, seen):
            return None
        longer = _longer_side(motion, seen)
        # A height from which the target is a toy or a ship is wrong; the attitude may still be right.
        if _SHORTEST_CAR < longer < _LONGEST_CAR:
            return Root(motion, "metric")
    unit = PosePlane(rotation, np.array([0.0, 0.0, -1.0]))
    if not _in_reach(unit, seen):
        return None
    height = CAR_LENGTH / max(_longer_side(unit, seen), 1e-9)
    return Root(PosePlane(rotation, np.array([0.0, 0.0, -height])), "attitude")


def _longer_side(motion: PosePlane, seen: Floats) -> float:
    """Of the box with normalised corners (4, 2), on the ground."""
    corners = transfer(inverse(motion.matrix), seen)
    return float(max(np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(corners[3] - corners[0])))


def root_from_picture(plane: ImagePlane, target: Box) -> Root:
    """The first picture is the ground, seen from straight above; the target is a car's length long."""
    size = max(target.width, target.height) / plane.focal / CAR_LENGTH
    matrix = np.diag([size, size, 1.0])
    return Root(ChainPlane(matrix / np.cbrt(np.linalg.det(matrix))), "picture")


def _corners(target: Box) -> Floats:
    x0, y0, x1, y1 = target.x, target.y, target.x + target.width - 1.0, target.y + target.height - 1.0
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def _in_reach(motion: PosePlane, seen: Floats) -> bool:
    """Whether all of these image points are on the ground and not near the horizon."""
    try:
        ground = transfer(inverse(motion.matrix), seen)
    except np.linalg.LinAlgError:
        return False
    if not np.isfinite(ground).all():
        return False
    away = np.linalg.norm(ground - motion.centre[:2], axis=1).max()
    return bool(away < _STEEPEST * abs(float(motion.centre[2])))
