"""Detection of one ball of a known colour, with sub-pixel centre and covariance.

A coarse pass classifies every second pixel by colour; each blob is then measured at full resolution. There the coverage
of each pixel by the ball is estimated from the local colours of ball and background (``subpixel_outline``), the latter
as seen before the ball came where the camera is static (``static_background``). Coverage is unbiased under motion blur
(a smeared ball is measured at its mean position) and independent of shading, unlike a centroid of brightness.
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
from edge.detectors.marker.colour import ColourModel, colour_indices, learn_colour_model
from edge.detectors.marker.static_background import StaticBackground
from edge.detectors.marker.subpixel_outline import Outline, measure_outline
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics, outline_to_centre
from protocols.geometry.types import Bools, Floats

_FLOOD_TOLERANCE = (26, 18, 18)  # tolerance of the flood fill in CIE L*a*b* (0..255): light and shade of a ball
_MIN_PIXELS = 9  # pixels
_STEP = 2  # of the coarse pass [px]
_CANDIDATES = 6  # blobs that are measured, largest first
_MIN_AREA = 6.0  # px²: smaller blobs may be colour noise
_MAX_SHARE = 0.2  # share of the image: larger blobs are walls
_MIN_SCORE = 0.35  # agreement of the outline times solidity: below it, blobs are no discs
# px: largest distance of a blob's centroid from its outline's centre, plus this share of its smear
_MAX_DISTANCE, _MAX_DISTANCE_SMEAR = 0.6, 0.04
# px: std of a blob's centroid where the two contradict, plus this share of their distance
_BLOB_STD, _BLOB_SHARE = 0.25, 0.2
_BORDER = 1  # px: a blob nearer to the image border is truncated
_MARKER_MARGIN = 8  # px around a blob that may still belong to it
_MARGIN_KERNEL = cv2.getStructuringElement(
    cv2.MORPH_RECT, (2 * _MARKER_MARGIN // _STEP + 1, 2 * _MARKER_MARGIN // _STEP + 1)
)
_LINK_KERNEL = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))


class InteractiveMarkerDetector:
    """A ball detector whose marker model may be replaced from another thread between two images."""

    def __init__(self, intrinsics: Intrinsics | None = None, model: MarkerModel | None = None) -> None:
        self._intrinsics = intrinsics
        self._detector = MarkerDetector(model, intrinsics)

    def set_model(self, model: MarkerModel) -> None:
        """Detect this marker from the next image on."""
        self._detector = MarkerDetector(model, self._intrinsics)

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        return self._detector.detect(image)


def learn_marker_at(image: npt.NDArray[np.uint8], u: float, v: float) -> tuple[MarkerModel, tuple[int, int, int, int]]:
    """Learn a model of the object at a point (u, v) [px] of an image (H, W, 3) BGR, and its box (x, y, w, h).

    The region of about one colour around the point is taken for the marker. Raises InputError where that is no separate
    region: a wall, or single pixels.
    """
    height, width = image.shape[:2]
    column, row = round(u), round(v)
    if not (0 <= column < width and 0 <= row < height):
        raise InputError("that is not in the picture", remedy="click on the ball")
    smooth = cv2.cvtColor(cv2.medianBlur(image, 5), cv2.COLOR_BGR2LAB)
    mask = np.zeros((height + 2, width + 2), dtype=np.uint8)
    flags = 8 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    count, _, _, (x, y, w, h) = cv2.floodFill(
        smooth, mask, (column, row), (0, 0, 0), _FLOOD_TOLERANCE, _FLOOD_TOLERANCE, flags
    )
    if not _MIN_PIXELS <= count <= _MAX_SHARE * width * height:
        what = "too small" if count < _MIN_PIXELS else "as large as a wall"
        remedy = "click on the middle of the ball, with some background of another colour around it"
        raise InputError(f"what is there is {what} ({count} pixels of one colour)", remedy=remedy)
    left, top = max(x - 1, 0), max(y - 1, 0)
    box = (left, top, min(w + 2, width - left), min(h + 2, height - top))
    return learn_marker_model(image, box), box


@dataclass(frozen=True, slots=True, eq=False)
class MarkerModel:
    """Appearance of the marker: its colour model, and the label of its detections."""

    colours: ColourModel
    label: str = "marker"

    @classmethod
    def default(cls) -> MarkerModel:
        """The orange ball of the shipped scenes; a matt orange table-tennis ball is similar."""
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


def learn_marker_model(image: npt.NDArray[np.uint8], box: tuple[float, float, float, float]) -> MarkerModel:
    """Learn a model from one image and a box around the marker in it.

    image: (H, W, 3) BGR. box: x, y (top left), width, height [px]; it may include some background. Pixels inside are
    examples of the target, pixels outside of everything else; colours inside that are also common outside are
    background. Raises InputError where the box leaves the image or contains no colour of its own.
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

    # A gap between inside and outside, because boxes are drawn inaccurately.
    return MarkerModel(learn_colour_model(image, within(0.0), ~within(2.0 + 0.1 * max(w, h))), "marker")


