"""Nearest-neighbour colour classification of the marker's pixels.

A pixel belongs to the class of the labelled example colour nearest to it, and to neither where the nearest target
example is too far away (the classifier of the marker paper's reference [7]). All results are precomputed in a table
over quantised colours, so that an image is classified by one look-up per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from protocols.core.errors import InputError
from protocols.geometry.types import Floats

_BITS = 5  # of each channel in the table: 32³ entries, which fit into the cache of a single-board computer
_CELLS = 1 << _BITS
_MAX_EXAMPLES = 600  # per class
# BGR to luma and two colour differences. Luma has a small weight: a ball is bright above and dark below.
_LUMA_WEIGHT = 0.35
_TO_METRIC = np.array([[0.114, 0.587, 0.299], [0.5, -0.331, -0.169], [-0.081, -0.419, 0.5]]) * np.array(
    [[_LUMA_WEIGHT], [1.6], [1.6]]
)
_REJECT = 30.0  # distance in colour beyond which nothing is the target
# Palette of everything that is not the target: hues [°], saturations, values.
_PALETTE_HUES = tuple(float(turn) for turn in range(0, 360, 14))
_PALETTE_SATURATIONS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of the palette
_PALETTE_VALUES = (0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)  # of the palette
_PALETTE_DISTANCE = 28.0  # from the target's examples, in the metric: farther palette colours are other
_MAX_BACKGROUND_RATIO = 0.25  # a colour is background where it is this frequent outside the box relative to inside


@dataclass(frozen=True, slots=True, eq=False)
class ColourModel:
    """Labelled example colours and the look-up table made from them.

    target, other: example colours (n, 3), (m, 3) BGR 0..255. reject: largest distance to a target example, in the
    classifier's metric (colour differences count about 4.5 times as much as luma).
    """

    target: Floats
    other: Floats
    reject: float = _REJECT

    def table(self) -> npt.NDArray[np.uint8]:
        """(32768,) uint8: 1 where a quantised colour is the target's; index blue << 10 | green << 5 | red."""
        axis = (np.arange(_CELLS) + 0.5) * (256 / _CELLS) - 0.5
        cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        near = _nearest(cells, self.target)
        found = near < self.reject
        found[found] = near[found] < _nearest(cells[found], self.other)
        return found.astype(np.uint8)

    def to_table(self) -> dict[str, Any]:
        """As plain values for a TOML table: examples as [red, green, blue]."""
        return {
            "reject": self.reject,
            "target": np.rint(self.target[:, ::-1]).astype(int).tolist(),
            "other": np.rint(self.other[:, ::-1]).astype(int).tolist(),
        }

    @classmethod
    def from_table(cls, table: dict[str, Any]) -> ColourModel:
        """The inverse of ``to_table``. Raises InputError where the table is no colour model."""
        remedy = "teach the detector again"
        try:
            target = np.array(table["target"], dtype=np.float64).reshape(-1, 3)[:, ::-1]
            other = np.array(table["other"], dtype=np.float64).reshape(-1, 3)[:, ::-1]
            reject = float(table.get("reject", _REJECT))
        except (KeyError, TypeError, ValueError):
            raise InputError(
                "this is no colour model: target and other must be lists of colours", remedy=remedy
            ) from None
        colours = np.concatenate([target, other])
        if not len(target) or not np.isfinite(reject) or not ((colours >= 0) & (colours <= 255)).all():
            raise InputError("this colour model has no target colour or values beyond 0..255", remedy=remedy)
        return cls(target, other, reject)

    @classmethod
    def of_hue(cls, bgr: tuple[float, float, float]) -> ColourModel:
        """A model of a uniformly coloured target (blue, green, red) in light and shade, against everything else.

        The other examples are a palette: greys, and hues from 14° away on, at all saturations; and the target's own hue
        at less than 60 % of its saturation (wood, cardboard, skin). Raises InputError for a colour without a hue.
        """
        base = np.array(bgr, dtype=np.float64)
        shades = np.linspace(0.35, 1.05, 15)[:, None] * base
        glints = base + np.linspace(0.0, 0.35, 5)[:, None] * (255.0 - base)
        hue, saturation, _ = cv2.cvtColor((base / 255.0).astype(np.float32)[None, None], cv2.COLOR_BGR2HSV).ravel()
        if saturation < 0.35 or base.max() < 60.0:
            raise InputError(
                f"a marker of sRGB colour {tuple(round(c) for c in bgr[::-1])} has hardly a hue",
                remedy="use a brightly coloured ball, or teach the detector from a picture",
            )
        grid = [
            ((float(hue) + turn) % 360.0, strength, value)
            for turn in _PALETTE_HUES
            for strength in _PALETTE_SATURATIONS
            for value in _PALETTE_VALUES
            if turn or strength < 0.6 * saturation
        ]
        other = _from_hsv(grid)
        return cls(np.clip(np.concatenate([shades, glints]), 0, 255), other)


