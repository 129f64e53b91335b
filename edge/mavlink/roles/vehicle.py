"""The vehicle as an agent sees it: asks for rates and time, and turns what it says into samples on the host's clock."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, GIMBAL, mavlink
from edge.mavlink.link.connection import Heard, Link
from edge.mavlink.roles.telemetry import (
    Attitude,
    GimbalAttitude,
    GlobalPosition,
    LocalPosition,
    SystemTime,
    ned_from_gimbal,
    report,
)
from edge.uav.navigation import Origin
from edge.uav.timing.vehicle_clock import VehicleClock
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats

_TRIP_S = 0.5  # between questions about the time
_ASK_AGAIN_S = 5.0  # for rates, which an autopilot forgets when it restarts
_POSITION_S = 1.0  # for how long a position is carried on at its velocity
_HEADING_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """host_ns: the host's clock when it was measured; vehicle_ns: the vehicle's. ned_from_mount: (3, 3) of what

    carries the camera. position: (3,) NED [m] of ``origin``, None where unknown. velocity: (3,).
    """

    host_ns: int
    vehicle_ns: int
    std_s: float
    ned_from_mount: Floats
    position: Floats | None
    velocity: Floats | None


class Vehicle:
    """One vehicle on one link. gimbal: the camera hangs on it. rate_hz: asked for of attitude and position."""

    def __init__(self, link: Link, *, gimbal: bool, rate_hz: float = 30.0) -> None:
        self._link, self._gimbal, self._rate_hz = link, gimbal, rate_hz
        self.clock = VehicleClock()
        self.origin: Origin | None = None
        self.attitude: Attitude | None = None
        self.armed = False
        self.unix_offset_s: float | None = None
        """Unix time − the vehicle's clock [s], where it knows it."""
        self._place: tuple[float, Floats, Floats] | None = None
        self._local_s = -1e9
        self._quaternion_s = -1e9
        self._next_trip_s = self._next_ask_s = -1e9
        self._asked = 0
        self.stamped_at_reboot = 0

    @property
    def velocity(self) -> Floats | None:
        """Of the vehicle, (3,) NED [m/s]."""
        return None if self._place is None else self._place[2]

    @property
    def position(self) -> Floats | None:
        """Of the vehicle, (3,) NED [m] of ``origin``."""
        return None if self._place is None else self._place[1]

    def tick(self, now_ns: int) -> None:
        """Ask what is to be asked."""
        now = now_ns / NANOSECONDS
        if self._link.vehicle is None or not self._link.open:
            return
        if now >= self._next_trip_s:
            self._next_trip_s = now + _TRIP_S
            self._link.send(mavlink.MAVLink_timesync_message(0, now_ns))
        if now >= self._next_ask_s:
            self._next_ask_s = now + _ASK_AGAIN_S
            for kind, rate in self._wanted():
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                component = GIMBAL if kind.startswith("GIMBAL_DEVICE") else AUTOPILOT
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, component, number, round(1e6 / rate))

    def handle(self, heard: Heard) -> list[Sample]:
        """Take a message of the vehicle; the samples that it completes."""
        message = heard.message
        if heard.kind == "TIMESYNC":
            if message.tc1 > 0 and heard.component == AUTOPILOT:
                if not self.clock.handle_trip(message.ts1, message.tc1, heard.received_ns):
                    self._began_anew()
            elif message.tc1 == 0 and heard.component == AUTOPILOT:
                self._link.send(mavlink.MAVLink_timesync_message(heard.received_ns, message.ts1))
            return []
        if heard.kind == "HEARTBEAT":
            if heard.component == AUTOPILOT:
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            return []
        told = report(message)
        if told is None:
            return []
        boot_ns = round(told.boot_s * NANOSECONDS)
        if heard.component == AUTOPILOT and not self.clock.handle_time(boot_ns, heard.received_ns):
            self._began_anew()
        if isinstance(told, Attitude):
            return self._take_attitude(told, heard.kind == "ATTITUDE_QUATERNION")
        if isinstance(told, GimbalAttitude):
            return self._take_gimbal(told)
        if isinstance(told, LocalPosition):
            if self._local_s < 0.0:
                self.origin = None  # until now it was where the vehicle was first heard, not this frame's origin
            self._local_s = told.boot_s
            self._place = (told.boot_s, told.position, told.velocity)
        elif isinstance(told, GlobalPosition):
            self._take_global(told)
        elif isinstance(told, SystemTime) and told.unix_s > 0:
            self.unix_offset_s = told.unix_s - told.boot_s
        return []

    def command(self, command: int, component: int, *parameters: float) -> None:
        """Send a COMMAND_LONG to a component of the vehicle."""
        self._command(command, component, *parameters)

    def _wanted(self) -> Iterable[tuple[str, float]]:
        yield "ATTITUDE_QUATERNION", self._rate_hz
        yield "LOCAL_POSITION_NED", min(self._rate_hz, 20.0)
        yield "GLOBAL_POSITION_INT", 5.0
        yield "SYSTEM_TIME", 1.0
        if self._gimbal:
            yield "GIMBAL_DEVICE_ATTITUDE_STATUS", self._rate_hz

    def _command(self, command: int, component: int, *parameters: float) -> None:
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self._link.send(mavlink.MAVLink_command_long_message(self._link.vehicle, component, command, 0, *filled))

    def _take_attitude(self, told: Attitude, quaternion: bool) -> list[Sample]:
        if quaternion:
            self._quaternion_s = told.boot_s
        elif told.boot_s - self._quaternion_s < 1.0:
            return []  # the same again, coarser
        if self.attitude is not None and told.boot_s <= self.attitude.boot_s:
            return []
        self.attitude = told
        return [] if self._gimbal else [self._sample(told.boot_s, told.ned_from_body)]

    def _take_gimbal(self, told: GimbalAttitude) -> list[Sample]:
        body = self.attitude
        fresh = body is not None and abs(told.boot_s - body.boot_s) < _HEADING_S
        turned = ned_from_gimbal(told, body.ned_from_body if fresh and body is not None else None)
        return [self._sample(told.boot_s, turned)] if self._gimbal and turned is not None else []

    def _take_global(self, told: GlobalPosition) -> None:
        home = told.altitude - told.relative_altitude
        if self._place is not None and told.boot_s - self._local_s < 2.0:
            if self.origin is None:
                # The local frame stands where this place is at its local position.
                boot, place, velocity = self._place
                moved = place + (told.boot_s - boot) * velocity
                at = Origin(told.latitude, told.longitude, told.altitude).world(*(-moved))
                self.origin = Origin(*at)
            return
        if self.origin is None:
            self.origin = Origin(told.latitude, told.longitude, home)
        place = self.origin.local(told.latitude, told.longitude, told.altitude)
        self._place = (told.boot_s, place, told.velocity)

    def _sample(self, boot_s: float, turned: Floats) -> Sample:
        boot_ns = round(boot_s * NANOSECONDS)
        place = velocity = None
        if self._place is not None and abs(boot_s - self._place[0]) < _POSITION_S:
            velocity = self._place[2]
            place = np.asarray(self._place[1] + (boot_s - self._place[0]) * velocity)
        return Sample(self.clock.here(boot_ns), boot_ns, self.clock.std_s, turned, place, velocity)

    def _began_anew(self) -> None:
        """The vehicle's clock is another one: what is stamped by the old one can't be compared."""
        self.attitude = None
        self._place = None
        self._local_s = self._quaternion_s = -1e9
        self._next_ask_s = self._next_trip_s = -1e9
