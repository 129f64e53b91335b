"""An autopilot's MAVLink telemetry in SI units and rotation matrices, and one local frame for its positions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edge.mavlink.dialect import mavlink
from edge.uav.navigation import Origin, position_std, rotation_from_euler, rotation_from_quaternion
from protocols.geometry import so3
from protocols.geometry.types import Floats

MAX_POSITION_AGE_S = 1.5
"""For how long a position is extrapolated at its velocity: one sent each second may be late."""
_SMOOTH_S = 0.5
"""For how long a vehicle flies on nearly straight: at 3 m/s² it is 0.4 m from there by then, after 1.5 s 3.4 m."""
_MAX_LOCAL_AGE_S = 2.0  # without a local position, after which the global one is used
_ON_GROUND_S = 3.0  # after arming, when home is set: a heartbeat may say so first, and no vehicle is high by then
_STEP_M, _STEP_DOWN_M = 3.0, 0.5  # from which the frame has moved: 0.15 s at 20 m/s, and at a climb of 3 m/s
_MANOEUVRE_M_S2 = 10.0  # times the interval squared: half of 2 g, by which a velocity that was kept is wrong
MESSAGE_TYPES = (
    "HEARTBEAT",
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
    "GIMBAL_MANAGER_STATUS",
    "SYSTEM_TIME",
    "TIMESYNC",
)
MAX_DISTANCE_M = 100_000.0  # from the local origin, and of a height: beyond it the flat local frame means nothing
_MAX_SPEED_M_S = 1_000.0  # beyond it a velocity is garbled


@dataclass(frozen=True, slots=True, eq=False)
class Attitude:
    """Attitude. boot_s: the vehicle's clock [s]. ned_from_body: (3, 3)."""

    boot_s: float
    ned_from_body: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LocalPosition:
    """Local position. position: (3,) north, east, down from the vehicle's origin [m]. velocity: (3,) NED [m/s]."""

    boot_s: float
    position: Floats
    velocity: Floats


@dataclass(frozen=True, slots=True, eq=False)
class GlobalPosition:
    """Global position. latitude, longitude [degrees], altitude above sea level and home [m], velocity: (3,) NED."""

    boot_s: float
    latitude: float
    longitude: float
    altitude: float
    relative_altitude: float
    velocity: Floats


@dataclass(frozen=True, slots=True, eq=False)
class GimbalAttitude:
    """Gimbal attitude. rotation: (3, 3) of its axes; earth: into NED, else into the vehicle's heading frame, level."""

    boot_s: float
    rotation: Floats
    earth: bool


@dataclass(frozen=True, slots=True)
class SystemTime:
    """The vehicle's system time. unix_s: 0 where it is not known."""

    boot_s: float
    unix_s: float


TelemetryReport = Attitude | LocalPosition | GlobalPosition | GimbalAttitude | SystemTime


def parse_telemetry(message: Any) -> TelemetryReport | None:
    """Parse a telemetry message; None for other types and for invalid values.

    Positions and speeds that no vehicle has are invalid: they would not fit into the messages made of them.
    """
    kind = message.get_type()
    boot = 1e-3 * float(getattr(message, "time_boot_ms", 0))
    if kind == "ATTITUDE":
        return Attitude(boot, rotation_from_euler(message.roll, message.pitch, message.yaw))
    if kind == "ATTITUDE_QUATERNION":
        rotation = rotation_from_quaternion([message.q1, message.q2, message.q3, message.q4])
        return None if rotation is None else Attitude(boot, rotation)
    if kind == "LOCAL_POSITION_NED":
        position = np.array([message.x, message.y, message.z], np.float64)
        velocity = np.array([message.vx, message.vy, message.vz], np.float64)
        if np.abs(position).max() > MAX_DISTANCE_M or np.abs(velocity).max() > _MAX_SPEED_M_S:
            return None
        return LocalPosition(boot, position, velocity)
    if kind == "GLOBAL_POSITION_INT":
        if (message.lat == 0 and message.lon == 0) or abs(message.lat) > 900_000_000:
            return None  # no fix yet
        if max(abs(message.alt), abs(message.relative_alt)) > 1e3 * MAX_DISTANCE_M:
            return None
        velocity = 0.01 * np.array([message.vx, message.vy, message.vz], np.float64)
        return GlobalPosition(
            boot, 1e-7 * message.lat, 1e-7 * message.lon, 1e-3 * message.alt, 1e-3 * message.relative_alt, velocity
        )
    if kind == "GIMBAL_DEVICE_ATTITUDE_STATUS":
        rotation = rotation_from_quaternion(message.q)
        if rotation is None:
            return None
        flags = int(message.flags)
        vehicle = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME)
        earth = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME)
        if not vehicle and not earth:  # senders older than these two flags: the yaw lock defines the frame
            earth = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)
        return GimbalAttitude(boot, rotation, earth)
    if kind == "SYSTEM_TIME":
        return SystemTime(boot, 1e-6 * message.time_unix_usec)
    return None


def ned_from_gimbal(gimbal: GimbalAttitude, ned_from_body: Floats | None) -> Floats | None:
    """Rotation (3, 3) of a gimbal into NED; None where the vehicle's heading is needed and not known."""
    if gimbal.earth:
        return gimbal.rotation
    if ned_from_body is None:
        return None
    heading = math.atan2(ned_from_body[1, 0], ned_from_body[0, 0])
    return np.asarray(so3.exp(np.array([0.0, 0.0, heading])) @ gimbal.rotation)


