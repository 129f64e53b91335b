"""Simulated detections of the marker, without rendering: what detectors would have reported."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.scenes.common.base import SimulatedCamera
from edge.scenes.marker.scene import MarkerScene
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTrack:
    """Detections of the marker by one camera; rows in order of time.

    frame: (n,). time: (n,) [s] on the camera's own clock. pixels: (n, 2) distorted pixels. size: (n,) diameter [px].
    Ground truth: true_time: (n,) [s] of the exposures; is_outlier: (n,) rows that are false detections.
    """

    camera: str
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats
    true_time: Floats
    is_outlier: Bools

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTracks:
    """Detections of all cameras with ground truth: the scene knows intrinsics, poses, clocks and the marker's
    trajectory.

    start, end: true times [s] between which frames were exposed.
    """

    scene: MarkerScene
    tracks: dict[str, SimulatedTrack]
    start: float
    end: float

    @property
    def cameras(self) -> tuple[SimulatedCamera, ...]:
        """All cameras, also those without detections."""
        return self.scene.cameras

    def true_time_map(self, camera: str, reference_camera: str) -> TimeMap:
        """True clock relation ``t_reference = clock_rate * t_camera + time_offset``."""
        return self.scene.true_time_map(camera, reference_camera)

    def marker_position(self, camera: str, camera_time: Floats) -> Floats:
        """True marker positions (n, 3) [m] at times (n,) [s] on a camera's clock."""
        clock = self.scene.camera(camera).clock
        return self.scene.marker_position((np.asarray(camera_time) - clock.epoch_ns / NANOSECONDS) / clock.rate)


def simulate_tracks(
    scene: MarkerScene,
    duration_s: float,
    seed: int,
    *,
    pixel_noise: float = 0.1,
    size_noise: float = 0.01,
    outlier_fraction: float = 0.0,
    drop_fraction: float | None = None,
) -> SimulatedTracks:
    """Simulate detections for ``duration_s`` from true time 0; every camera starts at its ``start_s``.

    pixel_noise: std of each coordinate [px]; 0.1 is that of the shipped detector. size_noise: relative std of the
    diameter. outlier_fraction: share of rows at a uniformly random place. drop_fraction: for all cameras, in place
    of their own. The same arguments give the same detections.
    """
    tracks = {}
    for index, camera in enumerate(scene.cameras):
        rng = np.random.default_rng([seed, index])
        count = max(int((duration_s - camera.start_s) * camera.fps * camera.clock.rate), 0)
        true_time = camera.capture_times(camera.start_s, 0, count, rng)
        kept = rng.random(count) >= (camera.drop_fraction if drop_fraction is None else drop_fraction)
        pixels, size = scene.seen_by(camera.name, true_time)
        pixels = pixels + rng.normal(0.0, pixel_noise, (count, 2))
        size = size * (1.0 + rng.normal(0.0, size_noise, count))
        # A ball truncated by the image border is not detected.
        limit = np.array([camera.intrinsics.width, camera.intrinsics.height]) - 1.0
        reach = 0.5 * size[:, None]
        with np.errstate(invalid="ignore"):
            kept &= ((pixels >= reach) & (pixels <= limit - reach)).all(axis=1)
        outlier = rng.random(count) < outlier_fraction
        pixels = np.where(outlier[:, None], rng.uniform(0.0, 1.0, (count, 2)) * limit, pixels)
        size = np.where(outlier, size * rng.uniform(0.5, 2.0, count), size)
        seconds = camera.clock.stamps(true_time, rng)
        tracks[camera.name] = SimulatedTrack(
            camera=camera.name,
            frame=np.flatnonzero(kept).astype(np.int64),
            time=seconds[kept],
            pixels=pixels[kept],
            size=size[kept],
            true_time=true_time[kept],
            is_outlier=outlier[kept],
        )
    return SimulatedTracks(scene, tracks, 0.0, duration_s)
