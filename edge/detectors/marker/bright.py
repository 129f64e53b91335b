"""Detection of a point of light: an LED, or a retro-reflector beside the camera's lamp.

Candidates are bright blobs; a point of light is small, compact and isolated on a much darker background. Its position
is the centroid of the excess over the background. That is the mean position during the exposure, so that a smeared spot
is measured at mid-exposure; clipping at white is symmetric and does not move it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from protocols.geometry.types import Floats

_CANDIDATES = 12  # blobs that are measured, largest first
_MOST_BLOBS = 2000  # an image with more is overexposed or noise
_RING = 3.0  # px: width of the ring around a spot that gives its background,
_PASSES = 2  # the second measures within the first's ellipse
_HALF_HEIGHT = 0.5  # share of the contrast: brighter pixels belong to the spot
_WHITE = 250.0  # grey level at which a sensor clips
_CUT = 0.3  # share of the contrast: fainter pixels are background and its texture
_GAP = 1.5  # px: beyond this gap for the spot's own fringe
_LEAST_RING = 8  # px that fix a plane with some to spare
_MIN_CONTRAST = 80.0  # grey levels above the background
_MAX_ASPECT = 6.0  # length over width of a smeared spot
_MAX_FLARE = 0.35  # share of the contrast: largest excess of the ring over the surround
_SURROUND_PX = 6.0  # px: width of the surround
_FLOOR_PX = 0.02  # px: std of the centre without noise, because pixels are unequal and have blind gaps
# px: for narrower spots, over this step, that std doubles
_NARROW_PX, _NARROW_STEP = 4.0, 0.5
_PIXEL_GAIN_STD = 0.02  # share of the contrast: pixel gain variation and speckle
_SENSOR_STD = 4.0  # grey levels: largest std of the sensor noise
_TEXTURE_AREA = 16.0  # px²: correlation area of background texture
_PLANE_WIDTH = 8.0  # px: behind narrower spots a plane follows the texture
_QUANTUM = 1.0 / 12.0  # variance of rounding to whole grey levels


@dataclass(frozen=True, slots=True)
class BrightModel:
    """Appearance of a point of light.

    threshold: grey level (0..255, of the brightest channel) that it exceeds. min_size, max_size: diameter [px] of the
    pixels above the threshold. label: of its detections. max_detections: best ones reported at most.
    """

    threshold: int = 200
    min_size: float = 0.0
    max_size: float = 60.0
    label: str = "marker"
    max_detections: int = 1


class BrightDetector:
    """Detects points of light in single images; keeps no state."""

    def __init__(self, model: BrightModel | None = None) -> None:
        self._model = BrightModel() if model is None else model

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        level = _brightest(image)
        _, mask = cv2.threshold(level, float(self._model.threshold), 255.0, cv2.THRESH_BINARY)
        if not cv2.countNonZero(mask):
            return []
        count, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        if count > _MOST_BLOBS:
            return []
        found = []
        for index in _candidates(np.asarray(stats, dtype=np.int32), self._model):
            left, top, width, height = (int(value) for value in stats[index, :4])
            spot = self._measure(image, level, left, top, width, height)
            if spot is not None:
                found.append(spot)
        found.sort(key=lambda one: one.score, reverse=True)
        return found[: self._model.max_detections]

    def _measure(
        self, image: npt.NDArray[np.uint8], level: npt.NDArray[np.uint8], left: int, top: int, w: int, h: int
    ) -> Detection | None:
        """Measure the blob in a box [px]; None where it is no point of light."""
        margin = math.ceil(0.75 * max(w, h) + 2.0 * (_GAP + _RING))
        x0, y0, x1, y1 = left - margin, top - margin, left + w + margin, top + h + margin
        if x0 < 0 or y0 < 0 or x1 > level.shape[1] or y1 > level.shape[0]:
            return None  # truncated by the border, or so near to it that its background is unknown
        brightest = level[y0:y1, x0:x1]
        channels = np.moveaxis(image[y0:y1, x0:x1].astype(np.float64), 2, 0)
        y, x = np.mgrid[: brightest.shape[0], : brightest.shape[1]].astype(np.float64)
        own = _blob_at(brightest > self._model.threshold, margin, w, h)
        for _ in range(_PASSES):
            shape = _Ellipse.of(own, x, y)
            if shape.aspect > _MAX_ASPECT:
                return None
            distance = shape.distance(x, y)
            edge = _GAP + 0.25 * shape.width
            ring = (distance > edge) & (distance <= edge + _RING)
            inside = distance <= edge
            if np.count_nonzero(ring) < _LEAST_RING:
                return None  # fills the image: nothing around it to measure it against
            background = np.stack([_background_plane(channel, x, y, ring) for channel in channels])
            residual = channels - background
            # Channels are weighted by the light's excess in them, because their background errors are independent.
            peaks = np.maximum(residual[:, inside].max(axis=1), 0.0)
            share = peaks / max(float(peaks.sum()), 1e-9)
            contrast = float(share @ peaks)
            if contrast < _MIN_CONTRAST:
                return None
            # The threshold truncates a smeared spot arbitrarily; its half height is symmetric.
            light = np.tensordot(share, residual, axes=1)
            own = _blob_at((light > _HALF_HEIGHT * contrast) & (distance <= edge + _RING), margin, w, h)
            if not own.any():
                return None
        # Texture counts as noise, outliers included: its continuation behind the spot is unknown.
        noise = float(np.sqrt(np.mean(light[ring] ** 2)))
        # A clipped channel is uniform; less its background it would shift the centroid to where that is darker.
        flat = np.where(channels[:, inside].max(axis=1) >= _WHITE, _WHITE - background[:, inside].max(axis=1), np.inf)
        above = np.where(inside, np.tensordot(share, np.minimum(residual, flat[:, None, None]), axes=1), 0.0)
        excess = np.maximum(above - _CUT * float(above.max()), 0.0)
        mass = float(excess.sum())
        if mass <= 0.0:
            return None
        # Rejects a lamp behind glass or a window's corner: the ring of a point of light is as dark as its surround.
        around = float(np.median(brightest[ring]))
        if _surrounding_level(level, x0, y0, x1, y1) < around - _MAX_FLARE * contrast:
            return None
        if float((brightest[ring] > self._model.threshold).mean()) > 0.02:
            return None  # part of a larger object
        area = int(own.sum())
        u, v = float((excess * x).sum() / mass), float((excess * y).sum() / mass)
        size = 2.0 * math.sqrt(area / math.pi)
        fill = area / max(_Ellipse.of(own, x, y).area, 1e-9)
        if fill < 0.6:
            return None
        colour = cv2.mean(image[y0:y1, x0:x1], own.astype(np.uint8))
        return Detection(
            u=x0 + u,
            v=y0 + v,
            size=size,
            score=float(np.clip(contrast / 255.0, 0.0, 1.0) * min(fill, 1.0)),
            label=self._model.label,
            colour=(round(colour[2]), round(colour[1]), round(colour[0])),
            covariance=_covariance(
                excess, ring, x - u, y - v, mass, noise, _SENSOR_STD * float(np.linalg.norm(share)), shape.width
            ),
            kind="marker",
        )


@dataclass(frozen=True, slots=True)
class _Ellipse:
    """Ellipse of a blob's second moments: centre [px], axes (2, 2) as rows, half-lengths (2,) [px], longest first."""

    centre: Floats
    axes: Floats
    half: Floats

    @classmethod
    def of(cls, mask: npt.NDArray[np.bool_], x: Floats, y: Floats) -> _Ellipse:
        points = np.stack([x[mask], y[mask]])
        centre = points.mean(axis=1)
        spread = (points - centre[:, None]) @ (points - centre[:, None]).T / points.shape[1] + np.eye(2) / 12.0
        values, vectors = np.linalg.eigh(spread)
        return cls(centre, vectors.T[::-1], 2.0 * np.sqrt(values[::-1]))

    @property
    def aspect(self) -> float:
        return float(self.half[0] / self.half[1])

    @property
    def width(self) -> float:
        """Across a smear [px]."""
        return float(2.0 * self.half[1])

    @property
    def area(self) -> float:
        return float(math.pi * self.half[0] * self.half[1])

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Distance from the ellipse, negative inside [px]; of a long one, from a capsule around its axis."""
        along, across = np.tensordot(self.axes, np.stack([x - self.centre[0], y - self.centre[1]]), axes=1)
        beyond = np.maximum(np.abs(along) - (self.half[0] - self.half[1]), 0.0)
        return np.asarray(np.hypot(beyond, across) - self.half[1])


def _brightest(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The brightest channel (H, W), so that a blue LED is bright too."""
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8)


