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
_DRIFT_M_S = 0.1
"""Std by which the ground frame drifts each second: by metres within half a minute. Of gaps of 8 s it made 0.5 m."""
_LONGEST_GAP_S = 0.8  # between attitudes: interpolated in 0.8 s 0.27° rms off, as an autopilot's, in 1.5 s 0.73°
_CRUISE_M_S = 10.0  # of a vehicle whose samples do not tell
_MIN_COSINE = 0.6  # between the ray and straight down: for flatter rays a small tilt error is metres
_ROLL_PITCH_STD_RAD = 0.005  # of an autopilot's roll and pitch
_HEADING_STD_RAD = 0.035  # of its heading, 2 degrees: a compass, corrected for the field of currents in flight
_MIN_HEIGHT_M = 2.0  # of the camera: below, an error of the height in metres is as large as the height
_CAR_CENTRE_HEIGHT_M = 0.7  # above the ground: 0.155 of a car's length of 4.5 m, as the ground tracker takes it
_CENTRE_HEIGHT_STD_M = 0.7  # of that height: a person's is 0.9 m, a boat's with its mast 2 m


def ground_point(ray: Floats, centre: Floats, least_down: float, above: float = 0.0) -> Floats | None:
    """Where a ray meets the ground: (2,) north, east [m]; None if not observable.

    ray: (3,) direction NED of any length. centre: (3,) NED [m] where it starts. least_down: least cosine between the
    ray and straight down. above: height of the plane above the ground [m].
    """
    ray = ray / np.linalg.norm(ray)
    height = -float(centre[2])
    if not (ray[2] > least_down and height > _MIN_HEIGHT_M):
        return None
    return np.asarray(centre[:2] + (height - above) / ray[2] * ray[:2])


def _tilt_std(place: Floats, centre: Floats, tilt: float) -> float:
    """Std [m], one coordinate, of a place (2,) seen from a centre (3,), by that of roll and pitch [rad]."""
    height = max(-float(centre[2]), _MIN_HEIGHT_M)
    return tilt * height * (1.0 + (float(np.hypot(*(place - centre[:2]))) / height) ** 2)


def _ground_std(place: Floats, centre: Floats) -> float:
    """Std [m], one coordinate, of a place (2,) seen from a centre (3,), by the attitude and the target's height."""
    distance = float(np.hypot(*(place - centre[:2])))
    aside = _HEADING_STD_RAD * distance
    along = _CENTRE_HEIGHT_STD_M * distance / max(-float(centre[2]), _MIN_HEIGHT_M)
    return math.hypot(_tilt_std(place, centre, _ROLL_PITCH_STD_RAD), math.hypot(aside, along) / math.sqrt(2.0))


class Georeference:
    """Corrects target positions to the vehicle's frame; fed with telemetry on the camera's clock.

    lens, body_from_camera: the camera's intrinsics and mounting. clock_std_s: of the telemetry's clock against the
    camera's; 0 where it is known. Else nothing is corrected, and the std has what the clock's error means.
    offset: (2,) north, east [m] from the tracker's ground frame to the vehicle's, smoothed; None while unknown.
    """

    def __init__(self, lens: Intrinsics, body_from_camera: Floats, clock_std_s: float = 0.0) -> None:
        self._lens, self._clock_std_s = lens, clock_std_s
        self._telemetry = TelemetryTrack(np.asarray(body_from_camera), _LONGEST_GAP_S)
        self._centre: Floats | None = None  # of the newest sample, for stds where none are near
        self._frame: tuple[int, ...] | None = None
        self._known_s = self._known_std = 0.0  # since when the ground frame drifts, and its std [m] by then
        self.offset: Floats | None = None

    def add(self, sample: Telemetry) -> None:
        """Add a telemetry sample."""
        self._telemetry.add(sample)
        if sample.position is not None and np.isfinite(sample.position).all():
            self._centre = np.asarray(sample.position, dtype=np.float64)

    def reset(self) -> None:
        """Start over for another target, whose ground frame is new."""
        self.offset = self._frame = None

    def locate(self, x: float, y: float, time: float) -> Floats | None:
        """Ground position (2,) north, east [m] of the target at a pixel; None if not observable."""
        camera_from_ned, centre = self._telemetry.rotation_at(time), self._telemetry.position_at(time)
        if camera_from_ned is None or centre is None or not (math.isfinite(x) and math.isfinite(y)):
            return None
        bound = 2.0 * max(self._lens.width, self._lens.height)
        if max(abs(x), abs(y)) > bound:
            return None
        ray = camera_from_ned.T @ np.append(self._lens.unproject(np.array([[x, y]]))[0], 1.0)
        return ground_point(ray, centre, _MIN_COSINE, _CAR_CENTRE_HEIGHT_M)

    def corrected(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate with its position in the vehicle's frame and the std of that, where its ground is metric."""
        if not (math.isfinite(estimate.north) and math.isfinite(estimate.east)):
            return estimate
        place = np.array([estimate.north, estimate.east])
        if estimate.ground_frame != self._frame:
            self._frame, self.offset, self._known_s = estimate.ground_frame, None, time
            self._known_std = self._std_of_start(estimate, time)
        measured = None if self._clock_std_s else self.locate(estimate.x, estimate.y, time)
        if measured is not None:
            difference = measured - place
            gain = 1.0 if self.offset is None else -math.expm1(-max(time - self._known_s, 0.0) / _TIME_CONSTANT_S)
            self.offset = difference if self.offset is None else self.offset + gain * (difference - self.offset)
            # Errors of one report's positions are alike: the mean of the stds, not of their squares.
            self._known_std += gain * (self._telemetry_std(measured, time, time) - self._known_std)
            self._known_s = time
        if self.offset is not None:
            place = place + self.offset
        centre = self._centre_at(time)
        drift = _DRIFT_M_S * (time - self._known_s)
        ground = 0.0 if centre is None else _ground_std(place, centre)
        std_m = math.hypot(estimate.std_m, ground, drift, self._known_std)
        return replace(estimate, north=float(place[0]), east=float(place[1]), std_m=std_m)

    def _std_of_start(self, estimate: Estimate, time: float) -> float:
        """Std [m], one coordinate, of a ground frame that begins at a time with the nearest sample.

        Its attitude is continued up to that time, also beyond the last sample.
        """
        nearest = self._telemetry.nearest_time(time)
        off = math.hypot(self._clock_std_s, time - nearest)
        early, late = (self._telemetry.nearest_time(nearest + shift) for shift in (-off, off))
        places = [self.locate(estimate.x, estimate.y, moment) for moment in (early, late)]
        speed = _CRUISE_M_S
        if late > early and places[0] is not None and places[1] is not None:
            speed = float(np.hypot(*(places[1] - places[0]))) / (late - early)
        place = np.array([estimate.north, estimate.east])
        return math.hypot(speed * off / math.sqrt(2.0), self._telemetry_std(place, nearest, time))

    def _telemetry_std(self, place: Floats, time: float, attitude_time: float) -> float:
        """Std [m], one coordinate, of a place (2,) by the position at one time and the attitude at another."""
        centre, tilt = self._centre_at(time), self._telemetry.stds_at(attitude_time)[1]
        aside = 0.0 if centre is None else _tilt_std(place, centre, tilt)
        return math.hypot(self._telemetry.stds_at(time)[0], aside)

    def _centre_at(self, time: float) -> Floats | None:
        """Position (3,) of the vehicle, of its newest sample where none are near."""
        centre = self._telemetry.position_at(time)
        return self._centre if centre is None else centre
