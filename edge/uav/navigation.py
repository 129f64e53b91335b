"""Conversions of attitude and position: Euler angles, quaternions, latitude and longitude, local north-east-down."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocols.geometry import so3
from protocols.geometry.types import Floats

_EARTH_RADIUS_M = 6_378_137.0  # semi-major axis of the WGS 84 ellipsoid
_ECCENTRICITY2 = 6.694379990141317e-3  # squared, of the WGS 84 ellipsoid
_POSITION_GAP_S = 3.0  # greatest interval over which positions are interpolated
_POSITION_REACH_S = 0.5  # beyond the first and the last one
_ACCELERATION_STD_M_S2 = 10.0
"""Of a vehicle that manoeuvres. Beside positions at 1 Hz, of one that braked at 1, 2 and 4 g, the errors of a target's
place were up to 0.9, 1.6 and 2.4 of its stds."""


def position_std(since: Floats | float, until: Floats | float) -> Any:
    """Std [m], one coordinate, of a position interpolated between reports, or extrapolated at the speed of one.

    since, until: times [s] to the reports before and after it; to the one report both. To the two reports whose
    difference is that speed, where it is not reported.
    """
    return 0.5 * _ACCELERATION_STD_M_S2 * np.abs(since * until)


def interpolate_positions(positions: list[tuple[float, Floats]], times: Floats) -> tuple[Floats, Floats]:
    """Positions (n, 3) at ``times`` (n,) [s], interpolated between those of given times; NaN where none are close.

    And their stds (n,) by the time to these.
    """
    out, std = np.full((len(times), 3), np.nan), np.zeros(len(times))
    ordered = sorted(positions, key=lambda entry: entry[0])
    if len(ordered) < 2:
        return out, std
    known = np.array([moment for moment, _ in ordered])
    table = np.array([position for _, position in ordered])
    after = np.clip(np.searchsorted(known, times), 1, len(known) - 1)
    before = after - 1
    # Beyond the ends at the speed over half a second, not at that between two reports that may be hardly apart.
    reach, last = np.array([_POSITION_REACH_S, _POSITION_GAP_S]), len(known) - 1
    half, whole = np.searchsorted(known, known[-1] - reach, side="right") - [1, 0]
    before[times > known[-1]] = np.clip(half, whole, last - 1)
    half, whole = np.searchsorted(known, known[0] + reach) - [0, 1]
    after[times < known[0]] = np.clip(half, 1, whole)
    gap = known[after] - known[before]
    near = (gap > 0.0) & (gap <= _POSITION_GAP_S)
    near &= (times >= known[0] - _POSITION_REACH_S) & (times <= known[-1] + _POSITION_REACH_S)
    share = (times - known[before]) / np.maximum(gap, 1e-9)
    out[near] = (table[before] + share[:, None] * (table[after] - table[before]))[near]
    return out, np.where(near, position_std(times - known[before], known[after] - times), 0.0)


def rotation_from_euler(roll: float, pitch: float, yaw: float) -> Floats:
    """Rotation matrix (3, 3) Rz(yaw) Ry(pitch) Rx(roll); angles [rad]."""
    x, y, z = np.eye(3)
    return np.asarray(so3.exp(yaw * z) @ so3.exp(pitch * y) @ so3.exp(roll * x))


def rotation_from_quaternion(q: Any) -> Floats | None:
    """Rotation matrix (3, 3) of a quaternion w, x, y, z; None where its norm is not close to 1."""
    parts = np.array(q, np.float64)
    size = float(np.linalg.norm(parts))
    if not (np.isfinite(parts).all() and 0.9 < size < 1.1):
        return None
    return so3.from_quaternion(parts)


def curvature_radii(latitude: float) -> tuple[float, float]:
    """Metres per radian of latitude, and of longitude (still to be multiplied by cos latitude); WGS 84 ellipsoid."""
    w = 1.0 - _ECCENTRICITY2 * math.sin(math.radians(latitude)) ** 2
    return _EARTH_RADIUS_M * (1.0 - _ECCENTRICITY2) / w**1.5, _EARTH_RADIUS_M / math.sqrt(w)


@dataclass(frozen=True, slots=True)
class Origin:
    """Geodetic origin of a local NED frame [degrees, m above sea level]; flat-earth, valid within some kilometres."""

    latitude: float
    longitude: float
    altitude: float

    def to_ned(self, latitude: float, longitude: float, altitude: float) -> Floats:
        """Position (3,) north, east, down [m] of geodetic coordinates."""
        north, east = curvature_radii(self.latitude)
        across = (longitude - self.longitude + 180.0) % 360.0 - 180.0
        x = math.radians(latitude - self.latitude) * north
        y = math.radians(across) * east * math.cos(math.radians(self.latitude))
        return np.array([x, y, self.altitude - altitude])

    def to_geodetic(self, north: float, east: float, down: float) -> tuple[float, float, float]:
        """Latitude, longitude [degrees] and altitude [m] of a local position [m]."""
        a, b = curvature_radii(self.latitude)
        longitude = self.longitude + math.degrees(east / (b * math.cos(math.radians(self.latitude))))
        longitude = (longitude + 180.0) % 360.0 - 180.0
        return self.latitude + math.degrees(north / a), longitude, float(self.altitude - down)
