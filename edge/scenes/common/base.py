"""Base of all simulated scenes: cameras with true clocks and poses, and the renderer's interface.

World axes: z up, metres, the floor at z = 0. Time: true time [s] of the scene, which no camera knows.

Cameras are placed at random around a volume, looking inwards, each with its own intrinsics and clock.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats, Ints

MIXED_FPS = (30.0, 25.0, 29.97, 50.0)  # PAL, NTSC and phones: no two cameras alike


@dataclass(frozen=True, slots=True)
class SimulatedClock:
    """A camera's own clock.

    epoch_ns: its reading at true time 0. rate: its seconds per true second (1 + drift). stamp_noise_s: std of the error
    of time stamps.
    """

    epoch_ns: int
    rate: float = 1.0
    stamp_noise_s: float = 50e-6

    def device_time_ns(self, true_time: float) -> int:
        """Reading of the clock at a true time [s].

        In whole nanoseconds from the epoch on: a Unix time as a float would have a resolution of a quarter of a
        microsecond.
        """
        return self.epoch_ns + round(self.rate * true_time * NANOSECONDS)

    def stamps(self, true_time: Floats, rng: np.random.Generator) -> Floats:
        """Its noisy stamps (n,) [s] at true times (n,) [s]."""
        noise = np.rint(rng.normal(0.0, self.stamp_noise_s, len(true_time)) * NANOSECONDS).astype(np.int64)
        return (np.array([self.device_time_ns(one) for one in true_time], dtype=np.int64) + noise) / NANOSECONDS

    def true_time(self, device_time_ns: int) -> float:
        """The true time [s] at which the clock reads ``device_time_ns``."""
        return (device_time_ns - self.epoch_ns) / NANOSECONDS / self.rate


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedCamera:
    """One camera of a scene: intrinsics, pose, clock and exposure.

    fps: on its own clock. exposure_s: exposure time. readout_s: first to last row (0 = global shutter). jitter_s: std
    of the true deviation of captures from the regular grid (which the time stamps include). drop_fraction: share of
    frames that the device never delivers. start_s: true time of its first frame in an offline session.
    """

    name: str
    intrinsics: Intrinsics
    pose: Pose
    fps: float
    clock: SimulatedClock
    exposure_s: float = 0.008
    readout_s: float = 0.0
    jitter_s: float = 0.002
    drop_fraction: float = 0.02
    start_s: float = 0.0

    def capture_times(self, start: float, first: int, count: int, rng: np.random.Generator) -> Floats:
        """True mid-exposure times (count,) [s] of frames ``first`` … of a recording that begins at ``start``."""
        period = 1.0 / (self.fps * self.clock.rate)
        limit = 0.3 * period  # frames keep their order
        jitter = np.clip(rng.normal(0.0, self.jitter_s, count), -limit, limit)
        return np.asarray(start + (first + np.arange(count)) * period + jitter)


class Renderer(ABC):
    """Renders the images of one camera."""

    @abstractmethod
    def render(self, true_time: float) -> npt.NDArray[np.uint8]:
        """The image (H, W, 3) uint8 BGR exposed around ``true_time`` [s] (mid-exposure, middle row)."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTrack:
    """Simulated detections of one camera, without rendering; rows in order of time.

    frame: (n,). time: (n,) [s] on the camera's own clock. pixels: (n, 2) distorted pixels. size: (n,) [px]. label: n
    names. Ground truth: true_time: (n,) [s] of the exposures; is_outlier: (n,) rows that are false detections.
    """

    camera: str
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats
    label: tuple[str, ...]
    true_time: Floats
    is_outlier: Bools

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedScene:
    """A simulated scene with its cameras; a pure function of its name, seed and number of cameras.

    A new kind of scene derives from this class, and is entered with its renderer in ``edge.scenes``.
    """

    name: str
    seed: int
    cameras: tuple[SimulatedCamera, ...]

    def camera(self, name: str) -> SimulatedCamera:
        """The camera of this name. Raises InputError where there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        names = ", ".join(camera.name for camera in self.cameras)
        raise InputError(f"scene {self.name} has no camera {name!r}", remedy=f"use one of {names}")

    def exposures(
        self, duration_s: float, seed: int, drop_fraction: float | None
    ) -> Iterator[tuple[SimulatedCamera, np.random.Generator, Floats, Bools]]:
        """Each camera, its random numbers, the true times (n,) [s] of its frames, and which (n,) it delivers.

        duration_s: from true time 0; every camera starts at its ``start_s``. drop_fraction: for all cameras, in place
        of their own. The same arguments give the same exposures.
        """
        for index, camera in enumerate(self.cameras):
            rng = np.random.default_rng([seed, index])
            count = max(int((duration_s - camera.start_s) * camera.fps * camera.clock.rate), 0)
            true_time = camera.capture_times(camera.start_s, 0, count, rng)
            kept = rng.random(count) >= (camera.drop_fraction if drop_fraction is None else drop_fraction)
            yield camera, rng, true_time, kept

    def true_time_map(self, camera: str, reference_camera: str) -> TimeMap:
        """True clock relation of two cameras: ``t_reference = clock_rate * t_camera + time_offset`` [s]."""
        clock, reference = self.camera(camera).clock, self.camera(reference_camera).clock
        rate = reference.rate / clock.rate
        return TimeMap(rate, reference.epoch_ns / NANOSECONDS - rate * (clock.epoch_ns / NANOSECONDS))


_Scene = TypeVar("_Scene", bound=SimulatedScene)


def rescale_scene(scene: _Scene, width: int | None = None, fps: float | None = None) -> _Scene:
    """``scene`` with all images ``width`` [px] wide and all cameras at ``fps`` [Hz]; None = unchanged."""
    cameras = tuple(
        replace(
            camera,
            intrinsics=camera.intrinsics if width is None else rescale_intrinsics(camera.intrinsics, width),
            fps=camera.fps if fps is None else fps,
        )
        for camera in scene.cameras
    )
    return replace(scene, cameras=cameras)


def rescale_intrinsics(lens: Intrinsics, width: int) -> Intrinsics:
    """Intrinsics of the same view for images ``width`` [px] wide; pixel centres are at integers."""
    factor = width / lens.width
    height = round(lens.height * factor)
    matrix = lens.matrix.copy()
    matrix[:2] *= factor
    matrix[:2, 2] += 0.5 * factor - 0.5
    return Intrinsics(width, height, matrix, np.asarray(lens.distortions), lens.fisheye)


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
