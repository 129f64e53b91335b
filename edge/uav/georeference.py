"""Georeferencing of the target: its pixel is intersected with the ground by the vehicle's attitude and position.

A tracker's ground frame is consistent in itself but drifts against the receiver's frame, by metres within half a minute
of agile flight. What is published or flown to must not drift, so it is corrected to the vehicle's frame.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from edge.uav.base import Estimate, Telemetry
from edge.uav.timing.telemetry_track import TelemetryTrack
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_TIME_CONSTANT_S = 0.5  # of the offset's mean: longer ones lag behind the drift, shorter ones keep the attitude's noise
_MIN_COSINE = 0.6  # between the ray and straight down: for flatter rays a small tilt error is metres
_ROLL_PITCH_STD_RAD = 0.005  # of an autopilot's roll and pitch
_MIN_HEIGHT_M = 2.0  # of the camera: below, an error of the height in metres is as large as the height
_CAR_CENTRE_HEIGHT_M = 0.7  # above the ground: 0.155 of a car's length of 4.5 m, as the ground tracker takes it


def ground_point(ray: Floats, centre: Floats, least_down: float, above: float = 0.0) -> tuple[Floats, float] | None:
    """Where a ray meets the ground: (2,) north, east [m] and its std by the attitude's [m]; None if not observable.

    ray: (3,) direction NED of any length. centre: (3,) NED [m] where it starts. least_down: least cosine between the
    ray and straight down. above: height of the plane above the ground [m].
    """
    ray = ray / np.linalg.norm(ray)
    height = -float(centre[2])
    if not (ray[2] > least_down and height > _MIN_HEIGHT_M):
        return None
    height -= above
    ground: Floats = centre[:2] + height / ray[2] * ray[:2]
    return ground, _ROLL_PITCH_STD_RAD * height / float(ray[2]) ** 2


class Georeference:
    """Corrects target positions to the vehicle's frame; fed with telemetry on the camera's clock.

    lens, body_from_camera: the camera's intrinsics and mounting.
    offset: (2,) north, east [m] from the tracker's ground frame to the vehicle's, smoothed; None while unknown.
    """

    def __init__(self, lens: Intrinsics, body_from_camera: Floats) -> None:
        self._lens = lens
        self._telemetry = TelemetryTrack(np.asarray(body_from_camera))
        self._last_s = -math.inf
        self.offset: Floats | None = None

    def add(self, sample: Telemetry) -> None:
        """Add a telemetry sample."""
        self._telemetry.add(sample)

    def reset(self) -> None:
        """Start over for another target, whose ground frame is new."""
        self.offset = None
        self._last_s = -math.inf

    def locate(self, x: float, y: float, time: float) -> tuple[Floats, float] | None:
        """Ground position (2,) north, east [m] of the target at a pixel, and its std [m]; None if not observable."""
        camera_from_ned, centre = self._telemetry.rotation_at(time), self._telemetry.position_at(time)
        if camera_from_ned is None or centre is None or not (math.isfinite(x) and math.isfinite(y)):
            return None
        bound = 2.0 * max(self._lens.width, self._lens.height)
        if max(abs(x), abs(y)) > bound:
            return None
        ray = camera_from_ned.T @ np.append(self._lens.unproject(np.array([[x, y]]))[0], 1.0)
        return ground_point(ray, centre, _MIN_COSINE, _CAR_CENTRE_HEIGHT_M)

    def corrected(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate with its position in the vehicle's frame; unchanged where its ground frame is not metric."""
        if not (math.isfinite(estimate.north) and math.isfinite(estimate.east)):
            return estimate
        measured = self.locate(estimate.x, estimate.y, time)
        in_tracker_frame = np.array([estimate.north, estimate.east])
        if measured is not None:
            difference = measured[0] - in_tracker_frame
            gain = 1.0 if self.offset is None else -math.expm1(-max(time - self._last_s, 0.0) / _TIME_CONSTANT_S)
            self.offset = difference if self.offset is None else self.offset + gain * (difference - self.offset)
        self._last_s = time
        if self.offset is None:
            return estimate
        north, east = in_tracker_frame + self.offset
        tilt_std = measured[1] if measured is not None else 0.0
        return replace(estimate, north=float(north), east=float(east), std_m=math.hypot(estimate.std_m, tilt_std))