def _candidates(stats: npt.NDArray[np.int32], model: BrightModel) -> list[int]:
    """Indices of blobs that are small and compact enough to be measured, largest first."""
    area = stats[:, 4].astype(np.float64)
    diameter = 2.0 * np.sqrt(area / np.pi)
    good = (diameter >= model.min_size) & (diameter <= model.max_size)
    good &= np.maximum(stats[:, 2], stats[:, 3]) <= _MAX_ASPECT * model.max_size
    good[0] = False
    order = np.argsort(-area)
    return [int(index) for index in order if good[index]][:_CANDIDATES]


def _blob_at(mask: npt.NDArray[np.bool_], margin: int, w: int, h: int) -> npt.NDArray[np.bool_]:
    """Connected components of a mask that reach into the box (w, h) at ``margin`` from its corner."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    touched = np.zeros(count, dtype=bool)
    touched[labels[margin : margin + h, margin : margin + w].ravel()] = True
    touched[0] = False
    return np.asarray(touched[labels], dtype=np.bool_)


def _background_plane(patch: Floats, x: Floats, y: Floats, ring: npt.NDArray[np.bool_]) -> Floats:
    """Background (h, w) of a patch: a robust plane fit to its ring."""
    basis = np.stack([np.ones(int(ring.sum())), x[ring] - x.mean(), y[ring] - y.mean()], axis=1)
    values = patch[ring]
    weight = np.ones_like(values)
    model = np.zeros(3)
    for _ in range(4):
        weighted = basis * weight[:, None]
        model = np.linalg.solve(weighted.T @ basis + 1e-6 * np.eye(3), weighted.T @ values)
        residual = values - basis @ model
        scale = 1.4826 * float(np.median(np.abs(residual))) + 0.3
        weight = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2) ** 2
    return np.asarray(model[0] + model[1] * (x - x.mean()) + model[2] * (y - y.mean()))


def _surrounding_level(level: npt.NDArray[np.uint8], x0: int, y0: int, x1: int, y1: int) -> float:
    """Median of a border some pixels wide around a patch, within the image."""
    wide = math.ceil(_SURROUND_PX)
    top, bottom = max(y0 - wide, 0), min(y1 + wide, level.shape[0])
    left, right = max(x0 - wide, 0), min(x1 + wide, level.shape[1])
    parts = [level[top:y0, left:right], level[y1:bottom, left:right], level[y0:y1, left:x0], level[y0:y1, x1:right]]
    values = np.concatenate([part.ravel() for part in parts])
    return float(np.median(values)) if values.size else 0.0


def _covariance(
    excess: Floats,
    ring: npt.NDArray[np.bool_],
    x: Floats,
    y: Floats,
    mass: float,
    noise: float,
    sensor: float,
    width: float,
) -> tuple[float, float, float]:
    """(uu, uv, vv) [px²] of a centroid; x, y: of each pixel from it. sensor: the part of ``noise`` that is no texture.
    width: of the spot [px].

    Grey-level errors are independent per pixel and move the centroid by the pixel's distance from it; the background's
    error is that of the fitted plane and moves it by the sum of all distances.
    """
    # Scatter of the ring beyond the sensor noise is texture, which is correlated over patches. What a plane misses of
    # it grows with the square of the width that it spans.
    texture = max(noise * noise - sensor**2, 0.0) * min(1.0, (width / _PLANE_WIDTH) ** 4)
    patchy = noise * noise + (_TEXTURE_AREA - 1.0) * texture
    variance = patchy + _QUANTUM + (_PIXEL_GAIN_STD * np.abs(excess)) ** 2
    arms = np.stack([x, y]) * (excess > 0.0) / mass
    own = np.einsum("ahw,bhw,hw->ab", arms, arms, variance)
    basis = np.stack([np.ones_like(x), x, y])
    of_ring = np.einsum("ahw,bhw,hw->ab", basis, basis, ring.astype(np.float64))
    lever = np.einsum("ahw,bhw->ab", arms, basis)
    plane = lever @ np.linalg.pinv(of_ring, hermitian=True) @ lever.T * (patchy + _QUANTUM)
    floor = _FLOOR_PX * (1.0 + float(np.clip((_NARROW_PX - width) / _NARROW_STEP, 0.0, 1.0)))
    total = own + plane + floor**2 * np.eye(2)
    return float(total[0, 0]), float(total[0, 1]), float(total[1, 1])
