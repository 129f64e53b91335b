"""Where the drone's camera is and how it is turned, at any moment.

Frames: ned = north, east, down [m]; body = forward, right, down; camera = x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.world.noise import wander
from protocols.geometry import so3
from protocols.geometry.types import Floats

LEAD_S = 2.0  # the flight is known from this long before the first frame on
GRID_HZ = 120.0
BODY_FROM_DOWN_CAMERA: Floats = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Camera looking straight down, the top of the picture forward."""


@dataclass(frozen=True, slots=True)
class Shake:
    """How restless the drone is: std of each smooth wander, with its time constant [s]."""

    tilt_deg: float = 1.1
    tilt_s: float = 0.55
    yaw_deg: float = 2.5
    yaw_s: float = 1.5
    buzz_deg: float = 0.03  # vibration
    position_m: float = 0.8
    position_s: float = 1.0
    altitude_m: float = 0.7
    altitude_s: float = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Position (n, 3) NED [m] and roll, pitch, yaw (n, 3) [rad] at the grid's ``times`` (n,) [s]."""

    times: Floats
    position: Floats
    angles: Floats

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """ned_from_body (k, 3, 3) and position (k, 3) at moments (k,) [s]."""
        roll, pitch, yaw = (np.interp(times, self.times, self.angles[:, axis]) for axis in range(3))
        position = np.column_stack([np.interp(times, self.times, self.position[:, axis]) for axis in range(3)])
        return rotation(roll, pitch, yaw), position


def rotation(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """ned_from_body (k, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll)."""
    axes = np.eye(3)
    turned = so3.exp(yaw[:, None] * axes[2]) @ so3.exp(pitch[:, None] * axes[1]) @ so3.exp(roll[:, None] * axes[0])
    return np.asarray(turned)


def grid_times(seconds: float) -> Floats:
    """The moments (n,) [s] at which a flight of this length is computed."""
    return np.arange(-LEAD_S, seconds + 0.5, 1.0 / GRID_HZ)


@dataclass(frozen=True, slots=True, eq=False)
class Unrest:
    """One draw of the drone's shaking on the grid. angles: (n, 3) [rad]; shift: (n, 3) NED [m]."""

    angles: Floats
    shift: Floats


def unrest(rng: np.random.Generator, times: Floats, shake: Shake, mean_tilt_deg: float = 2.5) -> Unrest:
    """Draw how the drone shakes: constant tilt, smooth tilt and yaw, vibration, drift of position."""
    step, n = 1.0 / GRID_HZ, len(times)
    tilt = np.deg2rad(rng.normal(0.0, mean_tilt_deg, 2))
    angles = np.column_stack(
        [
            *(tilt[axis] + wander(rng, n, step, np.deg2rad(shake.tilt_deg), shake.tilt_s) for axis in range(2)),
            wander(rng, n, step, np.deg2rad(shake.yaw_deg), shake.yaw_s),
        ]
    )
    for axis in range(3):
        angles[:, axis] += wander(rng, n, step, np.deg2rad(shake.buzz_deg), 0.015)
    shift = np.column_stack(
        [
            *(wander(rng, n, step, shake.position_m, shake.position_s) for _ in range(2)),
            wander(rng, n, step, shake.altitude_m, shake.altitude_s),
        ]
    )
    return Unrest(angles, shift)


def fly(
    times: Floats, aim: Floats, yaw: Floats, altitude: float | Floats, shaking: Unrest, body_from_camera: Floats
) -> Flight:
    """A flight that looks at ``aim`` on the whole, shaking about it.

    times: (n,) the grid. aim: (n, 2) ground point that the middle of the picture shows but for the shaking [m].
    yaw: (n,) wanted [rad]. altitude: [m], one or (n,). The constant tilt and the mounting are flown out, their wander
    is not.
    """
    angles = shaking.angles.copy()
    angles[:, 2] += yaw
    mean = shaking.angles[:, :2].mean(axis=0)
    level = rotation(np.full(len(times), mean[0]), np.full(len(times), mean[1]), yaw)
    axis = level @ body_from_camera[:, 2]
    heights = np.broadcast_to(altitude, len(times))
    ahead = heights[:, None] * axis[:, :2] / axis[:, 2:]
    position = np.column_stack([aim - ahead, -heights]) + shaking.shift
    return Flight(times, position, angles)