class MarkerDetector:
    """Detects the one marker in the images of one camera; of earlier images it keeps the background behind it.

    model: appearance of the marker. intrinsics: where given, the centre of the ball's outline is corrected to the
    projection of the ball's centre; they differ by perspective and distortion (``outline_to_centre``). min_size,
    max_size: limits of the diameter [px].
    """

    def __init__(
        self,
        model: MarkerModel | None = None,
        intrinsics: Intrinsics | None = None,
        *,
        min_size: float = 0.0,
        max_size: float = math.inf,
    ) -> None:
        self._model = MarkerModel.default() if model is None else model
        self._table = self._model.colours.table()
        self._intrinsics = intrinsics
        self._sizes = min_size, max_size
        self._background = StaticBackground()

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        coarse = self._table[colour_indices(image[::_STEP, ::_STEP])]
        if not coarse.any():
            self._update_background(image, coarse, [])
            return []
        linked = cv2.dilate(coarse, _LINK_KERNEL)
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
        self._update_background(image, coarse, boxes)
        return [max(found, key=lambda one: one.score * one.size)] if found else []

    def _update_background(
        self, image: npt.NDArray[np.uint8], coarse: npt.NDArray[np.uint8], boxes: list[tuple[int, int, int, int]]
    ) -> None:
        """Learn the background, except pixels of the marker's colour or near a blob of it."""
        first, end = self._background.next_rows(image)
        top = max((first - _MARKER_MARGIN) // _STEP, 0)
        near = coarse[top : (end + _MARKER_MARGIN) // _STEP + 1]
        if near.any():
            near = np.asarray(cv2.dilate(near, _MARGIN_KERNEL), dtype=np.uint8)
        free = near[np.arange(first, end) // _STEP - top].repeat(_STEP, axis=1)[:, : image.shape[1]] == 0
        for left, upper, width, height in boxes:
            margin = _MARKER_MARGIN + (width + height) // 4
            above, below = max(upper - margin - first, 0), max(upper + height + margin - first, 0)
            free[above:below, max(left - margin, 0) : left + width + margin] = False
        self._background.update(image, free)

    def _measure(self, image: npt.NDArray[np.uint8], left: int, top: int, width: int, height: int) -> Detection | None:
        """Measure the blob in a coarse bounding box [px]; None where it is no ball."""
        margin = 2 * _STEP
        x0, y0 = max(left - margin, 0), max(top - margin, 0)
        patch = image[y0 : top + height + margin, x0 : left + width + margin]
        mask = _main_blob(self._table[colour_indices(patch)])
        if mask is None:
            return None
        moments = cv2.moments(mask, binaryImage=True)
        area = moments["m00"]
        if area < _MIN_AREA or _at_border(mask, x0, y0, image.shape):
            return None
        first = np.array([x0 + moments["m10"] / area, y0 + moments["m01"] / area])
        outline = measure_outline(image, first, np.sqrt(area / np.pi), self._background.lookup(image))
        if outline is None or not self._sizes[0] <= outline.diameter <= self._sizes[1]:
            return None
        reach = 0.5 * outline.diameter
        size = np.array([image.shape[1], image.shape[0]])
        if (outline.centre < reach).any() or (outline.centre > size - 1 - reach).any():
            return None  # truncated by the image border, its centre is unknown
        score = outline.agreement * _solidity(moments)
        if score < _MIN_SCORE or not 0.5 < area / (np.pi * reach * reach) < 2.0:
            return None
        outline = _checked_by_centroid(outline, first, area)
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
    """The largest connected component of a mask (h, w) with holes filled (a highlight is part of the ball)."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    largest = max(contours, key=len)
    filled = np.zeros_like(mask)
    cv2.drawContours(filled, [largest], -1, 1, thickness=cv2.FILLED)
    return filled


def _checked_by_centroid(outline: Outline, first: Floats, area: float) -> Outline:
    """The outline, or, where it is far from the blob's centroid ``first`` (2,), the blob's centre and size.

    Their errors have different causes: a centroid of pixels of the marker's colour is coarse, but does not include a
    red ball that touches an orange one. Where they are far apart, the outline followed another object.
    """
    away = float(np.hypot(*(outline.centre - first)))
    if away < _MAX_DISTANCE + _MAX_DISTANCE_SMEAR * outline.smear:
        return outline
    variance = _BLOB_STD**2 + (_BLOB_SHARE * away) ** 2
    return replace(
        outline,
        centre=first,
        diameter=math.sqrt(4.0 * area / math.pi),
        covariance=outline.covariance + variance * np.eye(2),
    )


def _at_border(mask: npt.NDArray[np.uint8], left: int, top: int, shape: tuple[int, ...]) -> bool:
    """Whether a blob (h, w) at (left, top) reaches the image border: a truncated ball can look like a smaller whole
    one.
    """
    x, y, width, height = cv2.boundingRect(mask)
    x, y = x + left, y + top
    return x < _BORDER or y < _BORDER or x + width > shape[1] - _BORDER or y + height > shape[0] - _BORDER


def _solidity(moments: dict[str, float]) -> float:
    """Area of a blob over that of the ellipse of its second moments, 0..1; 1 for discs and smeared discs."""
    area = moments["m00"]
    spread = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / area
    ellipse = 4.0 * np.pi * np.sqrt(np.linalg.det(spread + np.eye(2) / 12.0))
    return float(min(area / ellipse, 1.0))
