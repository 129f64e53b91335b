"""Detection of AprilTag and ArUco tags by OpenCV, with sub-pixel centre and covariance.

OpenCV detects and decodes them. Each of the four sides is then measured again: across the black border, at many places
along it, the dark length gives the edge without a threshold and without bias by uniform motion blur. A line is fitted
to each side; the diagonals of the four corners intersect in the projection of the tag's centre, also at oblique view,
which the mean of the corners does not. The scatter about the lines gives the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

DICTIONARIES = (
    "apriltag_16h5", "apriltag_25h9", "apriltag_36h10", "apriltag_36h11",
    "4x4_50", "4x4_100", "4x4_250", "4x4_1000", "5x5_50", "5x5_100", "5x5_250", "5x5_1000",
    "6x6_50", "6x6_100", "6x6_250", "6x6_1000", "7x7_50", "7x7_100", "7x7_250", "7x7_1000",
)  # fmt: skip
"""Families of tags, by OpenCV's names."""
_SIDE_START, _SIDE_END = 0.12, 0.88  # part of a side that is measured: corners are mixtures of two sides
_PASSES = 3  # each refines the sides that the last has found
_REACH = 0.07  # over the tag's size, on both sides of its border: beyond the middle of a cell other cells smear in
_STEP = 0.5  # px across a side
_LEAST_CONTRAST = 20.0  # grey levels between the border and the margin
_MIN_SIDE = 8.0  # px
_BENT_PX = 1.0  # middle of a side off its chord, from which a parabola misses the corners by as much as ArUco does
_MAX_SCATTER = 0.12  # over the side: largest scatter about its line
_FLOOR_PX = 0.004  # px: std of the centre without noise,
_FLOOR_SIDE = 0.3  # plus this [px²] over the side: of a small tag neither black nor white is seen pure,
_FLOOR_SMEAR = 0.003  # plus this share of a smeared border's width;
# share of the profile that a border fills, above which neither black nor white is seen pure;
_PROFILE_FILL, _PROFILE_FILL_STEP = 0.68, 0.05
_FLOOR_FULL = 0.1  # each step adds this share of its width to the std;
_FLOOR_CONTRAST = 0.12  # std over the half profile, per relative loss of a side's contrast against the best of the four
_SHARP = 2.0  # px: width of a sharp border after lens and sampling
_CORRELATION_PX = 1.5  # px: correlation length of samples along a side


@dataclass(frozen=True, slots=True)
class TagModel:
    """Which tags are detected.

    dictionary: one of DICTIONARIES. prefix: detections are labelled by it and the tag's number, as in tag7. min_size:
    px of a side. max_detections: largest ones reported at most.
    """

    dictionary: str = "apriltag_36h11"
    prefix: str = "tag"
    min_size: float = _MIN_SIDE
    max_detections: int = 64


