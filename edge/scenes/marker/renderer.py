"""Renderer of marker scenes: anti-aliased ball, motion blur, static background, sensor noise.

Each pixel's ray is intersected with the sphere, so that the outline is the exact ellipse under the lens model; the
image is the mean over the exposure, so that a moving ball is smeared about its mid-exposure position.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from edge.scenes.common.background import (
    LIGHT_WORLD,
    PEDESTAL,
    SensorNoise,
    pixel_rays,
    static_background,
    subtract_pedestal,
)
from edge.scenes.common.base import Renderer
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    from edge.scenes.marker.scene import MarkerScene

_NOISE_STD = 3.0  # of a small sensor indoors, in 8-bit steps
_MAX_STEPS = 16  # samples of one exposure
_AMBIENT, _DIFFUSE, _GLINT = 0.62, 0.42, 0.35  # shares of the light, of a matt ball


class MarkerRenderer(Renderer):
    """Images of a marker scene from one camera.

    noise_rng: sensor noise. noise_std: its std [8-bit steps].
    """

    def __init__(
        self,
        scene: MarkerScene,
        camera: str,
        noise_rng: np.random.Generator,
        noise_std: float = _NOISE_STD,
    ) -> None:
        self._scene = scene
        self._camera = scene.camera(camera)
        self._name = camera
        lens = self._camera.intrinsics
        self._dimmed = subtract_pedestal(static_background(self._camera, scene.seed, scene.room))
        self._noise = SensorNoise(lens.width, lens.height, noise_std, noise_rng)
        self._light = self._camera.pose.rotation @ LIGHT_WORLD

    def render(self, true_time: float) -> npt.NDArray[np.uint8]:
        image = self._dimmed.copy()
        self._draw_marker(image, true_time)
        return self._noise.add(image)

    def _draw_marker(self, image: npt.NDArray[np.uint8], true_time: float) -> None:
        camera, lens = self._camera, self._camera.intrinsics
        ends = true_time + 0.5 * camera.exposure_s * np.array([-1.0, 0.0, 1.0])
        pixels, diameter = self._scene.seen_by(self._name, ends)
        if not np.isfinite(pixels).all():
            return
        smear = float(np.linalg.norm(pixels[2] - pixels[0]))
        reach = 0.6 * float(diameter.max()) + 3.0
        low = np.floor(pixels.min(axis=0) - reach).astype(int)
        high = np.ceil(pixels.max(axis=0) + reach).astype(int) + 1
        left, top = max(int(low[0]), 0), max(int(low[1]), 0)
        right, bottom = min(int(high[0]), lens.width), min(int(high[1]), lens.height)
        if right <= left or bottom <= top:
            return
        rays = pixel_rays(lens, *np.meshgrid(np.arange(left, right, dtype=float), np.arange(top, bottom, dtype=float)))
        rays = np.where(np.isfinite(rays), rays, 0.0)
        steps = int(np.clip(np.ceil(2.0 * smear), 1, _MAX_STEPS))
        instants = true_time + camera.exposure_s * ((np.arange(steps) + 0.5) / steps - 0.5)
        if camera.readout_s:  # the ball's position when its own row is read
            instants = instants + camera.readout_s * lens.row_offset(pixels[1:2])
        centres = camera.pose.camera_from_world(self._scene.marker_position(instants))
        cover, light = self._ball(rays, centres)
        patch = image[top:bottom, left:right].astype(np.float64) + PEDESTAL
        bare = 1.0 - cover.mean(axis=0)[..., None]
        patch = bare * patch + (cover[..., None] * light).mean(axis=0)
        image[top:bottom, left:right] = np.clip(np.rint(patch - PEDESTAL), 0, 255)

    def _ball(self, rays: Floats, centres: Floats) -> tuple[Floats, Floats]:
        """Coverage (s, h, w) in 0..1 and colour (s, h, w, 3) of the ball.

        rays: (h, w, 3) unit vectors, one per pixel. centres: (s, 3) of the ball at s instants; camera axes.
        """
        distance = np.linalg.norm(centres, axis=1)
        towards = centres / distance[:, None]
        cosine = np.clip(np.einsum("hwk,sk->shw", rays, towards), 0.05, 1.0)
        sine_edge = (self._scene.marker_radius / distance)[:, None, None]
        # Offset of a ray from the centre across the line of sight, in units of the sphere's radius.
        across = (rays / cosine[..., None] - towards[:, None, None]) / sine_edge[..., None]
        across *= cosine[..., None]  # sin instead of tan: exact at the outline
        radius = np.linalg.norm(across, axis=-1)
        # Distance from the outline in pixels: scaled by the gradient of the radius in the image.
        slope = np.hypot(np.gradient(radius, axis=1), np.gradient(radius, axis=2)) if min(rays.shape[:2]) > 1 else 1.0
        cover = np.clip(0.5 + (1.0 - radius) / np.maximum(slope, 1e-3), 0.0, 1.0)
        inner = np.minimum(radius, 1.0)
        normal = across * (inner / np.maximum(radius, 1e-9))[..., None]
        normal = normal - np.sqrt(1.0 - inner * inner)[..., None] * towards[:, None, None]
        facing = np.clip(normal @ self._light, 0.0, 1.0)
        colour = np.array(self._scene.marker_bgr) * (_AMBIENT + _DIFFUSE * facing)[..., None]
        half_way = self._light - towards
        half_way /= np.linalg.norm(half_way, axis=1, keepdims=True)
        glint = np.clip(np.einsum("shwk,sk->shw", normal, half_way), 0.0, 1.0) ** 40
        return cover, np.minimum(colour + 255.0 * _GLINT * glint[..., None], 255.0)
