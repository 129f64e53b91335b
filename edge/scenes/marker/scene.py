"""Scenes with one moving marker: a ball waved in a room, and one flown over a field, on smooth random paths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from edge.scenes.common.base import MIXED_FPS, CameraPlacement, SimulatedScene, SimulatedTrack, place_cameras
from protocols.geometry.types import Floats
from protocols.session.observations import DEFAULT_LABEL

ORANGE_BGR = (22.0, 112.0, 246.0)  # of the demo's ball
_ROOM = CameraPlacement(
    distance=(2.5, 3.1), height=(0.6, 2.3), aim=0.15, focal=(0.72, 1.05), size=(640, 480), exposure_s=0.008
)
_FIELD = CameraPlacement(
    distance=(38.0, 60.0),
    height=(1.2, 12.0),
    aim=2.0,
    focal=(0.7, 0.95),
    size=(1920, 1080),
    exposure_s=0.004,
    fps=MIXED_FPS,
)
_STREAMS = {"cameras": 0, "path": 1}  # one random stream for each part of a scene; the background has stream 2


@dataclass(frozen=True, slots=True, eq=False)
class SmoothPath:
    """A trajectory (x, y, z) = centre + extent * tanh(sum of sinusoids), at a varying rate.

    centre, extent: (3,) [m]; the trajectory stays inside centre ± extent. amplitude (relative to extent), frequency
    [Hz], phase [rad]: (k, 3). pause_depth, pause_frequency [Hz], pause_phase [rad]: (p,); the path parameter runs at
    ``1 + Σ depth cos(…)`` of the true time, so that the target nearly hovers where the sum is near −1. The frequencies
    are random reals: no two share a period.
    """

    centre: Floats
    extent: Floats
    amplitude: Floats
    frequency: Floats
    phase: Floats
    pause_depth: Floats
    pause_frequency: Floats
    pause_phase: Floats

    def position(self, true_time: Floats) -> Floats:
        """Positions (n, 3) [m] at true times (n,) [s]."""
        t = np.asarray(true_time, dtype=np.float64)
        angular_frequency = 2.0 * np.pi * self.pause_frequency
        own = t + (
            np.sin(t[:, None] * angular_frequency + self.pause_phase) * self.pause_depth / angular_frequency
        ).sum(axis=1)
        angle = 2.0 * np.pi * self.frequency * own[:, None, None] + self.phase
        return np.asarray(self.centre + self.extent * np.tanh((self.amplitude * np.sin(angle)).sum(axis=1)))


def hand_waved_path(rng: np.random.Generator, centre: Floats, extent: Floats) -> SmoothPath:
    """A person walking in a room and waving a marker: walk below 0.2 Hz, arm up to 1.1 Hz.

    centre, extent: (3,) [m]. Speeds are around 1 to 3 m/s for an extent of about 1.2 m.
    """
    walk, arm = 5, 5
    frequency = np.concatenate([rng.uniform(0.04, 0.2, (walk, 3)), rng.uniform(0.35, 1.1, (arm, 3))])
    # The arm's amplitude falls with frequency, as a limb's power does: accelerations stay human.
    amplitude = np.concatenate([rng.uniform(0.25, 0.5, (walk, 3)), 0.11 / frequency[walk:]])
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    none = np.zeros(1)
    return SmoothPath(centre, extent, amplitude, frequency, phase, none, np.ones(1), none)


def flown_path(rng: np.random.Generator, centre: Floats, extent: Floats) -> SmoothPath:
    """A small drone over a field: long sweeps at up to some 15 m/s, and phases in which it nearly hovers.

    centre, extent: (3,) [m].
    """
    sweep, turn = 4, 4
    frequency = np.concatenate([rng.uniform(0.008, 0.04, (sweep, 3)), rng.uniform(0.05, 0.16, (turn, 3))])
    amplitude = np.concatenate([rng.uniform(0.3, 0.6, (sweep, 3)), 0.012 / frequency[sweep:]])
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    pause_phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    depth = np.array([0.52, 0.46])
    return SmoothPath(centre, extent, amplitude, frequency, phase, depth, rng.uniform(0.02, 0.06, 2), pause_phase)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerScene(SimulatedScene):
    """One ball of constant radius on a smooth random trajectory.

    path: of its centre. marker_radius: [m]. marker_bgr: its colour in full light. room: half the side and the height
    [m] of the room around it; None = an open field.
    """

    path: SmoothPath
    marker_radius: float
    marker_bgr: tuple[float, float, float]
    room: tuple[float, float] | None

    def marker_position(self, true_time: Floats) -> Floats:
        """The ball's centre (n, 3) [m] at true times (n,) [s]."""
        return self.path.position(true_time)

    def seen_by(self, camera: str, true_time: Floats) -> tuple[Floats, Floats]:
        """Projection and diameter of the ball in the images that a camera exposes at true times (n,) [s].

        Returns distorted pixels (n, 2) of the ball's centre, NaN where it is behind the camera or outside the range of
        the lens model, and its diameter (n,) [px]. With a rolling shutter the pixel is that of the time at which the
        ball's row is read.
        """
        simulated = self.camera(camera)
        lens = simulated.intrinsics
        true_time = np.asarray(true_time, dtype=np.float64)
        reach = _max_view_tangent(self, camera)
        lag = np.zeros(len(true_time))
        for _ in range(4 if simulated.readout_s else 1):
            points = simulated.pose.camera_from_world(self.marker_position(true_time + lag))
            z = np.where(points[:, 2] > 2.0 * self.marker_radius, points[:, 2], np.nan)
            view_tangent = np.hypot(points[:, 0], points[:, 1]) / z
            points = np.where((view_tangent < reach)[:, None], points, np.nan)
            pixels = lens.project(points)
            if simulated.readout_s:
                lag = np.nan_to_num(lens.row_offset(pixels)) * simulated.readout_s
        normalised = points[:, :2] / points[:, 2:]
        scale = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(lens.pixel_jacobian(normalised)))))
        # A sphere's outline is a cone of half-angle a, sin(a) = radius / distance. The image plane cuts it, at the
        # angle b off the axis, in an ellipse of area pi sin²(a) cos(a) / (cos²(b) - sin²(a))^1.5.
        distance = np.linalg.norm(points, axis=1)
        sine2 = (self.marker_radius / distance) ** 2
        spread = (points[:, 2] / distance) ** 2 - sine2
        return pixels, np.asarray(2.0 * np.sqrt(sine2 * np.sqrt(1.0 - sine2)) * spread**-0.75 * scale)


