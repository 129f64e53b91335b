"""An autopilot's MAVLink telemetry (attitude, position, gimbal, clock) in SI units and rotation matrices."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.mavlink.dialect import mavlink
from edge.uav.navigation import rotation_from_euler, rotation_from_quaternion
from protocols.geometry import so3
from protocols.geometry.types import Floats

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
