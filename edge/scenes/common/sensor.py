"""Common parts of renderers: viewing rays of pixels, the static background, and sensor noise."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.scenes.common.background import field, room
from edge.scenes.common.base import SimulatedCamera
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

PEDESTAL = 20
"""Offset of the stored noise, so that one saturating 8-bit addition applies it."""
_BACKGROUND_STREAM = 2  # of a scene's random numbers, beside those of cameras (0) and of what moves (1)
_BACKGROUND_WIDTH = 960  # px; wider images get a background of this width, enlarged
_BANK_MARGIN = 96  # px by which the noise image exceeds the image: 9216 different crops


def pixel_rays(lens: Intrinsics, u: Floats, v: Floats) -> Floats:
    """Unit vectors (h, w, 3) in camera axes of pixels (h, w), (h, w)."""
    flat = lens.unproject(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([flat, np.ones(len(flat))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(rays.reshape(*u.shape, 3))


def static_background(camera: SimulatedCamera, seed: int, walls: tuple[float, float] | None) -> npt.NDArray[np.uint8]:
    """The image (H, W, 3) BGR of an empty scene, whose ``seed`` it comes from, so that all cameras see the same.

    walls: half the side and the height [m] of a furnished room; None = an open field.
    """
    lens, pose = camera.intrinsics, camera.pose
    rng = np.random.default_rng([seed, _BACKGROUND_STREAM])
    shrink = max(1.0, lens.width / _BACKGROUND_WIDTH)
    width, height = round(lens.width / shrink), round(lens.height / shrink)
    u = (np.arange(width) + 0.5) * lens.width / width - 0.5
    v = (np.arange(height) + 0.5) * lens.height / height - 0.5
    rays = pixel_rays(lens, *np.meshgrid(u, v)) @ pose.rotation
    image = field(rays, pose.position, rng) if walls is None else room(rays, pose.position, *walls, rng)
    if shrink > 1.0:
        image = np.asarray(cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    return image


class SensorNoise:
    """Gaussian noise of a sensor of (width, height) px; std in 8-bit steps."""

    def __init__(self, width: int, height: int, std: float, rng: np.random.Generator) -> None:
        self._size = width, height
        self._rng = rng
        shape = (height + _BANK_MARGIN, width + _BANK_MARGIN, 3)
        noise = rng.standard_normal(shape, dtype=np.float32) * std + PEDESTAL
        self._bank = np.clip(np.rint(noise), 0, 255).astype(np.uint8)

    def add(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """The noisy image of one from which PEDESTAL has been subtracted; it saturates as a sensor does."""
        dy, dx = self._rng.integers(0, _BANK_MARGIN, 2)
        width, height = self._size
        return np.asarray(cv2.add(image, self._bank[dy : dy + height, dx : dx + width]), dtype=np.uint8)


def subtract_pedestal(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """An image less PEDESTAL, for ``SensorNoise.add``."""
    return np.asarray(np.maximum(image, PEDESTAL) - np.uint8(PEDESTAL), dtype=np.uint8)
