"""Random camera placement: around a volume, looking inwards, each with its own intrinsics and clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.scenes.common.base import SimulatedCamera, SimulatedClock
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

MIXED_FPS = (30.0, 25.0, 29.97, 50.0)  # PAL, NTSC and phones: no two cameras alike


@dataclass(frozen=True, slots=True)
class CameraPlacement:
    """Distribution of the cameras of a scene; ranges are (low, high).

    distance: from the volume's axis [m]. height: above the floor [m]. aim: std [m] of the point aimed at about the
    volume's centre. focal: [image widths].
    """

    distance: tuple[float, float]
    height: tuple[float, float]
    aim: float
    focal: tuple[float, float]
    size: tuple[int, int]
    exposure_s: float
    fps: tuple[float, ...] = (30.0,)
    roll: float = 0.3


def place_cameras(
    rng: np.random.Generator, centre: Floats, count: int, surroundings: CameraPlacement
) -> tuple[SimulatedCamera, ...]:
    """``count`` cameras cam0 … around ``centre`` (3,) [m], in a random order of azimuth."""
    sector = 2.0 * np.pi / count
    azimuth = rng.uniform(0.0, 2.0 * np.pi) + sector * (rng.permutation(count) + rng.uniform(-0.3, 0.3, count))
    return tuple(_camera(rng, index, float(azimuth[index]), centre, surroundings) for index in range(count))


def look_at_pose(position: Floats, target: Floats, roll: float = 0.0) -> Pose:
    """Pose of a camera at ``position`` (3,) looking at ``target`` (3,), rolled by ``roll`` [rad] about its axis."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    return Pose(so3.exp(np.array([0.0, 0.0, roll])) @ level, np.asarray(position, dtype=np.float64))


def _camera(
    rng: np.random.Generator, index: int, azimuth: float, centre: Floats, placement: CameraPlacement
) -> SimulatedCamera:
    distance = rng.uniform(*placement.distance)
    position = np.array(
        [centre[0] + distance * np.cos(azimuth), centre[1] + distance * np.sin(azimuth), rng.uniform(*placement.height)]
    )
    pose = look_at_pose(
        position, centre + rng.normal(0.0, placement.aim, 3), rng.uniform(-placement.roll, placement.roll)
    )
    fps = float(placement.fps[index % len(placement.fps)])
    return SimulatedCamera(
        name=f"cam{index}",
        intrinsics=_lens(rng, placement),
        pose=pose,
        fps=fps,
        clock=_clock(rng, index),
        exposure_s=placement.exposure_s,
        jitter_s=rng.uniform(0.5e-3, 2.5e-3),
        drop_fraction=rng.uniform(0.01, 0.03),
        start_s=float(rng.uniform(0.0, 2.0)),
    )


def _lens(rng: np.random.Generator, placement: CameraPlacement) -> Intrinsics:
    width, height = placement.size
    focal = rng.uniform(*placement.focal) * width
    matrix = np.array(
        [
            [focal, 0.0, 0.5 * (width - 1) + rng.normal(0.0, 0.01 * width)],
            [0.0, focal * rng.uniform(0.998, 1.002), 0.5 * (height - 1) + rng.normal(0.0, 0.01 * height)],
            [0.0, 0.0, 1.0],
        ]
    )
    k1 = rng.uniform(-0.25, 0.05)
    # 9 k1² < 20 k2 keeps the radial polynomial monotonic, hence the distortion invertible.
    k2 = 0.6 * k1 * k1 + rng.uniform(0.005, 0.05)
    k3 = rng.uniform(0.0, 0.01)
    return Intrinsics(width, height, matrix, np.array([k1, k2, *rng.normal(0.0, 6e-4, 2), k3]))


def _clock(rng: np.random.Generator, index: int) -> SimulatedClock:
    """Epochs of all usual kinds: time since the camera's boot, Unix time, and 0 at its start."""
    uptime = rng.uniform(10.0, 2e5)
    unix = 1.75e9 + rng.uniform(0.0, 1e7)
    start = rng.uniform(-180.0, 180.0)
    epoch_s = (uptime, unix, start)[index % 3]
    return SimulatedClock(round(epoch_s * NANOSECONDS), 1.0 + rng.uniform(-100e-6, 100e-6))
