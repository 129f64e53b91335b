"""Segmentation of foreground silhouettes into people, also where they are together or occlude each other.

A silhouette with the height and breadth of one person is one; any other is explained by templates (``occupancy``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from edge.detectors.people.height_model import HeightModel
from edge.detectors.people.occupancy import fit_templates
from edge.detectors.people.silhouettes import (
    WORK_HEIGHT,
    PersonSilhouette,
    as_single_person,
    group_silhouettes,
    is_truncated,
    main_silhouette,
    segment_by_shape,
)
from edge.detectors.people.templates import BACKGROUND_WEIGHT, Box, SilhouetteRegion, Template, template_mask
from protocols.geometry.types import Bools, Floats, Image

_SHADOW_WEIGHT = -0.08  # log-likelihood ratio of body to background at shadow pixels, relative to a silhouette pixel
_BREADTH = 0.36  # breadth of a person's box over the height
_MAX_PIXEL_DISTANCE = 0.33  # over the height: largest distance of a pixel from its person's centre
_MIN_ISOLATED_BREADTH, _MIN_GROUPED_BREADTH = 0.1, 0.17  # over the height: half of the smallest breadth
_MAX_LEG_TRIM = 0.3  # over the height: legs that end higher above the box's lower edge are hidden, not short
_PATTERN_PX = 5.0  # working px


def segment_people(
    foreground: Image,
    shadow: Image,
    height_model: HeightModel,
    expected: list[Box],
    image: Image | None = None,
    clothing: Sequence[Floats | None] = (),
    relative_heights: Sequence[float] = (),
) -> list[PersonSilhouette]:
    """People in a clean foreground mask (H, W) 0/255.

    shadow: (H, W) pixels that are only darker than the background: dark clothes or a shadow. expected: predicted boxes
    [px]; clothing: their torsos' mean BGR colours (3,) in ``image`` (H, W, 3), where known. relative_heights: their
    heights over the height model, where known.
    """
    if not height_model.is_fitted:
        return segment_by_shape(foreground, expected)
    scale = min(1.0, WORK_HEIGHT / height_model.median_height)
    size = max(round(foreground.shape[1] * scale), 1), max(round(foreground.shape[0] * scale), 1)
    scales = size[0] / foreground.shape[1], size[1] / foreground.shape[0]
    small, dim = foreground, shadow
    if scale < 1.0:
        small, dim = (
            np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            for one in (foreground, shadow)
        )
    bodies: list[PersonSilhouette] = []
    for rows, columns, mine in group_silhouettes(small, height_model, scales, expected):
        one = as_single_person(foreground, (rows, columns), scales, height_model) if len(mine) < 2 else None
        if one is not None:
            near = [index for index in mine if _overlap(expected[index], one.box) > 0.25]
            owner = max(near, key=lambda index: _overlap(expected[index], one.box), default=-1)
            bodies.append(replace(one, expected=owner))
            continue
        filled = small[rows, columns].astype(np.float32) / 255.0
        dark = dim[rows, columns].astype(np.float32)
        weight = filled + _SHADOW_WEIGHT * dark / 255.0
        weight += BACKGROUND_WEIGHT * np.clip(1.0 - filled - dark / 255.0, 0.0, 1.0)
        region = SilhouetteRegion(weight, filled, (columns.start, rows.start), scales, height_model)
        if image is not None and len(clothing) == len(expected):
            wears = {index: worn for index in mine if (worn := clothing[index]) is not None}
            if wears:
                region.set_clothing(_blurred(image, (rows, columns), scales), wears)
        given_heights = len(relative_heights) == len(expected)
        placed = fit_templates(
            region, [(index, expected[index], relative_heights[index] if given_heights else 1.0) for index in mine]
        )
        bodies += _to_silhouettes(region, placed, foreground.shape)
    return bodies


def _blurred(image: Image, part: tuple[slice, slice], scales: tuple[float, float]) -> Image:
    """Colours (h, w, 3) of an image in a part of the working image, averaged over the pattern of clothes."""
    (fx, fy), (rows, columns) = scales, part
    left, right, top, bottom = columns.start / fx, columns.stop / fx, rows.start / fy, rows.stop / fy
    part_of_it = image[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)]
    blurred = cv2.blur(part_of_it, (max(round(_PATTERN_PX / fx), 1), max(round(_PATTERN_PX / fy), 1)))
    size = columns.stop - columns.start, rows.stop - rows.start
    return np.asarray(cv2.resize(blurred, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    across = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    down = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    if across <= 0 or down <= 0:
        return 0.0
    return across * down / (a[2] * a[3] + b[2] * b[3] - across * down)


def _to_silhouettes(region: SilhouetteRegion, placed: list[Template], shape: tuple[int, ...]) -> list[PersonSilhouette]:
    """The templates of a region as silhouettes [px of the image (H, W)], with the breadth of their own pixels."""
    if not placed:
        return []
    h, w = region.filled.shape
    y, x = np.arange(h) + 0.5, np.arange(w) + 0.5
    # Each pixel belongs to the template nearest to it across, among those of the pixel's row.
    nearest, owner = np.full((h, w), _MAX_PIXEL_DISTANCE), np.full((h, w), -1)
    for index, one in enumerate(placed):
        rows = (y > one.top - 0.1 * one.height) & (y < one.top + 1.12 * one.height)
        distance = np.abs(x - one.u) / one.height
        closer = rows[:, None] & (distance < nearest)
        np.copyto(nearest, distance, where=closer)
        owner[closer] = index
    owner[region.filled <= 0.5] = -1
    nearer = np.zeros((h, w), dtype=np.bool_)
    found: list[PersonSilhouette] = []
    for index in np.argsort([one.top + one.height for one in placed])[::-1]:
        own = template_mask(placed[index], nearer.shape)
        view = own & ~nearer
        in_view = int(np.count_nonzero(view))
        visible = in_view / max(int(np.count_nonzero(own)), 1)
        fill = float(region.filled[view].mean()) if in_view else 0.0
        nearer |= own
        found.append(_to_silhouette(region, placed[index], owner == index, visible, fill, len(placed) == 1, shape))
    return found


def _to_silhouette(
    region: SilhouetteRegion,
    one: Template,
    own: Bools,
    visible: float,
    fill: float,
    isolated: bool,
    shape: tuple[int, ...],
) -> PersonSilhouette:
    left, right = one.u - 0.5 * _BREADTH * one.height, one.u + 0.5 * _BREADTH * one.height
    top, bottom = one.top, one.top + one.height
    if isolated or visible > 0.6:
        own = main_silhouette(np.where(own, 255, 0).astype(np.uint8), one.height) > 0
    full = np.flatnonzero(np.count_nonzero(own, axis=0) >= max(0.04 * one.height, 1))
    if len(full) and visible > 0.6:
        least = _MIN_ISOLATED_BREADTH if isolated else _MIN_GROUPED_BREADTH
        left = float(np.clip(full[0], one.u - 0.33 * one.height, one.u - least * one.height))
        right = float(np.clip(full[-1] + 1, one.u + least * one.height, one.u + 0.33 * one.height))
    if isolated or visible > 0.6:
        rows = np.flatnonzero(np.count_nonzero(own, axis=1) >= max(0.03 * one.height, 1))
        first, last = (float(rows[0]), float(rows[-1] + 1)) if len(rows) else (top, bottom)
        if isolated and abs(first - top) < 0.12 * one.height:
            top = first
        # In a group, legs end where the silhouette does, unless they are occluded or taken for a shadow.
        if abs(last - bottom) < 0.2 * one.height if isolated else 0.0 < bottom - last < _MAX_LEG_TRIM * one.height:
            bottom = last
    fx, fy = region.scales
    x, y = (left + region.origin[0]) / fx, (top + region.origin[1]) / fy
    w, h = (right - left) / fx, (bottom - top) / fy
    truncated = is_truncated((x, y, w, h), shape)
    x1, y1 = min(x + w, float(shape[1])), min(y + h, float(shape[0]))
    x, y = max(x, 0.0), max(y, 0.0)
    return PersonSilhouette(
        (x, y, max(x1 - x, 1.0), max(y1 - y, 1.0)), fill, visible, isolated, one.expected, truncated
    )
