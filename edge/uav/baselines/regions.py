"""Section 4.1: road, building and other regions by colour, corrected by the road model; existence map (4.1-4.9)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Box
from edge.uav.baselines.road import RoadCourse
from protocols.geometry.types import Bools, Floats, Image

Labels = npt.NDArray[np.uint8]

BUILDING, ROAD, OTHER = 0, 1, 2  # classes of the map
COLOURS = np.array([[0, 0, 255], [255, 0, 0], [0, 255, 0]], dtype=np.uint8)
"""BGR of the labels as in (4.7) to (4.9)."""
EXISTENCE = np.array([0.1, 1.0, 0.8], dtype=np.float32)
"""Second eq. (4.9): probability of a car on a building, on the road, elsewhere."""
SCALE = 4
"""Regions are classified at a quarter of the resolution."""
_CHI_SQUARE_GATE = 11.34  # chi-square of three bands, 99 %
_MIN_VARIANCE = 16.0  # grey levels squared
_UPDATE_RATE = 0.03  # a frame
_SIDEWALK_REACH = 1.5  # half widths: building labels this near to the road are taken for sidewalk
_MARGIN = 0.75  # of the image size: extent of the map beyond each border


@dataclass(frozen=True, slots=True, eq=False)
class RegionStatistics:
    """Eqs. (4.1) to (4.4): means (3,) and variances (3,) of the bands B, G, R of road and other, grey levels."""

    road_mean: Floats
    road_variance: Floats
    other_mean: Floats
    other_variance: Floats

    def adapted(self, image: Image, labels: Labels, road_core: Bools) -> RegionStatistics:
        """Exponential update from this frame's pixels within the road model and its pixels labelled other."""
        changed = self
        if road_core.sum() > 50:
            mean, variance = _statistics(image[road_core])
            changed = replace(
                changed,
                road_mean=self.road_mean + _UPDATE_RATE * (mean - self.road_mean),
                road_variance=self.road_variance + _UPDATE_RATE * (variance - self.road_variance),
            )
        other = (labels == OTHER) & ~road_core
        if other.sum() > 50:
            # Its variance is kept: the gate truncates the distribution, which would bias it.
            moved = self.other_mean + _UPDATE_RATE * (_statistics(image[other])[0] - self.other_mean)
            changed = replace(changed, other_mean=moved)
        return changed


