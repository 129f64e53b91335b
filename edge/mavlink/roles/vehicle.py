"""The vehicle's telemetry: requests message rates and time sync, converts messages to samples on the host's clock."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, GIMBAL, mavlink
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.roles.telemetry import (
    Attitude,
    GimbalAttitude,
    GlobalPosition,
    LocalPosition,
    SystemTime,
    ned_from_gimbal,
    parse_telemetry,
)
from edge.uav.navigation import Origin
from edge.uav.timing.vehicle_clock import VehicleClock
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats

_TIMESYNC_PERIOD_S = 0.5  # between TIMESYNC requests
_RATE_REQUEST_PERIOD_S = 5.0  # of rates, which an autopilot forgets when it reboots
_MAX_POSITION_AGE_S = 1.0  # for how long a position is extrapolated at its velocity
_MAX_HEADING_AGE_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class MountSample:
    """A telemetry sample. host_ns, vehicle_ns: time of measurement on the host's and the vehicle's clock.

    std_s: of host_ns. ned_from_mount: (3, 3) of the camera's mount (airframe or gimbal). position: (3,) NED [m] from
    the vehicle's ``origin``, None where unknown. velocity: (3,) NED [m/s].
    """

    host_ns: int
    vehicle_ns: int
    std_s: float
    ned_from_mount: Floats
    position: Floats | None
    velocity: Floats | None


class Vehicle:
    """One vehicle on one link. gimbal: the camera hangs on it. rate_hz: requested rate of attitude and position."""

    def __init__(self, link: Link, *, gimbal: bool, rate_hz: float = 30.0) -> None:
        self._link, self._gimbal, self._rate_hz = link, gimbal, rate_hz
        self.clock = VehicleClock()
        self.origin: Origin | None = None
        self.attitude: Attitude | None = None
        self.armed = False
        self.unix_offset_s: float | None = None
        """Unix time minus the vehicle's clock [s], where the vehicle knows it."""
        self._last_position: tuple[float, Floats, Floats] | None = None
        self._local_s = -1e9
        self._quaternion_s = -1e9
        self._next_trip_s = self._next_ask_s = -1e9
        self._asked = 0
        self.stamped_at_reboot = 0

    @property
    def velocity(self) -> Floats | None:
        """Velocity of the vehicle, (3,) NED [m/s]."""
        return None if self._last_position is None else self._last_position[2]

    @property
    def position(self) -> Floats | None:
        """Position of the vehicle, (3,) NED [m] from ``origin``."""
        return None if self._last_position is None else self._last_position[1]

    def tick(self, now_ns: int) -> None:
        """Send the TIMESYNC and rate requests that are due."""
        now = now_ns / NANOSECONDS
        if self._link.vehicle is None or not self._link.open:
            return
        if now >= self._next_trip_s:
            self._next_trip_s = now + _TIMESYNC_PERIOD_S
            self._link.send(mavlink.MAVLink_timesync_message(0, now_ns))
        if now >= self._next_ask_s:
            self._next_ask_s = now + _RATE_REQUEST_PERIOD_S
            for kind, rate in self._message_rates():
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                component = GIMBAL if kind.startswith("GIMBAL_DEVICE") else AUTOPILOT
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, component, number, round(1e6 / rate))

    def handle(self, received: ReceivedMessage) -> list[MountSample]:
        """Handle a message of the vehicle; returns the samples that it completes."""
        message = received.message
        if received.kind == "TIMESYNC":
            if message.tc1 > 0 and received.component == AUTOPILOT:
                if not self.clock.handle_round_trip(message.ts1, message.tc1, received.received_ns):
                    self._handle_clock_reset()
            elif message.tc1 == 0 and received.component == AUTOPILOT:
                self._link.send(mavlink.MAVLink_timesync_message(received.received_ns, message.ts1))
            return []
        if received.kind == "HEARTBEAT":
            if received.component == AUTOPILOT:
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            return []
        telemetry = parse_telemetry(message)
        if telemetry is None:
            return []
        boot_ns = round(telemetry.boot_s * NANOSECONDS)
        if received.component == AUTOPILOT and not self.clock.handle_message(boot_ns, received.received_ns):
            self._handle_clock_reset()
        if isinstance(telemetry, Attitude):
            return self._take_attitude(telemetry, received.kind == "ATTITUDE_QUATERNION")
        if isinstance(telemetry, GimbalAttitude):
            return self._take_gimbal(telemetry)
        if isinstance(telemetry, LocalPosition):
            if self._local_s < 0.0:
                self.origin = None  # so far it was the vehicle's first global position, not the local frame's origin
            self._local_s = telemetry.boot_s
            self._last_position = (telemetry.boot_s, telemetry.position, telemetry.velocity)
        elif isinstance(telemetry, GlobalPosition):
            self._take_global(telemetry)
        elif isinstance(telemetry, SystemTime) and telemetry.unix_s > 0:
            self.unix_offset_s = telemetry.unix_s - telemetry.boot_s
        return []

    def command(self, command: int, component: int, *parameters: float) -> None:
        """Send a COMMAND_LONG to a component of the vehicle."""
        self._command(command, component, *parameters)

    def _message_rates(self) -> Iterable[tuple[str, float]]:
        yield "ATTITUDE_QUATERNION", self._rate_hz
        yield "LOCAL_POSITION_NED", min(self._rate_hz, 20.0)
        yield "GLOBAL_POSITION_INT", 5.0
        yield "SYSTEM_TIME", 1.0
        if self._gimbal:
            yield "GIMBAL_DEVICE_ATTITUDE_STATUS", self._rate_hz

    def _command(self, command: int, component: int, *parameters: float) -> None:
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self._link.send(mavlink.MAVLink_command_long_message(self._link.vehicle, component, command, 0, *filled))

    def _take_attitude(self, telemetry: Attitude, quaternion: bool) -> list[MountSample]:
        if quaternion:
            self._quaternion_s = telemetry.boot_s
        elif telemetry.boot_s - self._quaternion_s < 1.0:
            return []  # the same attitude at lower resolution
        if self.attitude is not None and telemetry.boot_s <= self.attitude.boot_s:
            return []
        self.attitude = telemetry
        return [] if self._gimbal else [self._sample(telemetry.boot_s, telemetry.ned_from_body)]

    def _take_gimbal(self, telemetry: GimbalAttitude) -> list[MountSample]:
        body = self.attitude
        fresh = body is not None and abs(telemetry.boot_s - body.boot_s) < _MAX_HEADING_AGE_S
        rotation = ned_from_gimbal(telemetry, body.ned_from_body if fresh and body is not None else None)
        return [self._sample(telemetry.boot_s, rotation)] if self._gimbal and rotation is not None else []

    def _take_global(self, telemetry: GlobalPosition) -> None:
        home = telemetry.altitude - telemetry.relative_altitude
        if self._last_position is not None and telemetry.boot_s - self._local_s < 2.0:
            if self.origin is None:
                # The origin is where this global position has the vehicle's local position.
                boot, position, velocity = self._last_position
                moved = position + (telemetry.boot_s - boot) * velocity
                at = Origin(telemetry.latitude, telemetry.longitude, telemetry.altitude).to_geodetic(*(-moved))
                self.origin = Origin(*at)
            return
        if self.origin is None:
            self.origin = Origin(telemetry.latitude, telemetry.longitude, home)
        position = self.origin.to_ned(telemetry.latitude, telemetry.longitude, telemetry.altitude)
        self._last_position = (telemetry.boot_s, position, telemetry.velocity)

    def _sample(self, boot_s: float, rotation: Floats) -> MountSample:
        boot_ns = round(boot_s * NANOSECONDS)
        position = velocity = None
        if self._last_position is not None and abs(boot_s - self._last_position[0]) < _MAX_POSITION_AGE_S:
            velocity = self._last_position[2]
            position = np.asarray(self._last_position[1] + (boot_s - self._last_position[0]) * velocity)
        return MountSample(self.clock.host_time(boot_ns), boot_ns, self.clock.std_s, rotation, position, velocity)

    def _handle_clock_reset(self) -> None:
        """The vehicle's clock was reset: discard all that was stamped by the old one."""
        self.attitude = None
        self._last_position = None
        self._local_s = self._quaternion_s = -1e9
        self._next_ask_s = self._next_trip_s = -1e9
