"""Guidance commands to the vehicle: gimbal pointing and FOLLOW_TARGET. Disabled unless allowed by configuration.

Every command is bounded, and none is sent unless the target is visible or predicted within limits, the link is alive
and the operator has not stopped it. FOLLOW_TARGET moves the vehicle: it also has to be armed by an operator for each
target, and ends for good at the fence. Silence is the safe state: an autopilot that receives no more of it hovers.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, CAMERA, mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.settings import GuidanceLimits
from edge.uav.navigation import Origin
from protocols.geometry.types import Floats

_CONFIGURE_S = 5.0  # between two claims of the gimbal, where no manager says who controls it
_CLAIM_TAKES_S = 2.0  # after which the manager's status, twice a second, shows the outcome of a claim
_OWN, _NOBODY = "own", ""  # who controls a gimbal
_MIN_HORIZONTAL_M = 3.0  # horizontal distance below which the bearing to the target is undefined
_TARGET_HEIGHT_M = 0.7  # of a car's middle above the ground
_NOT_ARMED = "follow is not armed"


@dataclass(frozen=True, slots=True, eq=False)
class GuidanceTarget:
    """The target estimate at host ``time_s``: position (2,) and velocity (2,) north, east [m, m/s] from the origin.

    std_m: of the position. unseen_s: time since it was last visible.
    """

    time_s: float
    position: Floats
    velocity: Floats
    std_m: float
    unseen_s: float


class Guidance:
    """Sends guidance commands at ``rate_hz`` while allowed. hold_reason: why none are sent; "" while they are.

    armed_by: the station that armed FOLLOW_TARGET for the present target; None while it is not armed. gimbal_taken_by:
    who took control of the gimbal since the target was selected, for whom it is left alone; "" while nobody has.
    """

    def __init__(self, link: Link, limits: GuidanceLimits, *, rate_hz: float = 10.0) -> None:
        self._link, self.limits = link, limits
        self._period = 1.0 / rate_hz
        self._due_s = self._configure_s = -math.inf
        self._holders: dict[int, str] = {}  # by gimbal device
        self._release()
        self._angles: tuple[float, float] | None = None
        self._start_position: Floats | None = None
        self.armed_by: int | None = None
        self._disarmed = _NOT_ARMED
        self.counters: Counter[str] = Counter()
        self.hold_reason = "commands are off" if not (limits.gimbal or limits.follow) else "no target"

    def begin(self, vehicle: Floats | None) -> None:
        """A target was selected while the vehicle was at a position (3,) NED [m]: the gimbal is claimed for it."""
        self._release()
        self._start_position = None if vehicle is None else vehicle.copy()
        self._angles = None
        self.armed_by, self._disarmed = None, _NOT_ARMED

    def handle_gimbal_status(self, status: Any, now_s: float) -> None:
        """Take a GIMBAL_MANAGER_STATUS of the vehicle: who took the gimbal keeps it, until it is free again."""
        system, component = status.primary_control_sysid, status.primary_control_compid
        holder = (
            _OWN if (system, component) == (self._link.system, CAMERA) else f"system {system}" if system else _NOBODY
        )
        if int(status.flags) & mavlink.GIMBAL_MANAGER_FLAGS_RC_EXCLUSIVE:
            holder = "remote control"
        self._holders[status.gimbal_device_id] = holder
        holders = set(self._holders.values())  # of several gimbals only the first may be commanded
        if _OWN in holders:
            self._controls, self.gimbal_taken_by = True, ""
        elif holders == {_NOBODY}:
            if self._controls or self.gimbal_taken_by:
                self._release()
        elif self._controls or now_s - self._claimed_s > _CLAIM_TAKES_S:
            # Before its claim has arrived, another one may still have it from an earlier use.
            self._controls, self.gimbal_taken_by = False, max(holders)

    def _release(self) -> None:
        self._controls, self.gimbal_taken_by = False, ""
        self._holders.clear()
        self._claimed_s, self._configure_s = math.inf, -math.inf

    def arm(self, station: int) -> bool:
        """An operator allows FOLLOW_TARGET for the present target; whether the configuration does too."""
        if self.limits.follow:
            self.armed_by = station
            self.counters["armed"] += 1
        return self.limits.follow

    def disarm(self, reason: str = "") -> None:
        """FOLLOW_TARGET has to be armed again."""
        if self.armed_by is not None:
            self.armed_by, self._disarmed = None, reason or _NOT_ARMED
            self.counters["disarmed"] += 1

    def hold(self, hold_reason: str) -> None:
        """Stop sending commands, for the given reason."""
        if self.limits.gimbal or self.limits.follow:
            if self._angles is not None or not self.hold_reason:
                self.counters["held"] += 1
            self.hold_reason = hold_reason
        self._angles = None

    def tick(
        self, now_s: float, target: GuidanceTarget, vehicle: Floats, vehicle_velocity: Floats, origin: Origin | None
    ) -> None:
        """Send the commands that are due. vehicle, vehicle_velocity: (3,) NED now."""
        limits = self.limits
        if not (limits.gimbal or limits.follow) or now_s < self._due_s:
            return
        reason = self._refusal(target, vehicle)
        if reason:
            self.hold(reason)
            return
        ahead = now_s - target.time_s
        position = target.position + float(np.clip(ahead, 0.0, 1.0)) * target.velocity
        reason = self._follow_refusal(position, vehicle) if limits.follow else "off"
        points = limits.gimbal and not self.gimbal_taken_by
        if reason and not points:
            self.hold(f"{self.gimbal_taken_by} controls the gimbal" if limits.gimbal else reason)
            return
        self.hold_reason = ""
        self._due_s = max(self._due_s + self._period, now_s + 0.5 * self._period)
        if points:
            self._point(now_s, position, vehicle)
        if not reason and origin is not None:
            self._follow(now_s, position, target, origin)

    def _follow_refusal(self, position: Floats, vehicle: Floats) -> str:
        """Why the vehicle may not follow; at the fence and beyond its heights it has to be armed again."""
        if self.armed_by is None:
            return self._disarmed
        limits = self.limits
        reason = "beacon is the vehicle's own system id" if limits.beacon == self._link.vehicle else ""
        if not max(float(np.hypot(*position[:2])), float(np.hypot(*vehicle[:2]))) <= limits.fence_m:
            reason = f"fence: {limits.fence_m:.0f} m from take-off"
        elif not limits.height_m[0] <= -vehicle[2] <= limits.height_m[1]:
            reason = f"height {-vehicle[2]:.0f} m, not {limits.height_m[0]:.0f} to {limits.height_m[1]:.0f} m"
        if reason:
            self.disarm(reason)
        return reason

    def _refusal(self, target: GuidanceTarget, vehicle: Floats) -> str:
        limits = self.limits
        if target.unseen_s > limits.coast_s:
            return f"not seen for {target.unseen_s:.0f} s"
        if not target.std_m <= limits.std_m:
            return f"its position is known only to {target.std_m:.0f} m"
        start = vehicle if self._start_position is None else self._start_position
        if not float(np.hypot(*(target.position - start[:2]))) <= limits.range_m:
            return f"farther than {limits.range_m:.0f} m from where it was selected"
        if not -vehicle[2] > 1.0:
            return "the vehicle is on the ground"
        return ""

    def _point(self, now_s: float, position: Floats, vehicle: Floats) -> None:
        if now_s >= self._configure_s and not self._controls:
            self._configure_s = now_s + _CONFIGURE_S
            self._claimed_s = min(self._claimed_s, now_s)
            vehicle_id, own, command = (
                self._link.vehicle,
                self._link.system,
                mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
            )
            self._link.send(
                mavlink.MAVLink_command_long_message(vehicle_id, AUTOPILOT, command, 0, own, CAMERA, -1, -1, 0, 0, 0)
            )
        to_target = np.append(position, -_TARGET_HEIGHT_M) - vehicle
        horizontal = float(np.hypot(to_target[0], to_target[1]))
        pitch = float(np.clip(-math.atan2(to_target[2], horizontal), *np.radians(self.limits.pitch_deg)))
        yaw = math.atan2(to_target[1], to_target[0])
        if self._angles is not None:
            max_step = math.radians(self.limits.rate_deg_s) * max(self._period, 0.02)
            turn = (yaw - self._angles[1] + math.pi) % (2.0 * math.pi) - math.pi
            if horizontal < _MIN_HORIZONTAL_M:
                turn = 0.0  # straight below the vehicle the bearing is undefined
            pitch = self._angles[0] + float(np.clip(pitch - self._angles[0], -max_step, max_step))
            yaw = self._angles[1] + float(np.clip(turn, -max_step, max_step))
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

    def _follow(self, now_s: float, position: Floats, target: GuidanceTarget, origin: Origin) -> None:
        speed = float(np.hypot(*target.velocity))
        velocity = target.velocity * min(1.0, self.limits.speed / max(speed, 1e-9))
        latitude, longitude, altitude = origin.to_geodetic(float(position[0]), float(position[1]), 0.0)
        self._link.send(
            mavlink.MAVLink_follow_target_message(
                round(1e3 * now_s),
                0b11,  # position and velocity are valid
                round(1e7 * latitude),
                round(1e7 * longitude),
                altitude,
                [float(velocity[0]), float(velocity[1]), 0.0],
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0],
                [target.std_m**2, target.std_m**2, 0.0],
                0,
            )
        )
        self.counters["follow_targets"] += 1