class LocalFrame:
    """Positions in one frame, from local and global reports in the order of their times [s].

    origin: geodetic, at home's height above sea level; None while unknown. position: time [s], position (3,) NED [m]
    from there and velocity (3,) [m/s] of the last report; None where there is none.

    LOCAL_POSITION_NED counts from where the autopilot's estimator was started. In height that need not be home (it was
    switched on elsewhere, or a station has set the origin at sea level), and it moves when the estimator is reset in
    flight. GLOBAL_POSITION_INT has neither fault, but comes less often: it corrects the local positions.
    """

    def __init__(self) -> None:
        self.origin: Origin | None = None
        self.position: tuple[float, Floats, Floats] | None = None
        self._shift = np.zeros(3)  # from reported local positions into this frame
        self._local_s: float | None = None
        self._baseline_s = 0.0  # over which the velocity is a difference of positions
        self._interval_s = MAX_POSITION_AGE_S  # between reports, as a moving mean
        self._armed_s: float | None = None

    def set_armed(self, armed: bool, time: float) -> None:
        """Add a heartbeat. Some seconds after arming home's height is kept, until then it is followed."""
        self._armed_s = (time if self._armed_s is None else self._armed_s) if armed else None

    def restart(self) -> None:
        """The autopilot or its clock was restarted: its local frame may be another one."""
        self.position = self._local_s = None
        self._shift = np.zeros(3)

    @property
    def reported_s(self) -> float:
        """Time of the last report; −inf where there is none."""
        return -math.inf if self.position is None else self.position[0]

    def at(self, time: float) -> tuple[Floats, Floats] | None:
        """Position and velocity (3,) at a time; None if not known of late."""
        if self.position is None or abs(time - self.position[0]) >= MAX_POSITION_AGE_S:
            return None
        last, position, velocity = self.position
        return np.asarray(position + (time - last) * velocity), velocity

    def measured_at(self, time: float) -> tuple[Floats | None, float]:
        """Position (3,) at a time and its std [m]; None where a report is missing, from which on `at` is a guess."""
        known = self.at(time)
        age = 0.0 if self.position is None else abs(time - self.position[0])
        if known is None or age >= max(2.0 * self._interval_s, _SMOOTH_S):
            return None, 0.0
        return known[0], float(position_std(age, age + self._baseline_s))

    def take_local(self, report: LocalPosition, time: float) -> None:
        """Add a local position. A jump that its velocity does not explain is one of its frame, until a global one."""
        expected = self.at(time)
        if self._local_s is None:
            self.origin = None  # so far it was the vehicle's first global position, not the local frame's origin
        if expected is not None and self.position is not None:
            slack = _MANOEUVRE_M_S2 * (time - self.position[0]) ** 2
            self._correct(expected[0] - report.position - self._shift, slack, across=self._local_s is not None)
        if np.abs(report.position + self._shift).max() > MAX_DISTANCE_M:
            self._shift = np.zeros(3)
        self._local_s = time
        self._report(time, report.position + self._shift, report.velocity)

    def take_global(self, report: GlobalPosition, time: float) -> None:
        """Add a global position."""
        local = None if self._local_s is None or time - self._local_s >= _MAX_LOCAL_AGE_S else self.at(time)
        place, home = (report.latitude, report.longitude), report.altitude - report.relative_altitude
        position = None if self.origin is None else self.origin.to_ned(*place, report.altitude)
        if self.origin is None or position is None or np.abs(position).max() > MAX_DISTANCE_M:
            if local is not None:  # the origin is where this global position has the vehicle's local position
                place = Origin(*place, home).to_geodetic(-local[0][0], -local[0][1], 0.0)[:2]
            self.origin = Origin(*place, home)
        elif self._armed_s is None or time - self._armed_s < _ON_GROUND_S:
            self.origin = replace(self.origin, altitude=home)
        position = self.origin.to_ned(report.latitude, report.longitude, report.altitude)
        if local is None:
            last, velocity, baseline_s = self.position, report.velocity, 0.0
            if last is not None and not velocity.any() and 0.0 < time - last[0] < 2 * MAX_POSITION_AGE_S:
                baseline_s = time - last[0]
                velocity = (position - last[1]) / baseline_s  # Betaflight sends 0 in place of it
            self._report(time, position, velocity, baseline_s)
        else:
            self._correct(position - local[0], 0.0)

    def _report(self, time: float, position: Floats, velocity: Floats, baseline_s: float = 0.0) -> None:
        if self.position is not None:
            self._interval_s += 0.3 * (min(time - self.position[0], MAX_POSITION_AGE_S) - self._interval_s)
        self.position, self._baseline_s = (time, position, velocity), baseline_s

    def _correct(self, lacking: Floats, slack_m: float, *, across: bool = True) -> None:
        """Move the frame by what its positions lack (3,) [m], if that is a step of the frame. across: also sideways."""
        across = across and bool(np.hypot(*lacking[:2]) > _STEP_M + slack_m)
        step = lacking * (across, across, abs(lacking[2]) > _STEP_DOWN_M + slack_m)
        self._shift = self._shift + step
        if self.position is not None:
            self.position = self.position[0], self.position[1] + step, self.position[2]
