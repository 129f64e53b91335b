"""Initialisation of the ground frame: from telemetry where available, else from the first image alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.base import Box
from edge.uav.ground.image_plane import ImagePlane, apply_homography, inverse
from edge.uav.ground.plane_pose import PlaneHomography, PlanePose
from edge.uav.timing.telemetry_track import TelemetryTrack
from protocols.geometry.types import Floats

CAR_LENGTH = 4.5
"""Assumed length of the target where the scale is not observable [ground units]."""
_MIN_LENGTH, _MAX_LENGTH = 0.3, 30.0  # of a plausible target [m]: a person from above is 0.5 m
_MIN_HEIGHT = 2.0  # of the camera for a plausible position [m]
_MAX_RANGE_RATIO = 12.0  # horizontal distance over height: beyond, the target is near the horizon


@dataclass(frozen=True, slots=True, eq=False)
class GroundFrame:
    """An initial camera pose that defines the ground frame. kind: "metric", "attitude" (scale unknown) or "image"."""

    pose: PlanePose | PlaneHomography
    kind: str

    @property
    def rank(self) -> int:
        """Higher if more degrees of freedom of the frame are known."""
        return ("image", "attitude", "metric").index(self.kind)


def frame_from_telemetry(
    plane: ImagePlane, telemetry: TelemetryTrack | None, time: float, target: Box
) -> GroundFrame | None:
    """A pose over the plane from the attitude nearest to ``time``; None if there is none or it is implausible."""
    if telemetry is None or plane.lens is None:
        return None
    found = telemetry.nearest(time, within=0.6)
    if found is None:
        return None
    rotation, position = found
    normalised = plane.normalise(_corners(target))
    if position is not None and -position[2] > _MIN_HEIGHT:
        pose = PlanePose(rotation, np.asarray(position, dtype=np.float64))
        if not _is_within_range(pose, normalised):
            return None
        longer_side = _longer_side(pose, normalised)
        # A height that makes the target as small as a toy or as long as a ship is wrong; the attitude may be right.
        if _MIN_LENGTH < longer_side < _MAX_LENGTH:
            return GroundFrame(pose, "metric")
    at_unit_height = PlanePose(rotation, np.array([0.0, 0.0, -1.0]))
    if not _is_within_range(at_unit_height, normalised):
        return None
    height = CAR_LENGTH / max(_longer_side(at_unit_height, normalised), 1e-9)
    return GroundFrame(PlanePose(rotation, np.array([0.0, 0.0, -height])), "attitude")


def _longer_side(pose: PlanePose, normalised: Floats) -> float:
    """Longer side on the ground of the box with normalised corners (4, 2)."""
    corners = apply_homography(inverse(pose.matrix), normalised)
    return float(max(np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(corners[3] - corners[0])))


def frame_from_image(plane: ImagePlane, target: Box) -> GroundFrame:
    """A frame in which the first image is the ground seen from straight above and the target has a car's length."""
    size = max(target.width, target.height) / plane.focal / CAR_LENGTH
    matrix = np.diag([size, size, 1.0])
    return GroundFrame(PlaneHomography(matrix / np.cbrt(np.linalg.det(matrix))), "image")


def _corners(target: Box) -> Floats:
    x0, y0, x1, y1 = target.x, target.y, target.x + target.width - 1.0, target.y + target.height - 1.0
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def _is_within_range(pose: PlanePose, normalised: Floats) -> bool:
    """Whether all of these normalised image points lie on the ground and not near the horizon."""
    try:
        ground = apply_homography(inverse(pose.matrix), normalised)
    except np.linalg.LinAlgError:
        return False
    if not np.isfinite(ground).all():
        return False
    distance = np.linalg.norm(ground - pose.centre[:2], axis=1).max()
    return bool(distance < _MAX_RANGE_RATIO * abs(float(pose.centre[2])))
