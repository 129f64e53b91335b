"""Finds one ball of a known colour and measures its centre to a small part of a pixel.

A coarse pass classifies every second pixel by colour; each blob is then measured at full resolution. There the
question is no longer which pixels are the target's but how much of each is: its coverage, from the local colours of
target and background (``outline``), the latter as it was before the target came where the camera stands still
(``scenery``). That is unbiased under motion blur (a smeared ball is where it was on average) and
does not follow the shading, as a centroid of brightness would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from edge.detectors.marker.colour import ColourModel, codes, taught
from edge.detectors.marker.subpixel_outline import Outline, measure_outline
from edge.detectors.moving.static_background import Scenery
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.sphere_projection import outline_to_centre
from protocols.geometry.types import Bools, Floats

REVISION = 4
"""Of what is measured: kept detections of another revision are not this detector's."""
_STEP = 2  # of the coarse pass [px]
_CANDIDATES = 6  # blobs that are measured, largest first
_MIN_AREA = 6.0  # px²: below, colour noise looks like that
_MAX_SHARE = 0.2  # of the image: above, it is a wall
_MIN_SCORE = 0.35
_APART, _APART_SMEARED = 0.6, 0.04  # px between a blob's centroid and its outline's centre: not more, and of its smear
_BLOB_STD, _BLOB_SHARE = 0.25, 0.2  # px: of a blob's centroid where they contradict each other, and of their distance
_BORDER = 1  # px: nearer to the image's border a blob is cut
_BESIDE = 8  # px beside a blob in which it may still be
_NEAR = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * _BESIDE // _STEP + 1, 2 * _BESIDE // _STEP + 1))
_BOX = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class MarkerModel:
    """What the marker looks like: its colour model, and the label its detections carry."""

    colours: ColourModel
    label: str = "marker"

    @classmethod
    def default(cls) -> MarkerModel:
        """The orange ball of the shipped scenes; a matt orange table-tennis ball is near it."""
        return cls.of_colour(246, 112, 22)

    @classmethod
    def of_colour(cls, red: float, green: float, blue: float, label: str = "marker") -> MarkerModel:
        """A matt ball of this sRGB colour (0..255) in full light."""
        return cls(ColourModel.of_hue((blue, green, red)), label)

    def to_table(self) -> dict[str, Any]:
        """As plain values for a TOML table."""
        return {"label": self.label, **self.colours.to_table()}

    @classmethod
    def from_table(cls, table: dict[str, Any]) -> MarkerModel:
        """The inverse of ``to_table``. Raises InputError where the table is no marker model."""
        return cls(ColourModel.from_table(table), str(table.get("label", "marker")))


def teach(image: npt.NDArray[np.uint8], box: tuple[float, float, float, float], label: str = "marker") -> MarkerModel:
    """A model from one picture and a box around the marker in it.

    image: (H, W, 3) BGR. box: x, y (top left), width, height [px]; it may include some background. Pixels inside
    are examples of the target, pixels outside of everything else; colours inside that are common outside
    too are background. Raises InputError where the box leaves the image or holds nothing of its own colour.
    """
    height, width = image.shape[:2]
    x, y, w, h = box
    if not (w >= 2 and h >= 2 and x >= -0.5 and y >= -0.5 and x + w <= width + 0.5 and y + h <= height + 0.5):
        raise InputError(
            f"the box {x:g},{y:g},{w:g},{h:g} does not lie in the {width}x{height} image",
            remedy="give x,y,width,height in pixels, x and y of the top left",
        )
    rows, columns = np.mgrid[:height, :width]

    def within(grow: float) -> Bools:
        across = np.abs(columns - (x + 0.5 * w - 0.5)) < 0.5 * w + grow
        return np.asarray(across & (np.abs(rows - (y + 0.5 * h - 0.5)) < 0.5 * h + grow))

    # A gap between inside and outside: a box is rarely drawn to the pixel.
    return MarkerModel(taught(image, within(0.0), ~within(2.0 + 0.1 * max(w, h))), label)