class TagDetector:
    """Detects tags in single images; keeps no state. Raises InputError for an unknown dictionary."""

    def __init__(self, model: TagModel | None = None) -> None:
        self._model = TagModel() if model is None else model
        self._detector = _detector(self._model.dictionary)

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Detections in an image (H, W, 3) uint8 BGR, largest first."""
        if min(image.shape[:2]) < 2 * _MIN_SIDE:
            return []
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        corners, ids, _ = self._detector.detectMarkers(grey)
        found = []
        for quad, number in zip(corners, () if ids is None else np.ravel(ids), strict=True):
            one = self._measure(grey, np.asarray(quad, dtype=np.float64).reshape(4, 2), int(number))
            if one is not None:
                found.append(one)
        found.sort(key=lambda one: one.size, reverse=True)
        return found[: self._model.max_detections]

    def _measure(self, grey: npt.NDArray[np.uint8], quad: Floats, number: int) -> Detection | None:
        sides = _measure_sides(grey, quad)
        if sides is None:
            return None
        lines, covariances, contrast, scatter, width, blur_std, _ = sides
        corners = _corners(lines)
        if corners is None or _far(corners, quad):
            return None
        centre, size = _centre(corners)
        if size < self._model.min_size or scatter > _MAX_SCATTER * size:
            return None
        floor = _FLOOR_PX**2 + (_FLOOR_SIDE / size) ** 2 + (_FLOOR_SMEAR * max(width - _SHARP, 0.0)) ** 2 + blur_std**2
        covariance = _centre_covariance(lines, covariances) + floor * np.eye(2)
        left, top = corners.min(axis=0)
        right, bottom = corners.max(axis=0)
        return Detection(
            u=float(centre[0]),
            v=float(centre[1]),
            size=size,
            score=float(np.clip(contrast / 128.0, 0.05, 1.0)),
            label=f"{self._model.prefix}{number}",
            covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
            kind="marker",
            box=(float(left), float(top), float(right - left), float(bottom - top)),
        )


def refined_corners(grey: npt.NDArray[np.uint8], quad: Floats) -> Floats:
    """The corners (4, 2) [px] where a tag's four sides meet; ``quad`` where these cannot be measured.

    ArUco's own are 0.2 to 0.3 px inside the tag, as smoothing rounds a corner off: sides of 20 px are 2 % too short.
    Sides are parabolas, for the lens bends them; those that it bends more are not.
    """
    sides = _measure_sides(grey, quad)
    ends, starts = np.zeros((4, 2, 2)), np.zeros((4, 2, 2))  # tangents, as lines
    for index, (point, half, outward, places, offset) in enumerate(() if sides is None else sides[-1]):
        x = places / np.linalg.norm(half)
        curve, _, _ = _fit_line(x, offset, float(places[1] - places[0]), 2)
        if abs(curve[2]) > _BENT_PX:
            return quad
        for end, tangents in ((1.0, ends), (-1.0, starts)):
            tangents[index] = (
                point + end * half + (curve @ [1.0, end, 1.0]) * outward,
                half + (curve[1] + 2.0 * curve[2] * end) * outward,
            )
            tangents[index, 1] /= np.linalg.norm(tangents[index, 1])
    corners = None if sides is None else _corners(ends, starts)
    return quad if corners is None or _far(corners, quad) else corners


def _far(corners: Floats, quad: Floats) -> bool:
    """Whether sides of something else were measured."""
    side = float(np.linalg.norm(quad - np.roll(quad, -1, axis=0), axis=1).mean())
    return bool(np.abs(corners - quad).max() > 3.0 + 0.1 * side)


def _detector(name: str) -> Any:
    family = f"DICT_{name.upper()}"
    if name not in DICTIONARIES or not hasattr(cv2.aruco, family):
        raise InputError(f"{name!r} is no dictionary of tags", remedy=f"use one of {', '.join(DICTIONARIES)}")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family)), parameters)


def _measure_sides(
    grey: npt.NDArray[np.uint8], quad: Floats
) -> tuple[Floats, Floats, float, float, float, float, list[tuple[Floats, Floats, Floats, Floats, Floats]]] | None:
    """Lines of the four sides, their covariances, contrast and scatter; None where a side cannot be measured.

    lines: (4, 2, 2): a point on each and its unit direction. covariances: (4, 2, 2) of the offset at that point [px²]
    and of the angle [rad²]. contrast: of the weakest side. scatter: of the worst, in px. Then come the width of
    the widest border and the std caused by a border smeared over a whole cell, in px; and the edge of each side: its
    middle, from there to its end, unit vector outward, places along it and the edge's offsets outward there.
    """
    lines = np.zeros((4, 2, 2))
    covariances = np.zeros((4, 2, 2))
    contrast, worst, widest, blur_std = np.inf, 0.0, 0.0, 0.0
    corners = quad
    for _ in range(_PASSES):
        middle = corners.mean(axis=0)
        contrast, worst, widest, blur_std = np.inf, 0.0, 0.0, 0.0
        contrasts, halves = np.zeros(4), np.zeros(4)
        edges: list[tuple[Floats, Floats, Floats, Floats, Floats]] = []
        for index in range(4):
            start, end = corners[index], corners[(index + 1) % 4]
            length = float(np.linalg.norm(end - start))
            if length < _MIN_SIDE:
                return None
            along = (end - start) / length
            outward = np.array([along[1], -along[0]])
            point = 0.5 * (start + end)
            outward *= 1.0 if outward @ (point - middle) > 0.0 else -1.0
            # Border and margin are one cell wide, a ninth to a sixth of the distance between opposite sides.
            across = 2.0 * float(outward @ (point - middle))
            half = float(np.clip(_REACH * across, 1.0, 6.0))
            count = max(int((_SIDE_END - _SIDE_START) * length), 6)
            places = (np.linspace(_SIDE_START, _SIDE_END, count) - 0.5) * length
            rim = _edge_offsets(grey, point + places[:, None] * along, outward, half)
            if rim is None:
                return None
            offset, weakest, width = rim
            full = max(width / (2.0 * half) - _PROFILE_FILL, 0.0) / _PROFILE_FILL_STEP
            blur_std = max(blur_std, _FLOOR_FULL * full * max(width - _SHARP, 0.0))
            line, covariance, scatter = _fit_line(places, offset, length / count)
            edges.append((point, 0.5 * length * along, outward, places, offset))
            contrasts[index], halves[index] = weakest, half
            contrast, worst, widest = min(contrast, weakest), max(worst, scatter), max(widest, width)
            lines[index] = point + line[0] * outward, along + line[1] * outward
            lines[index, 1] /= np.linalg.norm(lines[index, 1])
            covariances[index] = covariance
        found = _corners(lines)
        if found is None:
            return None
        corners = found
    contrast_std = _FLOOR_CONTRAST * float((halves * (1.0 - contrasts / contrasts.max())).max())
    blur_std = float(np.hypot(blur_std, contrast_std))
    return (lines, covariances, contrast, worst, widest, blur_std, edges) if contrast >= _LEAST_CONTRAST else None


def _edge_offsets(
    grey: npt.NDArray[np.uint8], points: Floats, outward: Floats, half: float
) -> tuple[Floats, float, float] | None:
    """Offsets (n,) of the transition from dark to light along ``outward`` from points (n, 2) [px], its contrast, and
    its width [px].
    """
    steps = np.arange(-half, half + 1e-9, _STEP)
    places = points[:, None] + steps[:, None] * outward
    low = np.floor(places.min(axis=(0, 1))).astype(int) - 1
    high = np.ceil(places.max(axis=(0, 1))).astype(int) + 2
    if (low < 0).any() or high[0] > grey.shape[1] or high[1] > grey.shape[0]:
        return None
    crop = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    local = (places - low).astype(np.float32)
    profile = cv2.remap(crop, local[..., 0], local[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    ends = max(len(steps) // 5, 1)
    # Border and paper are uniform along a side: one level for each, because illumination varies slowly.
    dark, light = np.median(profile[:, :ends]), np.median(profile[:, -ends:])
    if light - dark < _LEAST_CONTRAST:
        return None
    share = np.clip((light - profile) / (light - dark), -0.5, 1.5)
    weight = np.full(len(steps), _STEP)
    weight[[0, -1]] = 0.5 * _STEP
    mixed = np.clip(share * (1.0 - share), 0.0, None) @ weight
    # a ramp of width w integrates to w / 6
    return share @ weight - half, float(light - dark), 6.0 * float(np.median(mixed))


def _fit_line(places: Floats, offset: Floats, spacing: float, degree: int = 1) -> tuple[Floats, Floats, float]:
    """Robust line (offset, slope) through offsets (n,) at places (n,), its covariance (2, 2), the scatter [px].

    degree: 2 for a parabola, of three coefficients.
    """
    design = np.vander(places, degree + 1, increasing=True)
    weight = np.ones_like(places)
    line: Floats = np.zeros(degree + 1)
    scatter = 0.0
    for _ in range(4):
        weighted = design * weight[:, None]
        line = np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ offset), dtype=np.float64)
        residual = offset - design @ line
        scatter = (
            1.4826 * float(np.median(np.abs(residual))) * np.sqrt(len(places) / (len(places) - 1.0 - degree)) + 1e-3
        )
        weight = 1.0 / (1.0 + (residual / (2.5 * scatter)) ** 2) ** 2
    correlated_samples = max(1.0, _CORRELATION_PX / spacing)
    information = (design * weight[:, None]).T @ design
    covariance = np.asarray(scatter**2 * correlated_samples * np.linalg.inv(information), dtype=np.float64)
    return line, covariance, scatter


def _corners(lines: Floats, starts: Floats | None = None) -> Floats | None:
    """Corners (4, 2), the intersections of each side with the one before it; None where two are parallel.

    starts: lines of the sides at their starts, where ``lines`` are those at their ends.
    """
    corners = np.zeros((4, 2))
    for index in range(4):
        (p, d), (q, e) = lines[index - 1], (lines if starts is None else starts)[index]
        across = d[0] * e[1] - d[1] * e[0]
        if abs(across) < 0.05:
            return None
        away = q - p
        corners[index] = p + d * (away[0] * e[1] - away[1] * e[0]) / across
    return corners


def _centre(corners: Floats) -> tuple[Floats, float]:
    """Intersection (2,) of the diagonals, and the side [px] that the tag would have in fronto-parallel view.

    About its centre the image of the tag is nearly affine; the direction without foreshortening is the longer axis of
    the ellipse that a circle on it projects to.
    """
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], dtype=np.float32)
    h = np.asarray(cv2.getPerspectiveTransform(square, corners.astype(np.float32)), dtype=np.float64)
    (p, q), (r, s) = (corners[0], corners[2]), (corners[1], corners[3])
    a, b = q - p, s - r
    across = a[0] * b[1] - a[1] * b[0]
    t = ((r - p)[0] * b[1] - (r - p)[1] * b[0]) / across
    centre = p + t * a
    affine = h[:2, :2] / h[2, 2] - np.outer(h[:2, 2], h[2, :2]) / h[2, 2] ** 2
    return np.asarray(centre), float(np.linalg.svd(affine, compute_uv=False)[0])


def _centre_covariance(lines: Floats, covariances: Floats) -> Floats:
    """Covariance (2, 2) of the centre [px²], propagated from those of the sides by finite differences."""
    reference = _corners(lines)
    assert reference is not None
    middle, _ = _centre(reference)
    total = np.zeros((2, 2))
    for index in range(4):
        jacobian = np.zeros((2, 2))
        normal = np.array([lines[index, 1, 1], -lines[index, 1, 0]])
        for column, step in enumerate((1e-3, 1e-5)):
            moved = lines.copy()
            if column == 0:
                moved[index, 0] += step * normal
            else:
                moved[index, 1] += step * normal
            corners = _corners(moved)
            if corners is None:
                return total
            jacobian[:, column] = (_centre(corners)[0] - middle) / step
        total = total + jacobian @ covariances[index] @ jacobian.T
    return np.asarray(total)
