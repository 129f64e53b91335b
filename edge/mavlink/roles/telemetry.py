"""What an autopilot tells of its attitude, place, gimbal and clock, out of MAVLink's units and conventions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.mavlink.dialect import mavlink
from edge.uav.navigation import from_angles, from_quaternion
from protocols.geometry import so3
from protocols.geometry.types import Floats

KINDS = (
    "HEARTBEAT",
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
    "SYSTEM_TIME",
    "TIMESYNC",
)


@dataclass(frozen=True, slots=True, eq=False)
class Attitude:
    """boot_s: the vehicle's clock [s]. ned_from_body: (3, 3)."""

    boot_s: float
    ned_from_body: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LocalPosition:
    """position: (3,) north, east, down of the vehicle's origin [m]. velocity: (3,) NED [m/s]."""

    boot_s: float
    position: Floats
    velocity: Floats


@dataclass(frozen=True, slots=True, eq=False)
class GlobalPosition:
    """latitude, longitude [degrees], altitude above the sea and above home [m], velocity: (3,) NED [m/s]."""

    boot_s: float
    latitude: float
    longitude: float
    altitude: float
    relative_altitude: float
    velocity: Floats


@dataclass(frozen=True, slots=True, eq=False)
class GimbalAttitude:
    """rotation: (3, 3) of the gimbal's axes. earth: into NED; else into the vehicle's heading, level."""

    boot_s: float
    rotation: Floats
    earth: bool


@dataclass(frozen=True, slots=True)
class SystemTime:
    """unix_s: 0 where the vehicle does not know it."""

    boot_s: float
    unix_s: float


Report = Attitude | LocalPosition | GlobalPosition | GimbalAttitude | SystemTime


def report(message: Any) -> Report | None:
    """What a message tells; None for other kinds, and for one that makes no sense."""
    kind = message.get_type()
    boot = 1e-3 * float(getattr(message, "time_boot_ms", 0))
    if kind == "ATTITUDE":
        return Attitude(boot, from_angles(message.roll, message.pitch, message.yaw))
    if kind == "ATTITUDE_QUATERNION":
        turned = from_quaternion([message.q1, message.q2, message.q3, message.q4])
        return None if turned is None else Attitude(boot, turned)
    if kind == "LOCAL_POSITION_NED":
        place = np.array([message.x, message.y, message.z], np.float64)
        return LocalPosition(boot, place, np.array([message.vx, message.vy, message.vz], np.float64))
    if kind == "GLOBAL_POSITION_INT":
        if (message.lat == 0 and message.lon == 0) or abs(message.lat) > 900_000_000:
            return None  # no fix yet
        velocity = 0.01 * np.array([message.vx, message.vy, message.vz], np.float64)
        return GlobalPosition(
            boot, 1e-7 * message.lat, 1e-7 * message.lon, 1e-3 * message.alt, 1e-3 * message.relative_alt, velocity
        )
    if kind == "GIMBAL_DEVICE_ATTITUDE_STATUS":
        turned = from_quaternion(message.q)
        if turned is None:
            return None
        flags = int(message.flags)
        vehicle = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME)
        earth = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME)
        if not vehicle and not earth:  # of before these two flags: what the yaw is locked to
            earth = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)
        return GimbalAttitude(boot, turned, earth)
    if kind == "SYSTEM_TIME":
        return SystemTime(boot, 1e-6 * message.time_unix_usec)
    return None


def ned_from_gimbal(gimbal: GimbalAttitude, ned_from_body: Floats | None) -> Floats | None:
    """(3, 3) of a gimbal's axes; None where the vehicle's heading is needed and not known."""
    if gimbal.earth:
        return gimbal.rotation
    if ned_from_body is None:
        return None
    heading = math.atan2(ned_from_body[1, 0], ned_from_body[0, 0])
    return np.asarray(so3.exp(np.array([0.0, 0.0, heading])) @ gimbal.rotation)