class MarkerDetector:
    """Finds the marker in the pictures of one camera; of earlier ones it remembers what stands behind the marker.

    model: what it looks like. intrinsics: where given, the centre is corrected from that of the ball's
    outline to the projection of its centre, which differ by perspective and distortion (``outline_to_centre``).
    most: how many blobs at the most are reported, best first; one marker is one.
    min_size, max_size: diameters [px] outside of which a blob is not the marker.
    """

    def __init__(
        self,
        model: MarkerModel | None = None,
        intrinsics: Intrinsics | None = None,
        *,
        most: int = 1,
        min_size: float = 0.0,
        max_size: float = math.inf,
    ) -> None:
        self._model = MarkerModel.default() if model is None else model
        self._table = self._model.colours.table()
        self._intrinsics = intrinsics
        self._most = most
        self._sizes = min_size, max_size
        self._scenery = Scenery()

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        coarse = self._table[codes(image[::_STEP, ::_STEP])]
        if not coarse.any():
            self._learn(image, coarse, [])
            return []
        linked = cv2.dilate(coarse, _BOX)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(linked, connectivity=8)
        pixels = np.bincount(labels[coarse > 0], minlength=count)
        pixels[0] = 0
        found, boxes = [], []
        for index in np.argsort(pixels)[::-1][:_CANDIDATES]:
            if pixels[index] * _STEP * _STEP > _MAX_SHARE * image.shape[0] * image.shape[1] or not pixels[index]:
                continue
            left, top, width, height = (int(value) * _STEP for value in stats[index, :4])
            boxes.append((left, top, width, height))
            detection = self._measure(image, left, top, width, height)
            if detection is not None:
                found.append(detection)
        self._learn(image, coarse, boxes)
        found.sort(key=lambda one: one.score * one.size, reverse=True)
        return found[: self._most]

    def _learn(
        self, image: npt.NDArray[np.uint8], coarse: npt.NDArray[np.uint8], boxes: list[tuple[int, int, int, int]]
    ) -> None:
        """Learn the scenery, but not what is of the marker's colour or near a blob of it."""
        first, end = self._scenery.rows(image)
        top = max((first - _BESIDE) // _STEP, 0)
        near = coarse[top : (end + _BESIDE) // _STEP + 1]
        if near.any():
            near = np.asarray(cv2.dilate(near, _NEAR), dtype=np.uint8)
        free = near[np.arange(first, end) // _STEP - top].repeat(_STEP, axis=1)[:, : image.shape[1]] == 0
        for left, upper, width, height in boxes:
            margin = _BESIDE + (width + height) // 4
            above, below = max(upper - margin - first, 0), max(upper + height + margin - first, 0)
            free[above:below, max(left - margin, 0) : left + width + margin] = False
        self._scenery.learn(image, free)

    def _measure(self, image: npt.NDArray[np.uint8], left: int, top: int, width: int, height: int) -> Detection | None:
        """Measure the blob whose coarse bounding box is given [px]; None where it is no ball."""
        margin = 2 * _STEP
        x0, y0 = max(left - margin, 0), max(top - margin, 0)
        patch = image[y0 : top + height + margin, x0 : left + width + margin]
        mask = _main_blob(self._table[codes(patch)])
        if mask is None:
            return None
        moments = cv2.moments(mask, binaryImage=True)
        area = moments["m00"]
        if area < _MIN_AREA or _at_border(mask, x0, y0, image.shape):
            return None
        first = np.array([x0 + moments["m10"] / area, y0 + moments["m01"] / area])
        outline = measure_outline(image, first, np.sqrt(area / np.pi), self._scenery.of(image))
        if outline is None or not self._sizes[0] <= outline.diameter <= self._sizes[1]:
            return None
        reach = 0.5 * outline.diameter
        size = np.array([image.shape[1], image.shape[0]])
        if (outline.centre < reach).any() or (outline.centre > size - 1 - reach).any():
            return None  # cut by the image's border, it has lost its centre
        score = outline.agreement * _solidity(moments)
        if score < _MIN_SCORE or not 0.5 < area / (np.pi * reach * reach) < 2.0:
            return None
        outline = _unless_contradicted(outline, first, area)
        centre, covariance = outline.centre, outline.covariance
        if self._intrinsics is not None:
            sizes = np.array([outline.diameter])
            centre = outline_to_centre(centre[None], sizes, self._intrinsics)[0]
        blue, green, red = patch[mask > 0].mean(axis=0)
        return Detection(
            u=float(centre[0]),
            v=float(centre[1]),
            size=outline.diameter,
            score=score,
            label=self._model.label,
            colour=(round(float(red)), round(float(green)), round(float(blue))),
            covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
            kind="marker",
        )


def _main_blob(mask: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8] | None:
    """The largest connected part of a mask (h, w), its holes filled (a glint is part of the ball)."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    largest = max(contours, key=len)
    filled = np.zeros_like(mask)
    cv2.drawContours(filled, [largest], -1, 1, thickness=cv2.FILLED)
    return filled


def _unless_contradicted(outline: Outline, first: Floats, area: float) -> Outline:
    """The outline, or, where the blob's centroid ``first`` (2,) contradicts it, the blob's centre and size.

    The two err differently: a centroid of pixels of the marker's colour is coarse, but does not take a red ball that
    touches an orange one for a part of it. Where they are far apart, the outline followed something else.
    """
    away = float(np.hypot(*(outline.centre - first)))
    if away < _APART + _APART_SMEARED * outline.smear:
        return outline
    variance = _BLOB_STD**2 + (_BLOB_SHARE * away) ** 2
    return replace(
        outline,
        centre=first,
        diameter=math.sqrt(4.0 * area / math.pi),
        covariance=outline.covariance + variance * np.eye(2),
    )


def _at_border(mask: npt.NDArray[np.uint8], left: int, top: int, shape: tuple[int, ...]) -> bool:
    """Whether a blob (h, w) at (left, top) of an image reaches its border: what is left of a ball there can look like
    a smaller, whole one."""
    x, y, width, height = cv2.boundingRect(mask)
    x, y = x + left, y + top
    return x < _BORDER or y < _BORDER or x + width > shape[1] - _BORDER or y + height > shape[0] - _BORDER


def _solidity(moments: dict[str, float]) -> float:
    """How well a blob fills the ellipse of its own second moments, 0..1; 1 for discs and smeared discs."""
    area = moments["m00"]
    spread = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / area
    ellipse = 4.0 * np.pi * np.sqrt(np.linalg.det(spread + np.eye(2) / 12.0))
    return float(min(area / ellipse, 1.0))
