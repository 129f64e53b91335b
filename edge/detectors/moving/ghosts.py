"""Ghosts: foreground where an object of the learnt background has left: recognised by the contrast along its rim."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Image

Box = tuple[float, float, float, float]

GHOST_STEP = 22  # 8-bit steps
# over the height: distance from a rim that is compared; smallest number of its pixels
_RIM_REACH_SHARE, _MIN_RIM_PIXELS = 0.04, 10
# window over the image height; reach of a rim [px]; contrast ratio, as _GHOST_RATIO
_VOTE_WINDOW, _RIM_REACH, _UNCOVERED_RATIO = 0.12, 7, 1.6
# factor between the contrasts of background and image; smallest contrast of the background [8-bit steps]
_GHOST_RATIO, _MIN_GHOST_CONTRAST = 1.4, 12.0


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
