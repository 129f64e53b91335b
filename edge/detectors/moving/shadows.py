"""Which of what is raised from the background is only in shadow: the same colour and texture, less light."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Bools, Floats

Image = npt.NDArray[np.uint8]
_Picture = npt.NDArray[np.float32]
_LIGHT = (0.42, 0.95)  # that a shadow may leave
_TEXTURE = 7.0  # 8-bit steps that are noise
_CHROMA = 9.0  # 8-bit steps by which a shadow changes colours
_PIXEL = 14.0  # the same of one pixel, with its noise
_NEAR, _WINDOW = 5, 9  # pixels of half the picture: in which a shadow must show the texture of what it falls on
_SHOWN, _HIDDEN = 0.4, 2.5  # share of the texture that a shadow shows at least; standard deviations
_LEAST_NOISE = 2.0  # 8-bit steps
_BINS, _ENOUGH, _FADE = 53, 2000, 0.99  # of light; pixels that must have shown their texture; share kept each time
_DARKEST, _MARGIN = 0.04, 0.03  # share of those that may be darker than the place's shadows; of the light


class Shadows:
    """The shadows of one place, which learns how dark they are.

    A shadow that shows the texture of what it falls on is surely one. Nothing that is much darker than nearly all of
    those is taken for a shadow: trousers of the floor's colour mostly are.
    """

    def __init__(self) -> None:
        self._seen: Floats = np.zeros(_BINS)

    @property
    def darkest(self) -> float:
        """The least share of the light that this place's shadows leave, as far as known."""
        total = self._seen.sum()
        if total < _ENOUGH:
            return _LIGHT[0]
        at = int(np.searchsorted(np.cumsum(self._seen), _DARKEST * total))
        return max(_LIGHT[0] + (_LIGHT[1] - _LIGHT[0]) * at / _BINS - _MARGIN, _LIGHT[0])

    def find(self, image: Image, background: Image, figure: Image) -> Image:
        """Which pixels (H, W) 0/255 of the raised ones, ``figure`` (H, W) 0/255, are shadow.

        image, background: (H, W, 3) BGR under the same light.
        """
        shadow = np.zeros_like(figure)
        x, y, w, h = cv2.boundingRect(figure)
        if w < 4 or h < 4:
            return shadow
        # Half the resolution does: what is asked is asked of a neighbourhood anyhow. From even pixels on: that is fast.
        bottom, right = min(y + h + (y + h) % 2, figure.shape[0]), min(x + w + (x + w) % 2, figure.shape[1])
        x, y = x - x % 2, y - y % 2
        w, h = right - x, bottom - y
        part = slice(y, bottom), slice(x, right)
        half = (w + 1) // 2, (h + 1) // 2
        now = cv2.resize(image[part], half, interpolation=cv2.INTER_AREA)
        then = cv2.resize(background[part], half, interpolation=cv2.INTER_AREA)
        bright_now = cv2.cvtColor(now, cv2.COLOR_BGR2GRAY).astype(np.float32)
        bright_then = cv2.cvtColor(then, cv2.COLOR_BGR2GRAY).astype(np.float32)
        left = (cv2.blur(bright_now, (3, 3)) + 2.0) / (cv2.blur(bright_then, (3, 3)) + 2.0)
        dark = cv2.inRange(left, self.darkest, _LIGHT[1])
        if not cv2.countNonZero(dark):
            return shadow
        # What is left after the background was dimmed by the local light must be noise, in brightness and in colour.
        dimmed = cv2.multiply(then, cv2.merge([left] * 3), dtype=cv2.CV_8U)
        texture = cv2.blur(cv2.absdiff(bright_now, bright_then * left), (3, 3))
        colour = cv2.blur(cv2.absdiff(now, dimmed), (3, 3))
        same = cv2.inRange(texture, -1.0, _TEXTURE)
        grey = cv2.inRange(colour, (0, 0, 0), (_CHROMA,) * 3)
        all_three = cv2.bitwise_and(dark, cv2.bitwise_and(same, grey))
        raised = np.asarray(cv2.resize(figure[part], half, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        seems = np.asarray(all_three, dtype=np.uint8)
        light = np.asarray(left, dtype=np.float32)
        hidden, shown = _texture(bright_now, bright_then, light, seems, raised == 0)
        self._learn(light[(shown & raised) > 0])
        sure = cv2.subtract(seems, hidden)
        # At the rim of a body the neighbourhood is half the body's: there every pixel speaks for itself.
        alike = cv2.subtract(cv2.inRange(cv2.absdiff(now, dimmed), (0, 0, 0), (_PIXEL,) * 3), hidden)
        rim = cv2.bitwise_and(cv2.dilate(sure, np.ones((3, 3), np.uint8)), cv2.bitwise_and(alike, dark))
        full = cv2.resize(cv2.bitwise_or(sure, rim), (w, h), interpolation=cv2.INTER_NEAREST)
        shadow[part] = cv2.bitwise_and(full, figure[part])
        return shadow

    def _learn(self, light: npt.NDArray[np.float32]) -> None:
        self._seen = _FADE * self._seen + np.histogram(light, _BINS, _LIGHT)[0]


def _texture(now: _Picture, then: _Picture, left: _Picture, candidate: Image, quiet: Bools) -> tuple[Image, Image]:
    """Where what seems a shadow surely does not show the background's texture, and where it surely does.

    The first is trousers of the floor's colour.
    now, then: (h, w) brightness and the background's; left: share of its light; candidate: 255 where a shadow may lie;
    quiet: where nothing stands. A shadow's picture is the background's times ``left``, cloth has nothing of it:
    over a window their correlation, sum(n t) / sum(t t), is 1 or 0, where n is the brightness and t the background's
    times ``left``, both less their means nearby: of a shadow's soft rim, which has slopes of its own, little is left.
    Where a film was compressed a shadow shows less: _SHOWN. It must be seen to show less than that, beyond the noise.
    """
    inside: _Picture = (candidate > 0).astype(np.float32)

    def total(values: npt.NDArray[Any], size: int) -> _Picture:
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (size, size), normalize=False), dtype=np.float32)

    near = np.maximum(total(inside, _NEAR), np.float32(1.0))
    fine_now = (now - total(now * inside, _NEAR) / near) * inside
    fine_then = left * (then - total(then * inside, _NEAR) / near) * inside
    noise = 1.48 * float(np.median(np.abs(now[quiet] - then[quiet]))) if quiet.any() else 3.0
    texture = np.maximum(total(fine_then * fine_then, _WINDOW), np.float32(1e-3))
    share = total(fine_then * fine_now, _WINDOW) / texture
    beyond = (_SHOWN - share) * np.sqrt(texture) / np.float32(max(noise, _LEAST_NOISE))
    hidden = (beyond > _HIDDEN) & (share < 0.4 * _SHOWN)
    shown = (beyond < -_HIDDEN) & (share > 1.5 * _SHOWN) & (candidate > 0)
    return np.where(hidden, 255, 0).astype(np.uint8), np.where(shown, 255, 0).astype(np.uint8)
