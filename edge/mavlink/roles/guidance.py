"""What the agent may make the vehicle do: turn the gimbal to the target, follow it. Off unless it is allowed.

Every command is bounded, and none is sent unless the target is visible or surely predicted, the link is alive and
nobody said stop. Silence is the safe state: an autopilot that hears no more FOLLOW_TARGET stays where it is.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, CAMERA, mavlink
from edge.mavlink.link.connection import Link
from edge.uav.navigation import Origin
from protocols.geometry.types import Floats

_CONFIGURE_S = 5.0
_NEAR_M = 3.0  # less than that aside, and the direction to the target is no direction
_CAR_MIDDLE_M = 0.7


@dataclass(frozen=True, slots=True)
class Limits:
    """gimbal, follow: whether at all. pitch: lowest and highest [rad]; rate: most that the angles turn [rad/s].

    coast_s: longest without seeing the target. std_m: largest of its place. range_m: farthest from where the
    vehicle was when the target was chosen. speed: largest that is passed on [m/s].
    """

    gimbal: bool = False
    follow: bool = False
    pitch: tuple[float, float] = (-0.5 * math.pi, math.radians(10.0))
    rate: float = math.radians(60.0)
    coast_s: float = 8.0
    std_m: float = 15.0
    range_m: float = 300.0
    speed: float = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """The target: place (2,) and velocity (2,) north, east [m, m/s] of the vehicle's origin, at host time ``at_s``.

    std_m: of the place. unseen_s: since when it is only predicted.
    """

    at_s: float
    place: Floats
    velocity: Floats
    std_m: float
    unseen_s: float


class Control:
    """Sends at ``rate_hz`` while it may. stopped: by the operator; selecting a target allows it again."""

    def __init__(self, link: Link, limits: Limits, *, rate_hz: float = 10.0) -> None:
        self._link, self.limits = link, limits
        self._period = 1.0 / rate_hz
        self._due_s = self._configure_s = -math.inf
        self._angles: tuple[float, float] | None = None
        self._began: Floats | None = None
        self.counters: Counter[str] = Counter()
        self.why = "off" if not (limits.gimbal or limits.follow) else "no target"

    def begin(self, vehicle: Floats | None) -> None:
        """A target was chosen while the vehicle was at a place (3,) NED [m]."""
        self._began = None if vehicle is None else vehicle.copy()
        self._angles = None

    def hold(self, why: str) -> None:
        """Nothing may be sent: why."""
        if self.limits.gimbal or self.limits.follow:
            if self._angles is not None or not self.why:
                self.counters["held"] += 1
            self.why = why
        self._angles = None

    def tick(self, now_s: float, aim: Aim, vehicle: Floats, vehicle_velocity: Floats, origin: Origin | None) -> None:
        """Send what is due. vehicle, vehicle_velocity: (3,) NED now."""
        limits = self.limits
        if not (limits.gimbal or limits.follow) or now_s < self._due_s:
            return
        reason = self._refusal(aim, vehicle)
        if reason:
            self.hold(reason)
            return
        self.why = ""
        self._due_s = max(self._due_s + self._period, now_s + 0.5 * self._period)
        ahead = now_s - aim.at_s
        place = aim.place + float(np.clip(ahead, 0.0, 1.0)) * aim.velocity
        if limits.gimbal:
            self._point(now_s, place, vehicle)
        if limits.follow and origin is not None:
            self._follow(now_s, place, aim, origin)

    def _refusal(self, aim: Aim, vehicle: Floats) -> str:
        limits = self.limits
        if aim.unseen_s > limits.coast_s:
            return f"not seen for {aim.unseen_s:.0f} s"
        if not aim.std_m <= limits.std_m:
            return f"its place is known to {aim.std_m:.0f} m only"
        start = vehicle if self._began is None else self._began
        if not float(np.hypot(*(aim.place - start[:2]))) <= limits.range_m:
            return f"farther than {limits.range_m:.0f} m from where it was chosen"
        if not -vehicle[2] > 1.0:
            return "the vehicle is on the ground"
        return ""

    def _point(self, now_s: float, place: Floats, vehicle: Floats) -> None:
        if now_s >= self._configure_s:
            self._configure_s = now_s + _CONFIGURE_S
            system = self._link.vehicle
            self._link.send(
                mavlink.MAVLink_command_long_message(
                    system, AUTOPILOT, mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE, 0, system, CAMERA, -1, -1, 0, 0, 0
                )
            )
        gap = np.append(place, -_CAR_MIDDLE_M) - vehicle
        aside = float(np.hypot(gap[0], gap[1]))
        pitch = float(np.clip(-math.atan2(gap[2], aside), *self.limits.pitch))
        yaw = math.atan2(gap[1], gap[0])
        if self._angles is not None:
            most = self.limits.rate * max(self._period, 0.02)
            turn = (yaw - self._angles[1] + math.pi) % (2.0 * math.pi) - math.pi
            if aside < _NEAR_M:
                turn = 0.0  # straight below, any heading is as good
            pitch = self._angles[0] + float(np.clip(pitch - self._angles[0], -most, most))
            yaw = self._angles[1] + float(np.clip(turn, -most, most))
        self._angles = (pitch, (yaw + math.pi) % (2.0 * math.pi) - math.pi)
        flags = mavlink.GIMBAL_MANAGER_FLAGS_YAW_LOCK | mavlink.GIMBAL_MANAGER_FLAGS_ROLL_LOCK
        flags |= mavlink.GIMBAL_MANAGER_FLAGS_PITCH_LOCK | mavlink.GIMBAL_MANAGER_FLAGS_YAW_IN_EARTH_FRAME
        nan = float("nan")
        self._link.send(
            mavlink.MAVLink_gimbal_manager_set_pitchyaw_message(
                self._link.vehicle, AUTOPILOT, flags, 0, *self._angles, nan, nan
            )
        )
        self.counters["pointed"] += 1

    def _follow(self, now_s: float, place: Floats, aim: Aim, origin: Origin) -> None:
        speed = float(np.hypot(*aim.velocity))
        velocity = aim.velocity * min(1.0, self.limits.speed / max(speed, 1e-9))
        latitude, longitude, altitude = origin.world(float(place[0]), float(place[1]), 0.0)
        self._link.send(
            mavlink.MAVLink_follow_target_message(
                round(1e3 * now_s),
                0b11,  # position and velocity are told
                round(1e7 * latitude),
                round(1e7 * longitude),
                altitude,
                [float(velocity[0]), float(velocity[1]), 0.0],
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0],
                [aim.std_m**2, aim.std_m**2, 0.0],
                0,
            )
        )
        self.counters["follow_targets"] += 1
