"""Renders the drone's camera images: the ground by a homography, then cars, occluders and photometric effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.world import cars
from edge.uav.world.noise import value_noise
from edge.uav.world.town import Town
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_BANK_MARGIN = 64  # px by which the noise images exceed the frame: 4096 different crops
_BLUR_SIGMA = 0.6  # px: blur of the lens
_CLOUD_CELL = 2.0  # metres per pixel of the cloud shadow map
_CLOUD_SPEED = np.array([9.0, 6.0])  # north, east [m/s]
_COARSE = 16  # px: cloud shadows are smooth, so they are computed on a coarser grid


@dataclass(frozen=True, slots=True, eq=False)
class Illumination:
    """Illumination of each frame. gain: (n, 3) of blue, green, red. clouds: depth of cloud shadows, 0 for none."""

    gain: Floats
    clouds: float = 0.0


class FlightRenderer:
    """Renders the images of one world. rng: for sensor noise. noise_std: in grey levels (8 bit)."""

    def __init__(
        self,
        town: Town,
        lens: Intrinsics,
        illumination: Illumination,
        rng: np.random.Generator,
        *,
        fps: float,
        noise_std: float,
    ) -> None:
        self._town, self._lens, self._illumination, self._fps = town, lens, illumination, fps
        shape = (lens.height + _BANK_MARGIN, lens.width + _BANK_MARGIN, 3)
        noise = rng.standard_normal(shape, dtype=np.float32) * np.float32(noise_std)
        self._brighter = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
        self._darker = np.clip(np.rint(-noise), 0, 255).astype(np.uint8)
        self._crops = rng.integers(0, _BANK_MARGIN, (len(illumination.gain), 2))
        self._clouds = np.zeros((1, 1), np.float32)
        if illumination.clouds:
            shade = 0.5 + 0.5 * np.tanh(1.5 * value_noise(rng, 256, 256, 24.0, 2))
            self._clouds = np.asarray(255.0 * (1.0 - illumination.clouds * shade), np.float32)

    def render(
        self, frame: int, matrix: Floats, camera: Floats, moving: Sequence[cars.Car], *, noise: bool = True
    ) -> Image:
        """The image of one frame. matrix: (3, 4) pixels from NED; camera: its centre (3,) NED [m].

        moving: the cars to draw in addition to the parked ones.
        """
        size = (self._lens.width, self._lens.height)
        flat = matrix[:, [0, 1, 3]]
        ground, mode = self._town.ground, cv2.BORDER_REPLICATE
        warped = cv2.warpPerspective(ground.image, flat @ ground.ground_from_pixel, size, borderMode=mode)
        image = np.asarray(warped, np.uint8)
        middle, radius = self._footprint(flat)
        for car in self._town.parked:
            if np.abs(car.ground[0] - middle).max() < radius:
                cars.draw(image, matrix, car.ground[0], float(car.course[0]), car.colour)
        for car in moving:
            if np.abs(car.ground[frame] - middle).max() < radius:
                cars.draw(image, matrix, car.ground[frame], float(car.course[frame]), car.colour)
        self._town.occluders.draw(image, matrix, camera)
        return self._expose(image, frame, flat, noise)

    def _footprint(self, flat: Floats) -> tuple[Floats, float]:
        """Centre (2,) and radius [m] of a ground circle that contains the field of view, with a margin of 12 m."""
        w, h = self._lens.width, self._lens.height
        corner = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1.0]]) @ np.linalg.inv(flat).T
        ground = corner[:, :2] / corner[:, 2:]
        middle = ground.mean(axis=0)
        return middle, float(np.linalg.norm(ground - middle, axis=1).max()) + 12.0

    def _expose(self, image: Image, frame: int, flat: Floats, noise: bool) -> Image:
        if self._illumination.clouds:
            image = self._with_cloud_shadows(image, frame, flat)
        gain = self._illumination.gain[frame]
        gain = gain[:1] if np.ptp(gain) == 0.0 else gain  # one look-up table for all channels is faster
        table = np.clip(np.rint(np.arange(256.0)[:, None] * gain), 0, 255).astype(np.uint8).reshape(256, 1, -1)
        image = np.asarray(cv2.LUT(image, table), np.uint8)
        image = np.asarray(cv2.GaussianBlur(image, (3, 3), _BLUR_SIGMA), np.uint8)
        if not noise:
            return image
        y, x = self._crops[frame]
        h, w = image.shape[:2]
        cv2.add(image, self._brighter[y : y + h, x : x + w], image)
        cv2.subtract(image, self._darker[y : y + h, x : x + w], image)
        return image

    def _with_cloud_shadows(self, image: Image, frame: int, flat: Floats) -> Image:
        shift = _CLOUD_SPEED * frame / self._fps
        ground = np.array([[_CLOUD_CELL, 0.0, shift[0]], [0.0, _CLOUD_CELL, shift[1]], [0.0, 0.0, 1.0]])
        shrink = np.diag([1.0 / _COARSE, 1.0 / _COARSE, 1.0])
        w, h = self._lens.width // _COARSE + 1, self._lens.height // _COARSE + 1
        small = cv2.warpPerspective(self._clouds, shrink @ flat @ ground, (w, h), borderMode=cv2.BORDER_WRAP)
        shade = cv2.resize(np.clip(small, 0, 255).astype(np.uint8), (self._lens.width, self._lens.height))
        return np.asarray(cv2.multiply(image, cv2.merge([shade] * 3), scale=1.0 / 255.0), np.uint8)
