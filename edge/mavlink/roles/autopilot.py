"""A simulated autopilot's MAVLink interface: message streams, commands, parameters, routing, and link faults.

The vehicle itself is behind ``Airframe``. Messages are routed between the connected systems as ArduPilot does, so that
a ground station reaches the companion computer through the autopilot.
"""

from __future__ import annotations

import math
import random
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, GIMBAL, mavlink, message_name
from edge.mavlink.link.framing import Framer
from edge.mavlink.link.signing import Signing
from edge.mavlink.link.transport import Address, Transport
from edge.uav.navigation import Origin
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.types import Floats

_DEFAULT_RATES = {
    "HEARTBEAT": 1.0,
    "SYSTEM_TIME": 1.0,
    "ATTITUDE": 4.0,
    "ATTITUDE_QUATERNION": 0.0,
    "GLOBAL_POSITION_INT": 4.0,
    "LOCAL_POSITION_NED": 4.0,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": 10.0,
    "GIMBAL_MANAGER_STATUS": 1.0,
}
_MAX_RATE_HZ = 100.0  # real ones limit their streams too
_UNIX_AT_START = 1_700_000_000.0  # s: any time after GPS has set the clock
_MAX_SENDERS = 8  # that it answers on one port
DEFAULT_ORIGIN = Origin(47.3977, 8.5456, 488.0)
"""Default origin of the simulated aircraft's local NED frame."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorReadings:
    """ned_from_body (3, 3), position, velocity (3,) NED [m, m/s], body rates (3,) [rad/s]; ned_from_gimbal or None."""

    ned_from_body: Floats
    position: Floats
    velocity: Floats
    rates: Floats
    ned_from_gimbal: Floats | None = None


class Airframe(Protocol):
    """The vehicle under an autopilot's control. Times are simulation time [s]."""

    def sensor_readings(self, time: float) -> SensorReadings:
        """The sensor readings at ``time``."""

    def point_gimbal(self, time: float, pitch: float, yaw: float, earth: bool) -> None:
        """Command the gimbal angles [rad]; earth: yaw relative to north, else to the vehicle's heading."""

    def follow_target(self, time: float, position: Floats, velocity: Floats) -> None:
        """Follow a target at a position (3,) NED [m] with a velocity (3,) [m/s]."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Simulated faults of the autopilot and its outgoing link.

    drop, duplicate, garble: fraction of messages. delay_s, jitter_s: of their delivery. reboot_at: times [s] of
    autopilot reboots. steps: (time, size) [s] of steps of its clock.
    """

    drop: float = 0.0
    duplicate: float = 0.0
    garble: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    reboot_at: tuple[float, ...] = ()
    steps: tuple[tuple[float, float], ...] = ()


