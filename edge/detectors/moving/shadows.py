"""Foreground that is no body: cast shadows (the same colour and texture as the background, less light), and ghosts.

Ghosts are where an object of the learnt background has left: recognised by the contrast along their rims.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Bools, Floats, Image, Singles

_ATTENUATION = (0.42, 0.95)  # range of the share of light in a shadow
_TEXTURE_STEP = 7.0  # 8-bit steps of texture difference that are noise
_COLOUR_STEP = 9.0  # 8-bit steps by which a shadow changes colours
_PIXEL_COLOUR_STEP = 14.0  # the same for a single pixel, with its noise
_NEAR, _WINDOW = 5, 9  # px at half the resolution: windows of the local mean and of the texture test
# smallest share of the background's texture in a shadow; standard deviations
_MIN_TEXTURE_SHARE, _HIDDEN_SIGMAS = 0.4, 2.5
_LEAST_NOISE = 2.0  # 8-bit steps
# histogram bins of the attenuation; pixels of certain shadows; forgetting factor per frame
_BINS, _MIN_PIXELS, _FORGETTING = 53, 2000, 0.99
_DARK_QUANTILE, _MARGIN = 0.04, 0.03  # quantile of the attenuation of certain shadows, and a margin below it

GHOST_STEP = 22  # 8-bit steps
# over the height: distance from a rim that is compared; smallest number of its pixels
_RIM_REACH_SHARE, _MIN_RIM_PIXELS = 0.04, 10
# window over the image height; reach of a rim [px]; contrast ratio, as _GHOST_RATIO
_VOTE_WINDOW, _RIM_REACH, _UNCOVERED_RATIO = 0.12, 7, 1.6
# factor between the contrasts of background and image; smallest contrast of the background [8-bit steps]
_GHOST_RATIO, _MIN_GHOST_CONTRAST = 1.4, 12.0


class ShadowDetector:
    """Shadow detector of one camera, which learns how dark shadows are.

    A shadow that shows the texture of its background is certain. Pixels much darker than nearly all of these are not
    classified as shadow: they are mostly trousers of the floor's colour.
    """

    def __init__(self) -> None:
        self._seen: Floats = np.zeros(_BINS)

    @property
    def darkest(self) -> float:
        """The smallest share of light that shadows leave here, as learnt so far."""
        total = self._seen.sum()
        if total < _MIN_PIXELS:
            return _ATTENUATION[0]
        at = int(np.searchsorted(np.cumsum(self._seen), _DARK_QUANTILE * total))
        return max(_ATTENUATION[0] + (_ATTENUATION[1] - _ATTENUATION[0]) * at / _BINS - _MARGIN, _ATTENUATION[0])

    def detect(self, image: Image, background: Image, foreground: Image) -> Image:
        """Shadow pixels (H, W) 0/255 of the ``foreground`` mask (H, W) 0/255.

        image, background: (H, W, 3) BGR under the same light.
        """
        shadow = np.zeros_like(foreground)
        x, y, w, h = cv2.boundingRect(foreground)
        if w < 4 or h < 4:
            return shadow
        # Half the resolution suffices, because all tests are over windows. Resizing from even pixels on is fast.
        bottom, right = min(y + h + (y + h) % 2, foreground.shape[0]), min(x + w + (x + w) % 2, foreground.shape[1])
        x, y = x - x % 2, y - y % 2
        w, h = right - x, bottom - y
        part = slice(y, bottom), slice(x, right)
        half = (w + 1) // 2, (h + 1) // 2
        now = cv2.resize(image[part], half, interpolation=cv2.INTER_AREA)
        then = cv2.resize(background[part], half, interpolation=cv2.INTER_AREA)
        bright_now = cv2.cvtColor(now, cv2.COLOR_BGR2GRAY).astype(np.float32)
        bright_then = cv2.cvtColor(then, cv2.COLOR_BGR2GRAY).astype(np.float32)
        attenuation = (cv2.blur(bright_now, (3, 3)) + 2.0) / (cv2.blur(bright_then, (3, 3)) + 2.0)
        dark = cv2.inRange(attenuation, self.darkest, _ATTENUATION[1])
        if not cv2.countNonZero(dark):
            return shadow
        # The residual to the background dimmed by the local light must be noise, in brightness and in colour.
        dimmed = cv2.multiply(then, cv2.merge([attenuation] * 3), dtype=cv2.CV_8U)
        texture = cv2.blur(cv2.absdiff(bright_now, bright_then * attenuation), (3, 3))
        colour = cv2.blur(cv2.absdiff(now, dimmed), (3, 3))
        same = cv2.inRange(texture, -1.0, _TEXTURE_STEP)
        grey = cv2.inRange(colour, (0, 0, 0), (_COLOUR_STEP,) * 3)
        all_three = cv2.bitwise_and(dark, cv2.bitwise_and(same, grey))
        raised = np.asarray(cv2.resize(foreground[part], half, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        candidates = np.asarray(all_three, dtype=np.uint8)
        light = np.asarray(attenuation, dtype=np.float32)
        hidden, shown = _texture_test(bright_now, bright_then, light, candidates, raised == 0)
        seen = np.histogram(light[(shown & raised) > 0], _BINS, _ATTENUATION)[0]
        self._seen = _FORGETTING * self._seen + seen
        certain = cv2.subtract(candidates, hidden)
        # At the rim of a body its pixels are in the window: there every pixel is tested by itself.
        similar = cv2.subtract(cv2.inRange(cv2.absdiff(now, dimmed), (0, 0, 0), (_PIXEL_COLOUR_STEP,) * 3), hidden)
        rim = cv2.bitwise_and(cv2.dilate(certain, np.ones((3, 3), np.uint8)), cv2.bitwise_and(similar, dark))
        full = cv2.resize(cv2.bitwise_or(certain, rim), (w, h), interpolation=cv2.INTER_NEAREST)
        shadow[part] = cv2.bitwise_and(full, foreground[part])
        return shadow


def _texture_test(
    now: Singles, then: Singles, attenuation: Singles, candidate: Image, quiet: Bools
) -> tuple[Image, Image]:
    """Where a shadow candidate certainly lacks the background's texture, and where it certainly shows it, (h, w) 0/255.

    The first are clothes of the floor's colour. now, then: (h, w) brightness of the image and of the background; left:
    share of light; candidate: 255 where a shadow may be; quiet: pixels without foreground. The image of a shadow is the
    background times ``left``; cloth is independent of it. Over a window their correlation, sum(n t) / sum(t t), is 1 or
    0, where n is the brightness and t the background's times ``left``, both less their local means: little remains of a
    shadow's soft rim, which has gradients of its own. In compressed video a shadow shows less: _MIN_TEXTURE_SHARE. It
    must show significantly less than that, relative to the noise.
    """
    inside: Singles = (candidate > 0).astype(np.float32)

    def total(values: npt.NDArray[Any], size: int) -> Singles:
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (size, size), normalize=False), dtype=np.float32)

    near = np.maximum(total(inside, _NEAR), np.float32(1.0))
    fine_now = (now - total(now * inside, _NEAR) / near) * inside
    fine_then = attenuation * (then - total(then * inside, _NEAR) / near) * inside
    noise = 1.48 * float(np.median(np.abs(now[quiet] - then[quiet]))) if quiet.any() else 3.0
    texture = np.maximum(total(fine_then * fine_then, _WINDOW), np.float32(1e-3))
    share = total(fine_then * fine_now, _WINDOW) / texture
    beyond = (_MIN_TEXTURE_SHARE - share) * np.sqrt(texture) / np.float32(max(noise, _LEAST_NOISE))
    hidden = (beyond > _HIDDEN_SIGMAS) & (share < 0.4 * _MIN_TEXTURE_SHARE)
    shown = (beyond < -_HIDDEN_SIGMAS) & (share > 1.5 * _MIN_TEXTURE_SHARE) & (candidate > 0)
    return np.where(hidden, 255, 0).astype(np.uint8), np.where(shown, 255, 0).astype(np.uint8)


Box = tuple[float, float, float, float]


def remove_ghosts(foreground: Image, now: Image, then: Image, where: Image) -> Image:
    """A mask (H, W) 0/255 with 0 wherever ``where`` is 255 and two images (H, W, 3) are equal within noise."""
    step = GHOST_STEP - 1
    like = cv2.inRange(cv2.absdiff(now, then), (0, 0, 0), (step, step, step))
    return np.asarray(cv2.bitwise_and(foreground, cv2.bitwise_not(cv2.bitwise_and(like, where))), dtype=np.uint8)


def slices(box: Box, shape: tuple[int, ...]) -> tuple[slice, slice]:
    x, y, w, h = box
    left, top = max(math.floor(x), 0), max(math.floor(y), 0)
    return slice(top, min(math.ceil(y + h), shape[0])), slice(left, min(math.ceil(x + w), shape[1]))


def is_ghost(image: Image, background: Image, box: Box, foreground: Image) -> bool:
    """Whether a silhouette is a ghost: its rim has a higher contrast in the background than in the image.

    A ghost is the former place of an object that was learnt as background and has left.
    """
    x, y, w, h = box
    reach = 2 * int(np.clip(round(_RIM_REACH_SHARE * h), 2, 15)) + 1
    rows, columns = slices((x - reach, y - reach, w + 2 * reach, h + 2 * reach), image.shape)
    mask = foreground[rows, columns]
    if mask.size == 0:
        return False
    rim = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    # Exclude the rims of other silhouettes.
    inner = np.zeros(mask.shape, dtype=np.bool_)
    top, left = max(math.floor(y), 0) - rows.start, max(math.floor(x), 0) - columns.start
    inner[top : top + math.ceil(h) + 1, left : left + math.ceil(w) + 1] = True
    rim &= inner
    if rim.sum() < _MIN_RIM_PIXELS:
        return False
    before, now = (_rim_contrast(one[rows, columns], mask, reach)[rim] for one in (background, image))
    return bool(np.median(before) > _GHOST_RATIO * np.median(now) and np.median(before) > _MIN_GHOST_CONTRAST)


def uncovered_background(image: Image, background: Image, foreground: Image) -> Image:
    """Where (H, W) 0/255 a mask shows ghosts: objects of the background image that are not in this one.

    As ``is_ghost``, of every part by the rims near it. At half the resolution.
    """
    found = np.zeros_like(foreground)
    x, y, w, h = cv2.boundingRect(foreground)
    if w < _RIM_REACH or h < _RIM_REACH:
        return found
    wide = (2 * max(round(_VOTE_WINDOW * foreground.shape[0] / 4), 2) + 1,) * 2
    rows, columns = slices((x - _RIM_REACH, y - _RIM_REACH, w + 2 * _RIM_REACH, h + 2 * _RIM_REACH), foreground.shape)
    foreground, image, background = foreground[rows, columns], image[rows, columns], background[rows, columns]
    height, width = foreground.shape
    size = (width + 1) // 2, (height + 1) // 2
    mask = np.asarray(cv2.medianBlur(cv2.resize(foreground, size, interpolation=cv2.INTER_NEAREST), 5), dtype=np.uint8)
    rim = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).astype(np.float32) / 255.0
    smaller = (
        np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_AREA), dtype=np.uint8) for one in (background, image)
    )
    before, now = (cv2.boxFilter(rim * _rim_contrast(one, mask, _RIM_REACH), -1, wide) for one in smaller)
    plain = _MIN_GHOST_CONTRAST * cv2.boxFilter(rim, -1, wide)
    left = np.where((before > _UNCOVERED_RATIO * now) & (before > plain), mask, 0).astype(np.uint8)
    found[rows, columns] = cv2.resize(left, (width, height), interpolation=cv2.INTER_NEAREST)
    return found


def _rim_contrast(part: Image, mask: Image, reach: int) -> npt.NDArray[np.float32]:
    """Difference (h, w) of the mean colours (h, w, 3) near each pixel inside and outside a mask (h, w) 0/255."""
    size = (reach, reach)

    def mean(where: Image) -> npt.NDArray[np.float32]:
        total = cv2.boxFilter(cv2.bitwise_and(part, part, mask=where), cv2.CV_32F, size, normalize=False)
        count = cv2.boxFilter(where, cv2.CV_32F, size, normalize=False) / np.float32(255.0)
        return np.asarray(cv2.divide(total, cv2.merge([np.maximum(count, np.float32(1.0))] * 3)), dtype=np.float32)

    blue, green, red = cv2.split(cv2.absdiff(mean(mask), mean(np.asarray(cv2.bitwise_not(mask), dtype=np.uint8))))
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.float32)