def marker_room(seed: int, cameras: int, mixed_fps: bool = False) -> MarkerScene:
    """``marker``: a 4 cm ball waved in a room, seen by VGA cameras on its walls."""
    centre = np.array([0.0, 0.0, 1.3])
    placement = replace(_ROOM, fps=MIXED_FPS) if mixed_fps else _ROOM
    return MarkerScene(
        name="marker",
        seed=seed,
        cameras=place_cameras(np.random.default_rng([seed, _STREAMS["cameras"]]), centre, cameras, placement),
        path=hand_waved_path(np.random.default_rng([seed, _STREAMS["path"]]), centre, np.array([1.2, 1.2, 0.75])),
        marker_radius=0.04,
        marker_bgr=ORANGE_BGR,
        room=(3.9, 2.7),
    )


def marker_field(seed: int, cameras: int) -> MarkerScene:
    """``marker-outdoor``: a 20 cm ball flown over a field, seen by full-HD cameras of 25, 29.97, 30 and 50 fps."""
    centre = np.array([0.0, 0.0, 14.0])
    return MarkerScene(
        name="marker-outdoor",
        seed=seed,
        cameras=place_cameras(np.random.default_rng([seed, _STREAMS["cameras"]]), centre, cameras, _FIELD),
        path=flown_path(np.random.default_rng([seed, _STREAMS["path"]]), centre, np.array([24.0, 24.0, 10.0])),
        marker_radius=0.2,
        marker_bgr=ORANGE_BGR,
        room=None,
    )


def _max_view_tangent(scene: MarkerScene, camera: str) -> float:
    """Largest tangent of the angle to the axis at which a lens model is used: a bit beyond the image corners."""
    lens = scene.camera(camera).intrinsics
    margin = 0.15 * lens.width
    x, y = [-margin, lens.width + margin], [-margin, lens.height + margin]
    corners = lens.unproject(np.array([(u, v) for u in x for v in y]))
    return float(np.nan_to_num(np.hypot(corners[:, 0], corners[:, 1]), nan=2.0).max())


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
