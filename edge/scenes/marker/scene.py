"""Worlds with one moving marker: a room in which a ball is waved, and a field over which one is flown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.scenes.common.base import Renderer, Scene
from edge.scenes.common.placement import Surroundings, cameras_around
from edge.scenes.common.trajectory import SmoothPath, flown, hand_waved
from protocols.geometry.types import Floats

ORANGE_BGR = (22.0, 112.0, 246.0)

_ROOM = Surroundings(
    distance=(2.5, 3.1), height=(0.6, 2.3), aim=0.15, focal=(0.72, 1.05), size=(640, 480), exposure_s=0.008
)
_FIELD = Surroundings(
    distance=(38.0, 60.0),
    height=(1.2, 12.0),
    aim=2.0,
    focal=(0.7, 0.95),
    size=(1920, 1080),
    exposure_s=0.004,
    mixed_fps=True,
)
_STREAMS = {"cameras": 0, "path": 1}  # one random stream for each part of a world; the background has 2


@dataclass(frozen=True, slots=True, eq=False)
class MarkerScene(Scene):
    """One ball of constant real size on a smooth random path.

    path: its centre. marker_radius: [m]. marker_bgr: its colour in full light.
    room: half the side and the height [m] of the room around it; None = an open field.
    """

    path: SmoothPath
    marker_radius: float
    marker_bgr: tuple[float, float, float]
    room: tuple[float, float] | None

    def marker_position(self, true_time: Floats) -> Floats:
        """The ball's centre (n, 3) [m] at true times (n,) [s]."""
        return self.path.position(true_time)

    def seen_by(self, camera: str, true_time: Floats) -> tuple[Floats, Floats]:
        """Where and how large a camera sees the ball when it fires at true times (n,) [s].

        Returns pixels (n, 2) of the projection of the ball's centre, NaN where it is behind the camera or so far
        aside that the lens model does not reach, and its diameter (n,) [px]. A rolling shutter reaches the
        ball's row before or after the middle one; the pixel is that of the moment when it does.
        """
        simulated = self.camera(camera)
        lens = simulated.intrinsics
        true_time = np.asarray(true_time, dtype=np.float64)
        reach = _reach(self, camera)
        lag = np.zeros(len(true_time))
        for _ in range(4 if simulated.readout_s else 1):
            points = simulated.pose.camera_from_world(self.marker_position(true_time + lag))
            z = np.where(points[:, 2] > 2.0 * self.marker_radius, points[:, 2], np.nan)
            aside = np.hypot(points[:, 0], points[:, 1]) / z
            points = np.where((aside < reach)[:, None], points, np.nan)
            pixels = lens.project(points)
            if simulated.readout_s:
                row = np.nan_to_num(pixels[:, 1], nan=0.5 * (lens.height - 1))
                lag = (np.clip(row, 0, lens.height - 1) / (lens.height - 1) - 0.5) * simulated.readout_s
        normalised = points[:, :2] / points[:, 2:]
        scale = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(lens.pixel_jacobian(normalised)))))
        # A sphere's outline is a cone of half-angle a, sin(a) = radius / distance. The image plane cuts it, at
        # the angle b off the axis, in an ellipse of area pi sin²(a) cos(a) / (cos²(b) - sin²(a))^1.5.
        distance = np.linalg.norm(points, axis=1)
        sine2 = (self.marker_radius / distance) ** 2
        spread = (points[:, 2] / distance) ** 2 - sine2
        return pixels, np.asarray(2.0 * np.sqrt(sine2 * np.sqrt(1.0 - sine2)) * spread**-0.75 * scale)

    def renderer(self, camera: str, rng: np.random.Generator) -> Renderer:
        from edge.scenes.marker.renderer import MarkerRenderer  # OpenCV is only needed to draw

        return MarkerRenderer(self, camera, rng)


def marker_room(seed: int, cameras: int, mixed_fps: bool = False) -> MarkerScene:
    """``marker``: a 4 cm ball waved through a room, seen by VGA cameras on its walls."""
    centre = np.array([0.0, 0.0, 1.3])
    where = Surroundings(_ROOM.distance, _ROOM.height, _ROOM.aim, _ROOM.focal, _ROOM.size, _ROOM.exposure_s, mixed_fps)
    return MarkerScene(
        name="marker",
        seed=seed,
        cameras=cameras_around(np.random.default_rng([seed, _STREAMS["cameras"]]), centre, cameras, where),
        path=hand_waved(np.random.default_rng([seed, _STREAMS["path"]]), centre, np.array([1.2, 1.2, 0.75])),
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
        cameras=cameras_around(np.random.default_rng([seed, _STREAMS["cameras"]]), centre, cameras, _FIELD),
        path=flown(np.random.default_rng([seed, _STREAMS["path"]]), centre, np.array([24.0, 24.0, 10.0])),
        marker_radius=0.2,
        marker_bgr=ORANGE_BGR,
        room=None,
    )


def _reach(scene: MarkerScene, camera: str) -> float:
    """How far aside (tan of the angle to the axis) a lens model is trusted: a bit beyond the image's corners."""
    lens = scene.camera(camera).intrinsics
    margin = 0.15 * lens.width
    x, y = [-margin, lens.width + margin], [-margin, lens.height + margin]
    corners = lens.unproject(np.array([(u, v) for u in x for v in y]))
    return float(np.nan_to_num(np.hypot(corners[:, 0], corners[:, 1]), nan=2.0).max())
