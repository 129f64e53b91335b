"""The vehicle's telemetry: requests message rates and time sync, converts messages to samples on the host's clock.

Attitude, position and time are the autopilot component's alone; the gimbal's attitude may also come from the gimbal
device, whose clock is its own. What another component says of the vehicle is refused, counted and reported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from edge.mavlink.dialect import AUTOPILOT, GIMBAL, mavlink
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.roles.telemetry import (
    Attitude,
    GimbalAttitude,
    GlobalPosition,
    LocalFrame,
    LocalPosition,
    ned_from_gimbal,
    parse_telemetry,
)
from edge.uav.navigation import Origin
from edge.uav.timing.vehicle_clock import MAX_DELAY_NS, VehicleClock
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats

_TIMESYNC_PERIOD_S = 0.5  # between TIMESYNC requests
_RATE_REQUEST_PERIOD_S = 5.0  # of rates, which an autopilot forgets when it reboots
_QUATERNION_S = 0.1  # after a quaternion, in which the same attitude in angles is not used
_MAX_HEADING_AGE_S = 0.5  # an older heading is not used
_SOURCE_SILENT_S = 2.0  # after which another gimbal source may take over
_REFUSAL_SHOWN_S = 10.0  # in the status
_MAX_SPACING_S = 0.3  # of attitudes: at 4 Hz a target was placed on the ground from the start, at 2 Hz never
_MISSING_AFTER_S = 3.0  # since a message was asked for
_GIMBALS = frozenset({AUTOPILOT, GIMBAL, *range(mavlink.MAV_COMP_ID_GIMBAL2, mavlink.MAV_COMP_ID_GIMBAL6 + 1)})
_NEVER = -math.inf


@dataclass(frozen=True, slots=True, eq=False)
class MountSample:
    """A telemetry sample. host_ns, vehicle_ns: time of measurement on the host's and the autopilot's clock.

    std_s: of host_ns. ned_from_mount: (3, 3) of the camera's mount (airframe or gimbal). position: (3,) NED [m] from
    the vehicle's ``origin``, None where no report was due so near that it is known. position_std: of it [m].
    """

    host_ns: int
    vehicle_ns: int
    std_s: float
    ned_from_mount: Floats
    position: Floats | None
    position_std: float = 0.0


class Vehicle:
    """One vehicle on one link. gimbal: the camera hangs on it. rate_hz: requested rate of attitude and position.

    clock: the autopilot's. counters: refused telemetry by reason. mount: the newest sample.
    """

    def __init__(self, link: Link, *, gimbal: bool, rate_hz: float = 30.0) -> None:
        self._link, self._gimbal, self._rate_hz = link, gimbal, rate_hz
        self.clock = VehicleClock()
        self._gimbal_clock = VehicleClock()
        self._gimbal_source: tuple[int, int] | None = None
        self._gimbal_s = _NEVER
        self.frame = LocalFrame()
        self.mount: MountSample | None = None
        self.armed = False
        self.counters: Counter[str] = Counter()
        self._refusal = (_NEVER, "")
        self._attitude: tuple[float, Attitude] | None = None
        self._quaternion_s = self._sample_s = _NEVER
        self._spacing_s = 1.0 / rate_hz  # of samples, as a moving mean
        self._next_trip_s = self._next_ask_s = _NEVER
        self._first_s: float | None = None
        self._resets = (0, 0)

    @property
    def origin(self) -> Origin | None:
        """Where positions count from; None while that is unknown."""
        return self.frame.origin

    @property
    def ignores_unsigned(self) -> bool:
        """Whether it signs what cannot be verified without a key, and answers nothing; it takes a moment to answer."""
        return self._link.counters["signed"] > 0 and not self.clock.answered

    def motion_at(self, time_s: float) -> tuple[Floats, Floats] | None:
        """Position from ``origin`` and velocity (3,) NED [m, m/s] at a host time; None if not known of late."""
        return self.frame.at(time_s)

    @property
    def clock_resets(self) -> tuple[int, int]:
        """How often a clock of the telemetry was restarted, and how often it stepped."""
        clocks = (self.clock, self._gimbal_clock)
        return sum(clock.reboots for clock in clocks), sum(clock.steps for clock in clocks)

    def problem(self, now_ns: int) -> str:
        """What is missing or was refused lately, as one line; "" if nothing."""
        now = now_ns / NANOSECONDS
        since, text = self._refusal
        refused = f"{text} ({self.counters.total()} refused)" if now - since < _REFUSAL_SHOWN_S else ""
        if self._first_s is not None and now - max(self._sample_s, self._first_s) > _MISSING_AFTER_S:
            source = "gimbal (GIMBAL_DEVICE_ATTITUDE_STATUS)" if self._gimbal else "autopilot (ATTITUDE_QUATERNION)"
            return f"no attitude of the {source}" + (f": {refused}" if refused else "")
        if self._first_s is not None and now - self._first_s > _MISSING_AFTER_S and self.ignores_unsigned:
            return "the vehicle signs its messages and ignores unsigned ones: set key in [mavlink]"
        slow = f"attitudes come at {1.0 / self._spacing_s:.1f} Hz, too seldom for positions: ask for 4 Hz or more"
        return refused or (slow if self._spacing_s > _MAX_SPACING_S else "")

    def without_position(self, now_ns: int) -> str:
        """That no position comes, or none on Earth, as one line; "" where it does."""
        now, asked_s = now_ns / NANOSECONDS, math.inf if self._first_s is None else self._first_s
        since = self.frame.reported_s if self._first_s is None else max(self.frame.reported_s, asked_s)
        if _MISSING_AFTER_S < now - since < math.inf:
            return "no position of the autopilot (GLOBAL_POSITION_INT with a fix): targets have no place on the ground"
        if self.origin is None and now - asked_s > _MISSING_AFTER_S:
            return (
                "no GLOBAL_POSITION_INT with a fix: targets have no latitude and longitude, only metres from an origin"
            )
        return ""

    def tick(self, now_ns: int) -> None:
        """Send the TIMESYNC and rate requests that are due."""
        now = now_ns / NANOSECONDS
        if self._link.vehicle is None or not self._link.open:
            return
        if self._first_s is None:
            self._first_s = now
        if now >= self._next_trip_s:
            self._next_trip_s = now + _TIMESYNC_PERIOD_S
            self._link.send(mavlink.MAVLink_timesync_message(0, now_ns))
        if now >= self._next_ask_s:
            self._next_ask_s = now + _RATE_REQUEST_PERIOD_S
            for kind, rate, component in self._message_rates():
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, component, number, round(1e6 / rate))

    def handle(self, received: ReceivedMessage) -> list[MountSample]:
        """Handle a message of the vehicle; returns the samples that it completes."""
        message, kind, component = received.message, received.kind, received.component
        from_gimbal = kind == "GIMBAL_DEVICE_ATTITUDE_STATUS"
        if component != AUTOPILOT and not (from_gimbal and component in _GIMBALS):
            if kind != "HEARTBEAT" and hasattr(message, "time_boot_ms"):
                self._refuse("component", f"{kind} of component {component} refused: not the autopilot", received)
            return []
        if from_gimbal and not self._gimbal:
            return []  # a camera on the airframe: whatever a gimbal's clock does is of no interest
        if kind == "TIMESYNC":
            if message.tc1 > 0:
                self._take_clock(self.clock.handle_round_trip(message.ts1, message.tc1, received.received_ns))
            elif message.tc1 == 0:
                self._link.send(mavlink.MAVLink_timesync_message(received.received_ns, message.ts1))
            return []
        if kind == "HEARTBEAT":
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.frame.set_armed(self.armed, received.received_ns / NANOSECONDS)
            return []
        telemetry = parse_telemetry(message)
        if telemetry is None:
            return []
        if from_gimbal and not self._from_current_gimbal(received):
            return []
        clock = self.clock if component == AUTOPILOT else self._gimbal_clock
        boot_ns = round(telemetry.boot_s * NANOSECONDS)
        if boot_ns == 0 and not clock.stamped:  # this source has no clock: its messages are as old as the link's delay
            return self._take(telemetry, received.received_ns, clock, quaternion=kind == "ATTITUDE_QUATERNION")
        if not self._take_clock(clock.handle_message(boot_ns, received.received_ns)):
            self._refuse("time", f"{kind} of component {component} refused: {clock.reason}", received)
            return []
        host_ns = clock.host_time(boot_ns)
        if not -MAX_DELAY_NS <= host_ns - received.received_ns <= MAX_DELAY_NS:
            self._refuse("time", f"{kind} of component {component} refused: {clock.reason}", received)
            return []
        # Nothing is measured after it has arrived: that would be an error of the clock's estimate.
        host_ns = min(host_ns, received.received_ns)
        return self._take(telemetry, host_ns, clock, quaternion=kind == "ATTITUDE_QUATERNION")

    def _message_rates(self) -> Iterable[tuple[str, float, int]]:
        yield "ATTITUDE_QUATERNION", self._rate_hz, AUTOPILOT
        yield "LOCAL_POSITION_NED", min(self._rate_hz, 20.0), AUTOPILOT
        yield "GLOBAL_POSITION_INT", 5.0, AUTOPILOT
        yield "SYSTEM_TIME", 1.0, AUTOPILOT
        if self._gimbal:
            components = (GIMBAL, AUTOPILOT) if self._gimbal_source is None else (self._gimbal_source[0],)
            for component in components:
                yield "GIMBAL_DEVICE_ATTITUDE_STATUS", self._rate_hz, component
            yield "GIMBAL_MANAGER_STATUS", 2.0, AUTOPILOT

    def _command(self, command: int, component: int, *parameters: float) -> None:
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self._link.send(mavlink.MAVLink_command_long_message(self._link.vehicle, component, command, 0, *filled))

    def _refuse(self, counter: str, text: str, received: ReceivedMessage) -> None:
        self.counters[counter] += 1
        self._refusal = (received.received_ns / NANOSECONDS, text)

    def _from_current_gimbal(self, received: ReceivedMessage) -> bool:
        """Whether a gimbal's message comes from the gimbal that was first and has not fallen silent."""
        source = (received.component, int(getattr(received.message, "gimbal_device_id", 0)))
        now = received.received_ns / NANOSECONDS
        if source != self._gimbal_source:
            if now - self._gimbal_s < _SOURCE_SILENT_S:
                self._refuse("gimbal", f"gimbal {source} refused: {self._gimbal_source} is followed", received)
                return False
            if self._gimbal_source is not None and source[0] != self._gimbal_source[0]:
                self._gimbal_clock = VehicleClock()
            self._gimbal_source = source
        self._gimbal_s = now
        return True

    def _take_clock(self, accepted: bool) -> bool:
        """Discard what was stamped by an old clock if one was reset."""
        resets = self.clock_resets
        if resets != self._resets:
            self._resets = resets
            self._attitude = None
            self.frame.restart()
            self._quaternion_s = self._sample_s = _NEVER
            self._next_ask_s = self._next_trip_s = _NEVER
        return accepted

    def _take(self, telemetry: object, host_ns: int, clock: VehicleClock, *, quaternion: bool) -> list[MountSample]:
        """Handle telemetry measured at ``host_ns``."""
        time = host_ns / NANOSECONDS
        if isinstance(telemetry, Attitude):
            return self._take_attitude(telemetry, host_ns, quaternion)
        if isinstance(telemetry, GimbalAttitude):
            body = self._attitude
            fresh = body is not None and abs(time - body[0]) < _MAX_HEADING_AGE_S
            rotation = ned_from_gimbal(telemetry, body[1].ned_from_body if fresh and body is not None else None)
            return [] if rotation is None else self._sample(host_ns, clock, rotation)
        if isinstance(telemetry, LocalPosition):
            self.frame.take_local(telemetry, time)
        elif isinstance(telemetry, GlobalPosition):
            self.frame.take_global(telemetry, time)
        return []

    def _take_attitude(self, telemetry: Attitude, host_ns: int, quaternion: bool) -> list[MountSample]:
        time = host_ns / NANOSECONDS
        if quaternion:
            self._quaternion_s = time
        elif time - self._quaternion_s < _QUATERNION_S:
            return []
        if self._attitude is not None and 0.0 < telemetry.boot_s <= self._attitude[1].boot_s:
            return []
        self._attitude = (time, telemetry)
        return [] if self._gimbal else self._sample(host_ns, self.clock, telemetry.ned_from_body)

    def _sample(self, host_ns: int, clock: VehicleClock, rotation: Floats) -> list[MountSample]:
        """The sample of an attitude; none if it is not later than the one before."""
        time = host_ns / NANOSECONDS
        if time <= self._sample_s:
            self.counters["order"] += 1
            return []
        if self._sample_s != _NEVER:
            self._spacing_s += 0.2 * (min(time - self._sample_s, _MISSING_AFTER_S) - self._spacing_s)
        self._sample_s = time
        vehicle_ns = host_ns + (self.clock.offset_ns if self.clock.known else clock.offset_ns)
        self.mount = MountSample(host_ns, vehicle_ns, clock.std_s, rotation, *self.frame.measured_at(time))
        return [self.mount]
