"""Explains silhouettes by people: one, or several who stand together or hide each other.

A silhouette that is as tall and as slim as one person there is one; any other is explained by templates (``crowd``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.people.height_model import Stature
from edge.detectors.people.occupancy import place
from edge.detectors.people.silhouettes import WORK_HEIGHT, Body, bulk, by_shape, clusters, is_cut, whole
from edge.detectors.people.templates import EMPTY, Box, Scene, Template, mask
from protocols.geometry.types import Bools, Floats

Image = npt.NDArray[np.uint8]
_SHADOW = -0.08  # log-likelihood ratio of body to background, against that of a silhouette's pixel
_BREADTH = 0.36  # of a person's box, of the height
_FARTHEST = 0.33  # of the height: from somebody's middle to a pixel of his
_LONE, _GROUPED = 0.1, 0.17  # of the height: half of the least breadth
_TRIM = 0.3
_PATTERN = 5.0  # working px


def explain(
    figure: Image,
    shadow: Image,
    stature: Stature,
    expected: list[Box],
    image: Image | None = None,
    clothes: Sequence[Floats | None] = (),
    statures: Sequence[float] = (),
) -> list[Body]:
    """People in a clean silhouette picture (H, W) 0/255.

    shadow: (H, W) what is only darker than the background: somebody may stand there in dark clothes, or a shadow lie.
    expected: boxes [px] where some should be; clothes: their torsos' mean colours (3,), as far as known, in ``image``
    (H, W, 3). statures: their heights, of what is usual, as far as known.
    """
    if not stature.known:
        return by_shape(figure, expected)
    scale = min(1.0, WORK_HEIGHT / stature.typical)
    size = max(round(figure.shape[1] * scale), 1), max(round(figure.shape[0] * scale), 1)
    scales = size[0] / figure.shape[1], size[1] / figure.shape[0]
    small, dim = figure, shadow
    if scale < 1.0:
        small, dim = (
            np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_AREA), dtype=np.uint8) for one in (figure, shadow)
        )
    bodies: list[Body] = []
    for rows, columns, mine in clusters(small, stature, scales, expected):
        one = whole(figure, (rows, columns), scales, stature) if len(mine) < 2 else None
        if one is not None:
            near = [index for index in mine if _overlap(expected[index], one.box) > 0.25]
            owner = max(near, key=lambda index: _overlap(expected[index], one.box), default=-1)
            bodies.append(replace(one, expected=owner))
            continue
        filled = small[rows, columns].astype(np.float32) / 255.0
        dark = dim[rows, columns].astype(np.float32)
        weight = filled + _SHADOW * dark / 255.0
        weight += EMPTY * np.clip(1.0 - filled - dark / 255.0, 0.0, 1.0)
        scene = Scene(weight, filled, (columns.start, rows.start), scales, stature)
        if image is not None and len(clothes) == len(expected):
            wears = {index: worn for index in mine if (worn := clothes[index]) is not None}
            if wears:
                scene.dress(_blurred(image, (rows, columns), scales), wears)
        told = len(statures) == len(expected)
        placed = place(scene, [(index, expected[index], statures[index] if told else 1.0) for index in mine])
        bodies += _bodies(scene, placed, figure.shape)
    return bodies


def _blurred(image: Image, part: tuple[slice, slice], scales: tuple[float, float]) -> Image:
    """A picture's colours (h, w, 3) in a part of the working picture: finer than the clothes' pattern need not be."""
    (fx, fy), (rows, columns) = scales, part
    left, right, top, bottom = columns.start / fx, columns.stop / fx, rows.start / fy, rows.stop / fy
    part_of_it = image[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)]
    blurred = cv2.blur(part_of_it, (max(round(_PATTERN / fx), 1), max(round(_PATTERN / fy), 1)))
    size = columns.stop - columns.start, rows.stop - rows.start
    return np.asarray(cv2.resize(blurred, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    across = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    down = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    if across <= 0 or down <= 0:
        return 0.0
    return across * down / (a[2] * a[3] + b[2] * b[3] - across * down)


def _bodies(scene: Scene, placed: list[Template], shape: tuple[int, ...]) -> list[Body]:
    """The templates of a scene as bodies [px of the picture (H, W)], with the breadth that their silhouettes have."""
    if not placed:
        return []
    h, w = scene.filled.shape
    y, x = np.arange(h) + 0.5, np.arange(w) + 0.5
    # Whose each pixel is: the one in whose rows it lies and whose middle is nearest.
    nearest, owner = np.full((h, w), _FARTHEST), np.full((h, w), -1)
    for index, one in enumerate(placed):
        rows = (y > one.top - 0.1 * one.tall) & (y < one.top + 1.12 * one.tall)
        distance = np.abs(x - one.u) / one.tall
        closer = rows[:, None] & (distance < nearest)
        np.copyto(nearest, distance, where=closer)
        owner[closer] = index
    owner[scene.filled <= 0.5] = -1
    nearer = np.zeros((h, w), dtype=np.bool_)
    found: list[Body] = []
    for index in np.argsort([one.top + one.tall for one in placed])[::-1]:
        own = mask(placed[index], nearer.shape)
        view = own & ~nearer
        in_view = int(np.count_nonzero(view))
        seen = in_view / max(int(np.count_nonzero(own)), 1)
        fill = float(scene.filled[view].mean()) if in_view else 0.0
        nearer |= own
        found.append(_body(scene, placed[index], owner == index, seen, fill, len(placed) == 1, shape))
    return found


def _body(
    scene: Scene, one: Template, own: Bools, seen: float, fill: float, alone: bool, shape: tuple[int, ...]
) -> Body:
    left, right = one.u - 0.5 * _BREADTH * one.tall, one.u + 0.5 * _BREADTH * one.tall
    top, bottom = one.top, one.top + one.tall
    if alone or seen > 0.6:
        own = bulk(np.where(own, 255, 0).astype(np.uint8), one.tall) > 0
    full = np.flatnonzero(np.count_nonzero(own, axis=0) >= max(0.04 * one.tall, 1))
    if len(full) and seen > 0.6:
        least = _LONE if alone else _GROUPED
        left = float(np.clip(full[0], one.u - 0.33 * one.tall, one.u - least * one.tall))
        right = float(np.clip(full[-1] + 1, one.u + least * one.tall, one.u + 0.33 * one.tall))
    if alone or seen > 0.6:
        rows = np.flatnonzero(np.count_nonzero(own, axis=1) >= max(0.03 * one.tall, 1))
        first, last = (float(rows[0]), float(rows[-1] + 1)) if len(rows) else (top, bottom)
        if alone and abs(first - top) < 0.12 * one.tall:
            top = first
        # Of several, legs end where the silhouette does, unless what is below is hidden or taken for a shadow.
        if abs(last - bottom) < 0.2 * one.tall if alone else 0.0 < bottom - last < _TRIM * one.tall:
            bottom = last
    fx, fy = scene.scales
    x, y = (left + scene.origin[0]) / fx, (top + scene.origin[1]) / fy
    w, h = (right - left) / fx, (bottom - top) / fy
    cut = is_cut((x, y, w, h), shape)
    x1, y1 = min(x + w, float(shape[1])), min(y + h, float(shape[0]))
    x, y = max(x, 0.0), max(y, 0.0)
    return Body((x, y, max(x1 - x, 1.0), max(y1 - y, 1.0)), fill, seen, alone, one.expected, cut)