def colour_indices(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint16]:
    """Indices (H, W) of the pixels of an image (H, W, 3) BGR into ``ColourModel.table``."""
    shift = 8 - _BITS
    code = (image[..., 0] >> shift).astype(np.uint16)
    for channel in (1, 2):
        code <<= _BITS
        code |= image[..., channel] >> shift
    return code


def learn_colour_model(
    image: npt.NDArray[np.uint8], inside: npt.NDArray[np.bool_], outside: npt.NDArray[np.bool_]
) -> ColourModel:
    """Learn a model from labelled pixels of an image (H, W, 3) BGR.

    inside, outside: masks (H, W). Colours inside that are also common outside are background that the box included, and
    are labelled so. Raises InputError where no colour inside differs from the outside.
    """
    code = colour_indices(np.asarray(cv2.GaussianBlur(image, (3, 3), 0), dtype=np.uint8))
    shape = (_CELLS,) * 3
    within = _smooth(np.bincount(code[inside], minlength=_CELLS**3).reshape(shape) / max(int(inside.sum()), 1))
    beyond = _smooth(np.bincount(code[outside], minlength=_CELLS**3).reshape(shape) / max(int(outside.sum()), 1))
    # Compare counts of pixels, not shares: a box of 400 px beside 300,000 px of background.
    share = max(int(outside.sum()), 1) / max(int(inside.sum()), 1)
    is_target = (
        (within > 0) & (beyond * share < _MAX_BACKGROUND_RATIO * within) & (beyond < _MAX_BACKGROUND_RATIO * within)
    )
    # Pixels of the rim are mixtures; only pixels within it are examples of the target.
    blob = inside & is_target.ravel()[code]
    core = cv2.erode(blob.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    pure = core if core.sum() >= 9 else blob
    cells = np.bincount(code[pure], minlength=_CELLS**3).reshape(shape) * is_target
    target = _examples(cells.astype(np.float64))
    if not len(target):
        raise InputError(
            "nothing in the taught box has a colour of its own",
            remedy="draw the box closely around the target, and choose a target whose colour is rare in the scene",
        )
    seen = _examples(np.where(is_target, 0.0, beyond))
    # One image does not show all that other cameras will see: a palette represents the rest.
    palette = _from_hsv([(h, s, v) for h in _PALETTE_HUES for s in _PALETTE_SATURATIONS for v in _PALETTE_VALUES])
    return ColourModel(target, np.concatenate([seen, palette[_nearest(palette, target) > _PALETTE_DISTANCE]]))


def _from_hsv(colours: list[tuple[float, float, float]]) -> Floats:
    """BGR 0..255 (n, 3) of hue [°], saturation and value 0..1."""
    hsv = np.array(colours, dtype=np.float32)[None]
    bgr = np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR), dtype=np.float64)[0]
    return np.asarray(np.clip(bgr * 255.0, 0.0, 255.0))


def _nearest(colours: Floats, examples: Floats) -> Floats:
    """Distance (n,) of each colour (n, 3) to the nearest example (m, 3) in the classifier's metric."""
    if not len(examples):
        return np.full(len(colours), np.inf)
    a, b = colours @ _TO_METRIC.T, examples @ _TO_METRIC.T
    best = np.full(len(a), np.inf)
    for start in range(0, len(b), 100):  # in pieces: 32768 × 600 distances at once would be 160 MB
        part = b[start : start + 100]
        square = (part * part).sum(axis=1) - 2.0 * a @ part.T
        best = np.minimum(best, square.min(axis=1))
    return np.asarray(np.sqrt(np.maximum(best + (a * a).sum(axis=1), 0.0)))


def _smooth(histogram: Floats) -> Floats:
    """Spread a colour histogram (32, 32, 32) by one cell, the reach of noise."""
    out = histogram
    for axis in range(3):
        padded = np.pad(out, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        before, after = (np.take(padded, np.arange(_CELLS) + shift, axis=axis) for shift in (0, 2))
        out = 0.25 * before + 0.5 * out + 0.25 * after
    return out


def _examples(weight: Floats) -> Floats:
    """The most frequent colours (n, 3) BGR of a histogram (32, 32, 32)."""
    flat = weight.ravel()
    order = np.argsort(flat)[::-1][:_MAX_EXAMPLES]
    order = order[flat[order] > 0.0]
    cells = np.stack(np.unravel_index(order, weight.shape), axis=-1)
    return np.asarray((cells + 0.5) * (256 / _CELLS) - 0.5)