class Autopilot:
    """An autopilot on one transport. boot_s: its clock at simulation time 0 [s].

    origin: of the local NED frame. seed: of the faults. signing: signs all messages and accepts only signed ones.
    firmware: MAV_AUTOPILOT of its heartbeat. forwards: whether a link forwards, as MAV_n_FORWARD of PX4 sets it.
    gimbal_ahead_s: how far the gimbal's clock is ahead of the autopilot's [s].
    """

    def __init__(
        self,
        airframe: Airframe,
        transport: Transport,
        *,
        system: int = 1,
        boot_s: float = 123.4,
        origin: Origin | None = None,
        faults: LinkFaults | None = None,
        signing: Signing | None = None,
        firmware: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        forwards: Callable[[Address], bool] = lambda address: True,
        gimbal_ahead_s: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._airframe, self._transport = airframe, transport
        self.system = system
        self.origin = origin or DEFAULT_ORIGIN
        self.faults = faults or LinkFaults()
        self._firmware, self._forwards, self._gimbal_ahead_s = firmware, forwards, gimbal_ahead_s
        self._random = random.Random(seed)
        self._boot_s = boot_s
        self._now = 0.0
        self._codecs: dict[int, Any] = {part: mavlink.MAVLink(None, system, part) for part in (AUTOPILOT, GIMBAL)}
        self._signing = signing
        if signing is not None:
            for codec in self._codecs.values():
                codec.signing.secret_key, codec.signing.sign_outgoing = signing.key, True
        self._reboots = sorted(self.faults.reboot_at)
        self._steps = sorted(self.faults.steps)
        self._down_until = -math.inf
        self._senders: dict[Address, _Sender] = {}
        self._delayed: deque[tuple[float, bytes, Address]] = deque()
        self._reset()
        self.parameters = {"SYSID_THISMAV": float(system), "SR0_EXTRA1": 4.0, "FOLL_ENABLE": 1.0, "MNT1_TYPE": 1.0}
        self.counters: Counter[str] = Counter()

    def boot_ns(self, time: float) -> int:
        """The autopilot's clock [ns] at a simulation time [s]."""
        return round((time + self._boot_s) * NANOSECONDS)

    def step(self, time: float) -> None:
        """Receive, respond and send what is due at simulation time ``time`` [s]; call at 100 Hz or more."""
        self._now = time
        self._apply_faults(time)
        pieces = self._transport.receive()
        if time < self._down_until:
            return
        for data, address in pieces:
            self._receive(data, address)
        for kind, rate in self._rates.items():
            if rate > 0.0 and time >= self._due.get(kind, -math.inf):
                late = time - self._due.get(kind, time)
                self._due[kind] = time + 1.0 / rate - (late if late < 1.0 / rate else 0.0)
                for message, part in self._message(kind, time):
                    self._send(message, part)
        while self._delayed and self._delayed[0][0] <= time:
            _, data, address = self._delayed.popleft()
            self._transport.send(data, address)

    def _reset(self) -> None:
        self._rates = dict(_DEFAULT_RATES)
        self._due: dict[str, float] = {}
        self._gimbal_holder = (0, 0)  # system and component id of who may turn it

    def _apply_faults(self, time: float) -> None:
        if self._reboots and time >= self._reboots[0]:
            self._reboots.pop(0)
            self._reset()
            self._boot_s = -time
            self._down_until = time + 1.5
            self.counters["reboots"] += 1
        if self._steps and time >= self._steps[0][0]:
            self._boot_s += self._steps.pop(0)[1]

    def _receive(self, data: bytes, address: Address) -> None:
        sender = self._senders.get(address)
        if sender is None:
            if len(self._senders) >= _MAX_SENDERS:
                self._senders.pop(next(iter(self._senders)))
            sender = self._senders[address] = _Sender()
        for message, frame in sender.framer.feed(data):
            if self._signing is not None:
                reason = self._signing.rejection_reason(
                    frame, message.get_srcSystem(), message.get_srcComponent(), _UNIX_AT_START + self._now
                )
                if reason:
                    self.counters[f"refused.{reason}"] += 1
                    continue
            sender.systems.add((message.get_srcSystem(), message.get_srcComponent()))
            self._route(message, frame, address)
            self._handle(message)

    def _route(self, message: Any, frame: bytes, source: Address) -> None:
        """Forward a message that addresses other systems, between links that forward, to links where they were seen."""
        if not self._forwards(source):
            return
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        if system == self.system and component == AUTOPILOT:
            return
        for address, sender in self._senders.items():
            known = system == 0 or any(s == system and component in (0, c) for s, c in sender.systems)
            if address != source and known and self._forwards(address):
                self._transmit(frame, address)

    def _handle(self, message: Any) -> None:
        kind = message.get_type()
        if getattr(message, "target_system", self.system) not in (0, self.system):
            return
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self.boot_ns(self._now), message.ts1), AUTOPILOT)
        elif kind in ("COMMAND_LONG", "COMMAND_INT") and message.target_component in (0, AUTOPILOT, GIMBAL):
            self._command(message)
        elif kind == "GIMBAL_MANAGER_SET_PITCHYAW":
            earth = bool(int(message.flags) & mavlink.GIMBAL_MANAGER_FLAGS_YAW_LOCK)
            if (message.get_srcSystem(), message.get_srcComponent()) != self._gimbal_holder:
                self.counters["pointed.refused"] += 1
            elif math.isfinite(message.pitch) and math.isfinite(message.yaw):
                self.counters["pointed"] += 1
                self._airframe.point_gimbal(self._now, message.pitch, message.yaw, earth)
        elif kind == "FOLLOW_TARGET" and message.get_srcSystem() != self.system:  # as ArduPilot: not its own
            self.counters["follow_targets"] += 1
            place = self.origin.to_ned(1e-7 * message.lat, 1e-7 * message.lon, message.alt)
            self._airframe.follow_target(self._now, place, np.array(message.vel, np.float64))
        elif kind == "PARAM_REQUEST_LIST":
            for name in self.parameters:
                self._send_parameter(name)
        elif kind in ("PARAM_REQUEST_READ", "PARAM_SET"):
            name = message.param_id
            if name in self.parameters:
                if kind == "PARAM_SET" and math.isfinite(message.param_value):
                    self.parameters[name] = float(message.param_value)
                self._send_parameter(name)

    def _command(self, message: Any) -> None:
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            kind = message_name(message.param1)
            interval = float(message.param2)
            result = mavlink.MAV_RESULT_DENIED
            if kind in self._rates and math.isfinite(interval):
                default = _DEFAULT_RATES[kind]
                self._rates[kind] = 0.0 if interval < 0 else min(1e6 / interval, _MAX_RATE_HZ) if interval else default
                self._due.pop(kind, None)
                result = mavlink.MAV_RESULT_ACCEPTED
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            kind = message_name(message.param1)
            if kind in _DEFAULT_RATES:
                result = mavlink.MAV_RESULT_ACCEPTED
                for answer, part in self._message(kind, self._now):
                    self._send(answer, part)
        elif message.command == mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE:
            result = mavlink.MAV_RESULT_ACCEPTED
            if message.param1 >= 0:
                self._gimbal_holder = int(message.param1), int(message.param2)
        answer = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        self._send(answer, AUTOPILOT)

    def _send_parameter(self, name: str) -> None:
        index = list(self.parameters).index(name)
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        value = self.parameters[name]
        self._send(
            mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self.parameters), index), AUTOPILOT
        )

    def _message(self, kind: str, time: float) -> Iterator[tuple[Any, int]]:
        """The current message of a type, and the component that sends it."""
        boot_ms = (self.boot_ns(time) // 1_000_000) & 0xFFFFFFFF
        if kind == "HEARTBEAT":
            yield (
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_QUADROTOR,
                    self._firmware,
                    mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                    4,
                    mavlink.MAV_STATE_ACTIVE,
                    3,
                ),
                AUTOPILOT,
            )
            return
        if kind == "SYSTEM_TIME":
            yield mavlink.MAVLink_system_time_message(round(1e6 * (_UNIX_AT_START + time)), boot_ms), AUTOPILOT
            return
        now = self._airframe.sensor_readings(time)
        r, v = now.ned_from_body, now.velocity
        if kind == "ATTITUDE":
            roll, pitch = math.atan2(r[2, 1], r[2, 2]), -math.asin(float(np.clip(r[2, 0], -1.0, 1.0)))
            yield (
                mavlink.MAVLink_attitude_message(boot_ms, roll, pitch, math.atan2(r[1, 0], r[0, 0]), *now.rates),
                AUTOPILOT,
            )
        elif kind == "ATTITUDE_QUATERNION":
            yield (
                mavlink.MAVLink_attitude_quaternion_message(boot_ms, *so3.quaternion(r).tolist(), *now.rates),
                AUTOPILOT,
            )
        elif kind == "LOCAL_POSITION_NED":
            yield mavlink.MAVLink_local_position_ned_message(boot_ms, *now.position, *v), AUTOPILOT
        elif kind == "GLOBAL_POSITION_INT":
            latitude, longitude, altitude = self.origin.to_geodetic(*now.position)
            heading = round(math.degrees(math.atan2(r[1, 0], r[0, 0])) % 360.0 * 100) % 36000
            yield (
                mavlink.MAVLink_global_position_int_message(
                    boot_ms,
                    round(1e7 * latitude),
                    round(1e7 * longitude),
                    round(1e3 * altitude),
                    round(-1e3 * now.position[2]),
                    *(round(100.0 * float(part)) for part in v),
                    heading,
                ),
                AUTOPILOT,
            )
        elif kind == "GIMBAL_DEVICE_ATTITUDE_STATUS" and now.ned_from_gimbal is not None:
            flags = mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
            own_ms = (boot_ms + round(1e3 * self._gimbal_ahead_s)) & 0xFFFFFFFF
            q = so3.quaternion(now.ned_from_gimbal).tolist()
            yield (
                mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, own_ms, flags, q, 0.0, 0.0, 0.0, 0),
                GIMBAL,
            )
        elif kind == "GIMBAL_MANAGER_STATUS" and now.ned_from_gimbal is not None:
            yield (
                mavlink.MAVLink_gimbal_manager_status_message(boot_ms, 0, GIMBAL, *self._gimbal_holder, 0, 0),
                AUTOPILOT,
            )

    def _send(self, message: Any, part: int) -> None:
        codec = self._codecs[part]
        if self._signing is not None:
            codec.signing.timestamp = self._signing.next_time(_UNIX_AT_START + self._now)
        frame = bytes(message.pack(codec))
        codec.seq = (codec.seq + 1) % 256
        for address in list(self._senders):
            self._transmit(frame, address)

    def _transmit(self, frame: bytes, address: Address) -> None:
        """Transmit a frame, subject to the simulated faults."""
        faults = self.faults
        if self._random.random() < faults.drop:
            return
        copies = 2 if self._random.random() < faults.duplicate else 1
        for _ in range(copies):
            data = frame
            if self._random.random() < faults.garble:
                broken = bytearray(frame)
                broken[self._random.randrange(len(broken))] ^= 1 + self._random.randrange(255)
                data = bytes(broken)
            if faults.delay_s or faults.jitter_s:
                due = self._now + faults.delay_s + self._random.random() * faults.jitter_s
                self._delayed.append((due, data, address))
            else:
                self._transport.send(data, address)


@dataclass(slots=True)
class _Sender:
    framer: Framer = field(default_factory=Framer)
    systems: set[tuple[int, int]] = field(default_factory=set)