def reduced(image: Image) -> Image:
    """The image at the resolution of the region labels."""
    return np.asarray(
        cv2.resize(image, (image.shape[1] // SCALE, image.shape[0] // SCALE), interpolation=cv2.INTER_AREA),
        dtype=np.uint8,
    )


def learn_statistics(small: Image, road: Bools) -> RegionStatistics:
    """Statistics from the first frame: small: reduced image; road (h/4, w/4): mask of the road model.

    Other: the largest of three k-means clusters among the pixels that do not have the road's colour.
    """
    road_mean, road_variance = _statistics(small[road])
    rest = small.reshape(-1, 3).astype(np.float64)
    rest = rest[(np.square(rest - road_mean) / road_variance).sum(axis=1) > _CHI_SQUARE_GATE]
    if len(rest) < 50:
        return RegionStatistics(road_mean, road_variance, 255.0 - road_mean, np.full(3, _MIN_VARIANCE))
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 10, 1.0)
    kind = np.zeros((len(rest), 1), dtype=np.int32)
    kind[:, 0] = np.argsort(np.argsort(rest.sum(axis=1))) * 3 // len(rest)
    _, found, _ = cv2.kmeans(rest.astype(np.float32), 3, kind, criteria, 1, cv2.KMEANS_USE_INITIAL_LABELS)
    kinds = np.asarray(found).ravel().astype(np.int64)
    commonest = int(np.bincount(kinds, minlength=3).argmax())
    return RegionStatistics(road_mean, road_variance, *_statistics(rest[kinds == commonest]))


def band_distances(
    pixels: Floats | npt.NDArray[np.float32], mean: Floats, variance: Floats
) -> npt.NDArray[np.floating]:
    """Eqs. (4.5), (4.6): squared standardised distance of pixels (..., 3) to a mean (3,), variances (3,) -> (...)."""
    difference = pixels - mean.astype(pixels.dtype)
    return np.asarray((difference * difference) @ (1.0 / variance).astype(pixels.dtype))


def classify(small: Image, statistics: RegionStatistics) -> Labels:
    """Eqs. (4.7) to first (4.9): road, other, or building where it is neither; (h, w, 3) -> (h, w).

    Deviation: printed as d^2 < s^2, which compares a dimensionless number with grey levels squared. Here d^2 is
    gated by the chi-square quantile of three bands (99 %); where both pass, the nearer one is chosen.
    """
    pixels = small.astype(np.float32)
    road = band_distances(pixels, statistics.road_mean, statistics.road_variance)
    other = band_distances(pixels, statistics.other_mean, statistics.other_variance)
    labels = np.where(other < road, OTHER, ROAD)
    return np.where(np.minimum(road, other) < _CHI_SQUARE_GATE, labels, BUILDING).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class ExistenceMap:
    """Existence probability of a car, also beyond the image.

    mean: (h, w) float32, existence probability averaged over the target's box. origin: (2,) image pixel of mean[0, 0].
    """

    mean: npt.NDArray[np.float32]
    origin: Floats

    def log_likelihood(self, positions: Floats) -> Floats:
        """p(x_k) of section 4.3: logarithm (n,) of the mean existence probability of boxes about positions (n, 2)."""
        height, width = self.mean.shape
        index = np.rint((positions - self.origin) / SCALE)
        x = np.clip(index[:, 0], 0, width - 1).astype(np.int64)
        y = np.clip(index[:, 1], 0, height - 1).astype(np.int64)
        return np.log(self.mean[y, x].astype(np.float64))


def road_mask(course: RoadCourse, shape: tuple[int, int], origin: Floats, widths: float, known: bool = False) -> Bools:
    """(h, w) of a map of that shape at a quarter resolution: pixels within ``widths`` half widths of the course.

    origin: (2,) image pixel of [0, 0]. known: without the extrapolated part.
    """
    mask = np.zeros(shape, dtype=np.uint8)
    points = course.points[course.known] if known else course.points
    line = np.rint((points - origin) / SCALE * 16.0).astype(np.int32)
    thickness = max(round(2.0 * widths * course.half_width / SCALE), 1)
    cv2.polylines(mask, [line.reshape(-1, 1, 2)], False, 1, thickness, cv2.LINE_8, 4)
    return np.asarray(mask > 0)


def corrected(labels: Labels, course: RoadCourse | None) -> Labels:
    """Section 4.1: within the road model all is road; building beside it is sidewalk and counts as road too."""
    if course is None:
        return labels
    at = np.zeros(2)
    result = np.where(road_mask(course, labels.shape, at, 1.0, known=True), ROAD, labels)
    beside = road_mask(course, labels.shape, at, _SIDEWALK_REACH, known=True) & (labels == BUILDING)
    return np.where(beside, ROAD, result).astype(np.uint8)


def existence(labels: Labels, course: RoadCourse | None, box: Box) -> ExistenceMap:
    """Second eq. (4.9), extended beyond the image and averaged over boxes of box's size.

    Section 4.3: beyond the border, building and other are replicated from the border pixels; the road there is the
    extrapolated spline, and road pixels at the border are not replicated.
    """
    height, width = labels.shape
    wide, high = round(_MARGIN * width), round(_MARGIN * height)
    # Replicating road pixels would smear the road outwards; only the spline extends it.
    outward = labels if course is None else np.where(labels == ROAD, OTHER, labels).astype(np.uint8)
    padded = cv2.copyMakeBorder(outward, high, high, wide, wide, cv2.BORDER_REPLICATE)
    padded[high : high + height, wide : wide + width] = labels
    origin = np.array([-wide, -high], dtype=np.float64) * SCALE
    if course is not None:
        beyond = road_mask(course, (height + 2 * high, width + 2 * wide), origin, 1.0)
        beyond[high : high + height, wide : wide + width] = False
        padded[beyond] = ROAD
    probability = EXISTENCE[padded]
    window = (max(round(box.width / SCALE), 1), max(round(box.height / SCALE), 1))
    return ExistenceMap(np.asarray(cv2.blur(probability, window), dtype=np.float32), origin)


def _statistics(pixels: npt.NDArray[np.generic]) -> tuple[Floats, Floats]:
    """Mean (3,) and variance (3,) of pixels (n, 3), robust (median, MAD) to markings and cars on the road."""
    flat = pixels.reshape(-1, 3)
    values = flat[:: max(len(flat) // 800, 1)].astype(np.float64)
    middle = np.median(values, axis=0)
    deviation = 1.4826 * np.median(np.abs(values - middle), axis=0)
    return middle, np.maximum(np.square(deviation), _MIN_VARIANCE)
