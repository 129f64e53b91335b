"""Drone trajectories: position and attitude over time, with random disturbances.

Frames: ned = north, east, down [m]; body = forward, right, down; camera = x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.world.noise import smoothed_noise
from protocols.geometry import so3
from protocols.geometry.types import Floats

LEAD_S = 2.0  # s: the trajectory begins this long before the first frame
GRID_HZ = 120.0  # of the planned path: twice the fastest camera
BODY_FROM_DOWN_CAMERA: Floats = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Camera looking straight down, the top of the image forward."""


@dataclass(frozen=True, slots=True)
class DisturbanceLevels:
    """Levels of attitude and position disturbances: std of each coloured noise, with its time constant [s]."""

    tilt_deg: float = 1.1
    tilt_s: float = 0.55
    yaw_deg: float = 2.5
    yaw_s: float = 1.5
    vibration_deg: float = 0.03  # vibration
    position_m: float = 0.8
    position_s: float = 1.0
    altitude_m: float = 0.7
    altitude_s: float = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Position (n, 3) NED [m] and roll, pitch, yaw (n, 3) [rad] at the time grid ``times`` (n,) [s]."""

    times: Floats
    position: Floats
    angles: Floats

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """ned_from_body (k, 3, 3) and position (k, 3), interpolated at ``times`` (k,) [s]."""
        roll, pitch, yaw = (np.interp(times, self.times, self.angles[:, axis]) for axis in range(3))
        position = np.column_stack([np.interp(times, self.times, self.position[:, axis]) for axis in range(3)])
        return rotation(roll, pitch, yaw), position


def rotation(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """ned_from_body (k, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll)."""
    axes = np.eye(3)
    turned = so3.exp(yaw[:, None] * axes[2]) @ so3.exp(pitch[:, None] * axes[1]) @ so3.exp(roll[:, None] * axes[0])
    return np.asarray(turned)


def grid_times(seconds: float) -> Floats:
    """Time grid (n,) [s] on which a flight of this length is computed."""
    return np.arange(-LEAD_S, seconds + 0.5, 1.0 / GRID_HZ)


@dataclass(frozen=True, slots=True, eq=False)
class Disturbance:
    """One random draw of the disturbances on the time grid. angles: (n, 3) [rad]; shift: (n, 3) NED [m]."""

    angles: Floats
    shift: Floats


def sample_disturbance(
    rng: np.random.Generator, times: Floats, levels: DisturbanceLevels, mean_tilt_deg: float = 2.5
) -> Disturbance:
    """Draw disturbances: constant tilt, coloured tilt and yaw noise, vibration, coloured position noise."""
    step, n = 1.0 / GRID_HZ, len(times)
    tilt = np.deg2rad(rng.normal(0.0, mean_tilt_deg, 2))
    turns = [(levels.tilt_deg, levels.tilt_s)] * 2 + [(levels.yaw_deg, levels.yaw_s)]
    angles = np.column_stack([smoothed_noise(rng, n, step, np.deg2rad(size), seconds) for size, seconds in turns])
    angles[:, :2] += tilt
    for axis in range(3):
        angles[:, axis] += smoothed_noise(rng, n, step, np.deg2rad(levels.vibration_deg), 0.015)
    moves = [(levels.position_m, levels.position_s)] * 2 + [(levels.altitude_m, levels.altitude_s)]
    return Disturbance(angles, np.column_stack([smoothed_noise(rng, n, step, *move) for move in moves]))


def flight_over(
    times: Floats,
    aim: Floats,
    yaw: Floats,
    altitude: float | Floats,
    disturbance: Disturbance,
    body_from_camera: Floats,
) -> Flight:
    """A flight whose camera points at ``aim`` on average, with disturbances about it.

    times: (n,) the grid. aim: (n, 2) ground point at the image centre without disturbances [m]. yaw: (n,) nominal
    [rad]. altitude: [m], one or (n,). The constant tilt and the mounting are compensated by the position, the
    time-varying part is not.
    """
    angles = disturbance.angles.copy()
    angles[:, 2] += yaw
    mean = disturbance.angles[:, :2].mean(axis=0)
    level = rotation(np.full(len(times), mean[0]), np.full(len(times), mean[1]), yaw)
    axis = level @ body_from_camera[:, 2]
    heights = np.broadcast_to(altitude, len(times))
    ahead = heights[:, None] * axis[:, :2] / axis[:, 2:]
    position = np.column_stack([aim - ahead, -heights]) + disturbance.shift
    return Flight(times, position, angles)
