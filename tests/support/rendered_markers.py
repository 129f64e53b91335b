"""Test images: points of light and tags rendered at known sub-pixel places, with distractors, blur and noise."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import erf

from protocols.geometry.types import Floats, Image


def dim_room(seed: int, width: int = 640, height: int = 480, level: float = 90.0) -> Floats:
    """A textured background (H, W, 3), nowhere brighter than about twice ``level``."""
    rng = np.random.default_rng([seed, 77])
    image = np.full((height, width, 3), level)
    for scale, strength in ((8, 12.0), (40, 25.0), (160, 30.0)):
        coarse = rng.normal(0.0, strength, (height // scale + 2, width // scale + 2, 3)).astype(np.float32)
        image += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(12):  # furniture: edges
        x, y = rng.integers(0, width - 40), rng.integers(0, height - 40)
        w, h = rng.integers(20, 160, 2)
        image[y : y + h, x : x + w] *= rng.uniform(0.5, 1.4)
    return np.clip(image, 0.0, 180.0)


def add_spot(
    image: Floats, u: float, v: float, sigma: float, peak: float, smear: tuple[float, float] = (0.0, 0.0)
) -> None:
    """Add a round spot integrated over each pixel, moved by ``smear`` [px] during the exposure about (u, v).

    It is truncated 7 sigma from its path, where 1e-12 of it is left.
    """
    height, width = image.shape[:2]
    steps = 1 if smear == (0.0, 0.0) else 32
    reach = 7.0 * sigma + 1.0 + 0.5 * float(np.hypot(*smear))
    columns = np.arange(max(int(u - reach), 0), min(int(u + reach) + 2, width))
    rows = np.arange(max(int(v - reach), 0), min(int(v + reach) + 2, height))
    if not len(columns) or not len(rows):
        return
    light = np.zeros((len(rows), len(columns)))
    for step in range(steps):
        part = (step + 0.5) / steps - 0.5

        def covered(axis: Floats | npt.NDArray[np.int_], centre: float) -> Floats:
            scaled = sigma * np.sqrt(2.0)
            return np.asarray(0.5 * (erf((axis + 0.5 - centre) / scaled) - erf((axis - 0.5 - centre) / scaled)))

        light += np.outer(covered(rows, v + part * smear[1]), covered(columns, u + part * smear[0]))
    here = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    image[here] += (peak * 2.0 * np.pi * sigma**2 / steps * light)[..., None]


def exposed(image: Floats, noise: float, rng: np.random.Generator) -> Image:
    """The image of a sensor: noise, clipped at white, integer grey levels."""
    noisy = np.clip(image, 0.0, 400.0) + rng.normal(0.0, noise, image.shape)
    return np.clip(np.rint(np.minimum(noisy, 255.0)), 0, 255).astype(np.uint8)


def add_distractors(image: Floats, rng: np.random.Generator, keep_off: Sequence[float], reach: float = 50.0) -> None:
    """Add distractors: windows, lamps, tubes and dim reflections, none within ``reach`` px of (u, v) = keep_off."""
    height, width = image.shape[:2]
    for kind in ("window", "tube", "lamp", "glimmer", "glimmer"):
        for _ in range(100):
            x, y = rng.uniform(90, width - 90), rng.uniform(90, height - 90)
            if np.hypot(x - keep_off[0], y - keep_off[1]) > reach + 90.0:
                break
        column, row = int(x), int(y)
        if kind == "window":
            image[row - 45 : row + 45, column - 35 : column + 35] = 255.0
        elif kind == "tube":
            image[row : row + 4, column - 70 : column + 70] = 255.0
        elif kind == "lamp":
            add_spot(image, x, y, 30.0, 300.0)
        else:
            add_spot(image, x, y, 1.5, 60.0)


def tag_image(dictionary: int, number: int, pixels: int = 640) -> Image:
    """A tag with its white margin of one cell in eight, grey (pixels, pixels)."""
    inner = pixels * 8 // 10
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(dictionary), number, inner)
    margin = (pixels - inner) // 2
    return np.asarray(cv2.copyMakeBorder(drawn, *[margin] * 4, cv2.BORDER_CONSTANT, value=255), dtype=np.uint8)


def add_tag(image: Floats, tag: Image, centre: Floats, side: float, tilt: Floats, smear: Floats) -> Floats:
    """Render a tag centred at ``centre`` [px] whose black square has ``side`` px in fronto-parallel view.

    tilt: (3,) rotation vector from facing the camera, focal length 800 px. smear: (2,) px during the exposure. Returns
    its four black corners (4, 2).
    """
    rotation, _ = cv2.Rodrigues(np.asarray(tilt, dtype=np.float64))
    focal = 800.0
    depth = focal / side
    pixels = tag.shape[0]
    inner = pixels * 8 // 10 / pixels
    flat = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.5

    def seen(corners: Floats, shift: Floats) -> Floats:
        points = np.column_stack([corners, np.zeros(4)]) @ rotation.T + [0.0, 0.0, depth]
        return np.asarray(focal * points[:, :2] / points[:, 2:] + centre + shift)

    corners_of_image = np.array(
        [[-0.5, -0.5], [pixels - 0.5, -0.5], [pixels - 0.5, pixels - 0.5], [-0.5, pixels - 0.5]]
    )
    steps = 1 if not np.any(smear) else 12
    fine = 4
    corners = seen(flat / inner, np.zeros(2))
    margin = 0.5 * np.abs(smear) + 4.0
    left, top = np.maximum(np.floor(corners.min(axis=0) - margin).astype(int), 0)
    right, bottom = np.minimum(np.ceil(corners.max(axis=0) + margin).astype(int) + 1, image.shape[1::-1])
    height, width = bottom - top, right - left
    total = np.zeros((height, width))
    cover = np.zeros((height, width))
    for step in range(steps):
        part = ((step + 0.5) / steps - 0.5) * np.asarray(smear)
        quad = seen(flat / inner, part) - [left, top]
        large = (quad + 0.5) * fine - 0.5
        warp = cv2.getPerspectiveTransform(corners_of_image.astype(np.float32), large.astype(np.float32))
        size = (width * fine, height * fine)
        drawn = cv2.warpPerspective(tag, warp, size, flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full_like(tag, 255), warp, size, flags=cv2.INTER_NEAREST)
        total += cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA).astype(float) / steps
        cover += cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA).astype(float) / (255.0 * steps)
    paper = 30.0 + total * 190.0 / 255.0
    here = image[top:bottom, left:right]
    here[...] = here * (1.0 - cover[..., None]) + (paper * np.minimum(cover, 1.0))[..., None]
    return seen(flat, np.zeros(2))
