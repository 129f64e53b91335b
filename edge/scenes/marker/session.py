"""Simulated detections of the marker, without rendering: what detectors would have reported."""

from __future__ import annotations

import numpy as np

from edge.scenes.common.base import SimulatedTrack
from edge.scenes.marker.scene import MarkerScene
from protocols.session.observations import DEFAULT_LABEL


def simulate_tracks(
    scene: MarkerScene,
    duration_s: float,
    seed: int,
    *,
    pixel_noise: float = 0.1,
    size_noise: float = 0.01,
    outlier_fraction: float = 0.0,
    drop_fraction: float | None = None,
) -> dict[str, SimulatedTrack]:
    """Simulate detections by camera, also of those that see none; arguments see ``SimulatedScene.exposures``.

    pixel_noise: std of each coordinate [px]; 0.1 is that of the shipped detector. size_noise: relative std of the
    diameter. outlier_fraction: share of rows at a uniformly random place.
    """
    tracks = {}
    for camera, rng, true_time, kept in scene.exposures(duration_s, seed, drop_fraction):
        count = len(true_time)
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
            label=(DEFAULT_LABEL,) * int(kept.sum()),
            true_time=true_time[kept],
            is_outlier=outlier[kept],
        )
    return tracks
