"""Where on the earth a target is: its pixel, and the vehicle's own attitude and place.

A tracker's ground frame is one piece in itself, but wanders against the receiver's: by metres within half a minute of
a lively flight. What is told to others, or flown to, must not.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from edge.uav.timing.telemetry_track import TelemetryClock
from edge.uav.tracker import Estimate, Telemetry
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_SMOOTH_S = 0.5
_STEEPEST = 0.6  # least cosine between the ray and straight down: flatter, and a small tilt is metres
_LEVEL_STD_RAD = 0.005  # of an autopilot's roll and pitch
_LOWEST_M = 2.0
_CAR_MIDDLE_M = 0.7


class Georeference:
    """Fed with telemetry on the camera's clock. lens, body_from_camera: the camera's.

    offset: (2,) north, east [m] from the tracker's ground frame to the vehicle's; None while not known.
    """

    def __init__(self, lens: Intrinsics, body_from_camera: Floats) -> None:
        self._lens = lens
        self._telemetry = TelemetryClock(np.asarray(body_from_camera))
        self._last_s = -math.inf
        self.offset: Floats | None = None

    def add(self, sample: Telemetry) -> None:
        """Take a sample."""
        self._telemetry.add(sample)

    def clear(self) -> None:
        """Another target: its ground frame begins anew."""
        self.offset = None
        self._last_s = -math.inf

    def place(self, x: float, y: float, time: float) -> tuple[Floats, float] | None:
        """Ground (2,) north, east [m] of the target's middle at a pixel, and its std [m]; None: it can't be told."""
        camera_from_ned, centre = self._telemetry.rotation_at(time), self._telemetry.position_at(time)
        if camera_from_ned is None or centre is None or not (math.isfinite(x) and math.isfinite(y)):
            return None
        bound = 2.0 * max(self._lens.width, self._lens.height)
        if max(abs(x), abs(y)) > bound or -centre[2] < _LOWEST_M:
            return None
        ray = camera_from_ned.T @ np.append(self._lens.unproject(np.array([[x, y]]))[0], 1.0)
        ray = ray / np.linalg.norm(ray)
        if not ray[2] > _STEEPEST:
            return None
        height = -float(centre[2]) - _CAR_MIDDLE_M
        ground: Floats = centre[:2] + height / ray[2] * ray[:2]
        return ground, _LEVEL_STD_RAD * height / float(ray[2]) ** 2

    def corrected(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate with its place in the vehicle's frame; unchanged where its ground is not metric."""
        if not (math.isfinite(estimate.north) and math.isfinite(estimate.east)):
            return estimate
        told = self.place(estimate.x, estimate.y, time)
        own = np.array([estimate.north, estimate.east])
        if told is not None:
            gap = told[0] - own
            share = 1.0 if self.offset is None else -math.expm1(-max(time - self._last_s, 0.0) / _SMOOTH_S)
            self.offset = gap if self.offset is None else self.offset + share * (gap - self.offset)
        self._last_s = time
        if self.offset is None:
            return estimate
        north, east = own + self.offset
        level = told[1] if told is not None else 0.0
        return replace(estimate, north=float(north), east=float(east), std_m=math.hypot(estimate.std_m, level))
