"""Measures the outline of a ball to a small part of a pixel, and from it centre, size and their uncertainty.

Rays run outward from the centre. On each, the colour just inside and the colour just outside are known, and every
sample between is a mixture of the two; the length of ray that is covered tells where the rim is. This needs no
threshold, so it is not drawn towards the light, and a rim smeared by motion still has its middle where the
rim was at mid-exposure. An ellipse-like curve is then fitted robustly to the rims of all rays: where something of a
similar colour touches the ball, those rays are outvoted.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.moving.static_background import known_at
from protocols.geometry.types import Bools, Floats

Image = npt.NDArray[np.uint8]

_RAYS = 48
_FEWEST = 20  # samples of the ball alone
_STEP = 0.5  # px between samples of a ray
_PASSES = 3
_PIXEL_STD = 6.0  # of a colour about the mixture of its two ends, by noise and texture [8-bit steps]
_SHADE_STD = 0.04  # relative: how much shading and texture brighten or darken either end along a ray
_SHADE_RIDGE = 2.5
_CURVED_RIDGE = 2.5
_LARGE = 13.0  # px of radius from which a ball tells its shading that well; a smaller one less
_INNER_BAND, _INNER_RIDGE = 1.0, 2.0  # px inside of the rim where the ball's model is put right, and px² of ridge
_OUTER_BAND = 3.0  # px beyond the rim from which the background's colour is taken
_AS_KNOWN = 8.0  # 8-bit steps by which a background may have changed since it was seen without the ball
_FLOOR_PX = 0.01  # std of the centre that remains without noise or texture,
_FLOOR_SHADE = 0.002  # and its share of the radius: shading that the model of a matt ball does not tell,
_FLOOR_SMEAR = 0.005  # and its share of what motion adds to a rim's width
_SHARP = 2.2  # px that noise and sampling make of a sharp rim
_CORRELATION = 3.5  # px along a sharp rim within which rays err together,
_CORRELATION_GROWS = 1.5  # and the power of the rim's width with which it grows
_LEAST_SMEARED = 4  # of the rays, one part in so many: motion along the rim leaves it as sharp as lens and encoder do
_CHROMA = 0.6  # how much colour differences count against luma: cameras and encoders tell them at half the resolution

_COLOUR_STD = 0.7  # of ball's and background's colours at a sharp rim, over a part of it [8-bit steps]
_DOUBT_SHADE = 0.2  # as _SHADE_STD, of the colours of which that is the error
_ALIKE_ANGLE = 0.6  # rad along the rim over which such errors are alike

_ANGLE = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
_DIRECTION = np.column_stack([np.cos(_ANGLE), np.sin(_ANGLE)])
_LUMA = np.array([[0.114, 0.587, 0.299], [0.5, -0.331, -0.169], [-0.081, -0.419, 0.5]])  # Y, Cb, Cr of BGR
_METRIC = (_LUMA / np.linalg.norm(_LUMA, axis=1)[:, None] * np.array([[1.0], [_CHROMA], [_CHROMA]])).T
_DESIGN = np.column_stack([np.ones(_RAYS), np.cos(_ANGLE), np.sin(_ANGLE), np.cos(2.0 * _ANGLE), np.sin(2.0 * _ANGLE)])
_ALIKE = np.exp((np.cos(_ANGLE[:, None] - _ANGLE) - 1.0) / _ALIKE_ANGLE**2)


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """centre: (2,) [px of the image]. diameter: of the disc of equal area [px]. covariance: (2, 2) of the centre
    [px²]. agreement: share of rays that agree with the fitted curve, 0..1. eccentricity: largest deviation of
    the curve from a circle, relative to its radius. smear: width of the rim where it is widest [px].
    """

    centre: Floats
    diameter: float
    covariance: Floats
    agreement: float
    eccentricity: float
    smear: float


def measure_outline(
    image: Image, centre: Floats, radius: float, scenery: tuple[Image, Image] | None = None
) -> Outline | None:
    """Fit the outline of a blob in an image (H, W, 3) BGR.

    centre (2,), radius: of the blob, to about a third of its radius [px]. scenery: what is behind it (H, W, 3) and how
    often that was seen (H, W), if known; on rays where the image beyond the rim is another, it is not used. None where
    the fit runs away or leaves the image.
    """
    centre = np.asarray(centre, dtype=np.float64).copy()
    shape = np.array([radius, 0.0, 0.0])  # mean radius and its second harmonic
    width = np.full(_RAYS, 1.0 + 0.5 * radius)  # of the rim; generous until it has been seen
    doubt = np.zeros(_RAYS)
    weight = np.ones(_RAYS)
    residual = np.zeros(_RAYS)
    spread = 0.0
    for index in range(_PASSES):
        rim = _DESIGN[:, [0, 3, 4]] @ shape
        half = np.minimum(1.25 + 0.6 * width, 0.75 * rim + 1.0)
        offset, seen, doubt = _rims(image, centre, rim, half, scenery)
        if offset is None:
            return None
        correction, weight, residual, spread = _fit(offset, np.maximum(seen, 1.5))
        limit = 0.5 * shape[0]
        if index == 0 and np.abs(correction).max() > limit + 1.0:
            return None
        centre += np.clip(correction[1:3], -limit, limit)
        shape += np.clip(correction[[0, 3, 4]], -limit, limit)
        if not (1.0 < shape[0] < 3.0 * radius + 3.0) or np.hypot(*(centre)) > 1e6:
            return None
        width = _opposite_mean(seen)
    rim = _DESIGN[:, [0, 3, 4]] @ shape
    covariance = _covariance(weight, spread, width, float(shape[0]), doubt)
    return Outline(
        centre=centre,
        diameter=float(2.0 * np.sqrt(np.mean(rim * rim))),
        covariance=covariance,
        agreement=float(np.mean(np.abs(residual) < max(0.2 * shape[0], 0.75))),
        eccentricity=float(np.hypot(shape[1], shape[2]) / shape[0]),
        smear=float(width.max()),
    )


def _rims(
    image: Image, centre: Floats, rim: Floats, half: Floats, scenery: tuple[Image, Image] | None
) -> tuple[Floats | None, Floats, Floats]:
    """Where the rim is on each ray, relative to ``rim`` (n,) [px], how wide (n,) [px], and how doubtful (n,) [px].

    half: (n,) half-width of the part of a ray that may be mixed [px].
    """
    reach = float(half.max()) + _OUTER_BAND
    inner = float(rim.max())
    along = np.arange(-inner, reach + _STEP, _STEP)  # relative to the rim
    radius = rim[:, None] + along
    x = (centre[0] + radius * _DIRECTION[:, :1]).astype(np.float32)
    y = (centre[1] + radius * _DIRECTION[:, 1:]).astype(np.float32)
    # A crop makes the sampling independent of the image's size (and of OpenCV's limit of 32767).
    left, top = max(int(x.min()) - 1, 0), max(int(y.min()) - 1, 0)
    right, bottom = int(x.max()) + 3, int(y.max()) + 3
    crop = image[top:bottom, left:right]
    if crop.shape[0] < 4 or crop.shape[1] < 4:
        return None, half, half
    samples = cv2.remap(crop, x - left, y - top, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    colour = samples.astype(np.float64)
    pure = along <= -half[:, None]
    pure |= radius < 0.4 * rim[:, None]  # of a ball smeared by its own diameter the middle is the best there is
    pure &= radius > 0.0
    if pure.sum() < _FEWEST:
        return None, half, half
    told = min(float(rim.mean()) / _LARGE, 1.0) ** 3  # how well so large a ball tells its own shading
    front = _shaded(colour, radius / rim[:, None], pure, _CURVED_RIDGE / told**2)
    just_inside = pure & (along >= -half[:, None] - _INNER_BAND) & (along <= -half[:, None])
    front = front + told**4 * _stray(colour - front, just_inside * np.maximum(radius, 0.0) * _STEP * _ANGLE[1])
    beyond = (along >= half[:, None]) & (along <= half[:, None] + _OUTER_BAND)
    behind = np.broadcast_to(_band_mean(colour, beyond, 1)[:, None], colour.shape)
    if scenery is not None:
        picture, looks = (one[top:bottom, left:right] for one in scenery)
        seen = cv2.remap(picture, x - left, y - top, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        often = cv2.remap(looks, x - left, y - top, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        asked = (np.abs(along) <= half[:, None]) | beyond
        behind = _known_or(
            behind, seen.astype(np.float64), known_at(np.asarray(often, dtype=np.uint8)) | ~asked, beyond
        )
    cover = np.clip(_mixture(colour, front, behind, _SHADE_STD / told), -0.25, 1.25)
    # The end samples count by the part of their step that lies within the mixed stretch.
    share = np.clip((half[:, None] - np.abs(along)) / _STEP + 0.5, 0.0, 1.0) * _STEP
    covered = (cover * share).sum(axis=1)
    mixed = (np.clip(cover * (1.0 - cover), 0.0, None) * share).sum(axis=1)
    middle = np.searchsorted(along, 0.0)
    doubt = _doubt(front[:, middle], behind[:, middle]) * half
    return covered - 0.5 * share.sum(axis=1), 6.0 * mixed, doubt  # a ramp of width w holds w / 6


def _known_or(beside: Floats, seen: Floats, known: Bools, beyond: Bools) -> Floats:
    """What is behind the ball at each sample (n, m, 3): as seen without it, made as bright as it is beside it now.

    beside: (n, m, 3) each ray's colour beyond the rim, which stays where the scenery ``seen`` (n, m, 3) is not
    ``known`` (n, m) all along the ray or differs there: the camera moved, or something else did.
    """
    change = beside[:, :1] - _band_mean(seen, beyond, 1)[:, None]
    holds = known.all(axis=1) & (np.abs(change).max(axis=(1, 2)) < _AS_KNOWN)
    return np.where(holds[:, None, None], seen + change, beside)


def _doubt(front: Floats, behind: Floats) -> Floats:
    """Std (n,) of the share by colours (n, 3) that are wrong by `_COLOUR_STD`: large where the two are alike."""
    front, behind = front @ _METRIC, behind @ _METRIC
    loose = (_PIXEL_STD / _DOUBT_SHADE) ** 2
    ff = (front * front).sum(axis=-1) + loose
    bb = (behind * behind).sum(axis=-1) + loose
    fb = (front * behind).sum(axis=-1) + loose
    return np.asarray(_COLOUR_STD * np.sqrt((ff + bb + 2.0 * fb) / np.maximum(4.0 * (ff * bb - fb * fb), 1e-6)))


def _mixture(colour: Floats, front: Floats, behind: Floats, shade: float) -> Floats:
    """Share of ``front`` in colours (…, 3) mixed of front and behind.

    Least squares for ``colour = p front + q behind`` with p + q near 1, share = p / (p + q): brightness of the
    ball (shading) and of the background (texture) may stray along the ray without moving the rim. Luma counts more than
    chroma: a Bayer sensor and every video tell colours at half the resolution, and encoders blur their edges.
    """
    colour, front, behind = colour @ _METRIC, front @ _METRIC, behind @ _METRIC
    loose = (_PIXEL_STD / shade) ** 2
    ff = (front * front).sum(axis=-1) + loose
    bb = (behind * behind).sum(axis=-1) + loose
    fb = (front * behind).sum(axis=-1) + loose
    fc = (front * colour).sum(axis=-1) + loose
    bc = (behind * colour).sum(axis=-1) + loose
    p, q = bb * fc - fb * bc, ff * bc - fb * fc
    return np.asarray(p / np.maximum(p + q, 0.2 * (ff * bb - fb * fb) + 1e-6))


def _shaded(colour: Floats, depth: Floats, pure: Bools, curved: float) -> Floats:
    """The ball's own colour (n, m, 3) at all samples, from those that show nothing else.

    colour: (n, m, 3). depth: (n, m) distance from the centre in radii. pure: (n, m). curved: ridge of the second order.
    A matt sphere is, in any light, as bright as a function of its normal (x, y, z = sqrt(1 - x² - y²)) of the second
    order within some percent, for it averages over half of all directions; that is fitted to each channel, robustly,
    because a glint is not matt.
    """
    inside = np.clip(depth, 0.0, 1.0)
    x, y = inside * _DIRECTION[:, :1], inside * _DIRECTION[:, 1:]
    z = np.sqrt(np.maximum(1.0 - inside * inside, 0.0))
    basis = np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y], axis=-1)
    known, values = basis[pure], colour[pure]
    # Samples crowd towards the centre of the fan of rays: each counts by the area that it stands for.
    area = depth[pure]
    weight = area
    # Without much of the ball to see, the tilts stay small: 2.5 px² of samples for each of them.
    ridge = np.diag([1e-6, *[_SHADE_RIDGE] * 3, *[curved] * 4])
    model = np.zeros((8, 3))
    for _ in range(3):
        weighted = known * weight[:, None]
        model = np.linalg.solve(weighted.T @ known + ridge, weighted.T @ values)
        stray = np.abs(values - known @ model).max(axis=1)
        scale = 2.0 * float(np.median(stray)) + 1.0
        weight = area / (1.0 + (stray / scale) ** 2) ** 2
    return np.asarray(basis @ model)


def _stray(off: Floats, area: Floats) -> Floats:
    """By how much a ray's ball (n, 1, 3) strays from the model just inside its rim, of ``off`` (n, m, 3).

    area: (n, m) [px²] that each sample stands for there. A model within some percent of the ball's colour still moves
    the rim where the background is nearly as bright: at the dark lower side of a ball over a wooden floor, always the
    same way. Of few pixels it would be their noise.
    """
    count = _around(area.sum(axis=1)[:, None], 1)
    return np.asarray((_around(np.einsum("nmk,nm->nk", off, area), 1) / (count + _INNER_RIDGE))[:, None])


def _band_mean(colour: Floats, band: Bools, rays: int) -> Floats:
    """Mean colour (n, 3) over a band (n, m) of each ray's samples (n, m, 3) and of ``rays`` rays to either side."""
    share = band.astype(np.float64)
    total = np.einsum("nmk,nm->nk", colour, share)
    count = share.sum(axis=1)
    total, count = _around(total, rays), _around(count[:, None], rays)
    return np.asarray(total / np.maximum(count, 1e-9))


def _around(values: Floats, rays: int) -> Floats:
    """Sums (n, k) over each ray and ``rays`` to either side, around the circle."""
    padded = np.concatenate([values[-rays:], values, values[:rays]])
    sums = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), padded]), axis=0)
    return np.asarray(sums[2 * rays + 1 :] - sums[: -2 * rays - 1])


def _opposite_mean(width: Floats) -> Floats:
    """Rim widths (n,) smoothed, and made equal on opposite sides: motion smears both alike."""
    both = 0.5 * (width + np.roll(width, _RAYS // 2))
    return np.asarray(_around(both[:, None], 2)[:, 0] / 5.0)


def _fit(offset: Floats, width: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Robust fit of mean, first and second harmonic to rim offsets (n,) [px]; wide rims are less certain.

    Returns the five coefficients, the weights (n,), the residuals (n,) [px] and their robust std for a rim of
    mean width.
    """
    prior = width.mean() / width
    weight = prior
    coefficients = np.zeros(5)
    spread = 0.0
    residual = offset
    for _ in range(5):
        weighted = _DESIGN * weight[:, None]
        coefficients = np.linalg.solve(weighted.T @ _DESIGN + 1e-9 * np.eye(5), weighted.T @ offset)
        residual = offset - _DESIGN @ coefficients
        scaled = residual * np.sqrt(prior)
        # 5 of the 48 residuals are fitted away.
        spread = 1.4826 * float(np.median(np.abs(scaled))) * np.sqrt(_RAYS / (_RAYS - 5.0)) + 1e-4
        weight = prior / (1.0 + (scaled / (2.0 * spread)) ** 2) ** 2
    return coefficients, weight, residual, spread


def _covariance(weight: Floats, spread: float, width: Floats, radius: float, doubt: Floats) -> Floats:
    """Covariance (2, 2) of the centre [px²] from the scatter of the rims about the curve, and from what neighbouring
    rays may err alike: ``doubt`` (n,) [px].

    How far rays err together, and how wrong colours are, depends on what made the picture. The rim tells it where
    motion does not smear it: its width there is that of lens, sampling and encoder. Both grow with that width, as
    measured on raw pictures, JPEG and H.264 alike (films in `tests/bench/marker_detector.py`).
    """
    prior = width.mean() / np.maximum(width, 1.5)
    blur = float(np.sort(width)[: _RAYS // _LEAST_SMEARED].mean())
    wider = blur / _SHARP
    together = max(1.0, _CORRELATION * wider**_CORRELATION_GROWS * _RAYS / (2.0 * np.pi * radius))
    effective = np.minimum(weight, prior)
    information = (_DESIGN * effective[:, None]).T @ _DESIGN
    inverse = np.linalg.inv(information + 1e-9 * np.eye(5))
    alike = ((inverse @ (_DESIGN * effective[:, None]).T)[1:3]) * doubt * wider
    floor = _FLOOR_PX**2 + (_FLOOR_SHADE * radius) ** 2 + (_FLOOR_SMEAR * (float(width.max()) - blur)) ** 2
    return np.asarray(spread**2 * together * inverse[1:3, 1:3] + alike @ _ALIKE @ alike.T + floor * np.eye(2))
