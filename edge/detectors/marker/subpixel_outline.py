"""Sub-pixel measurement of a ball's outline: centre, diameter and their uncertainty.

Rays are sampled outward from the centre. On each, the colour just inside and the colour just outside are known, and
every sample between them is a mixture of the two; the covered length of the ray gives the position of the rim. This
needs no threshold, so there is no bias towards the light, and the middle of a rim smeared by motion is where the rim
was at mid-exposure. An ellipse-like curve is then fitted robustly to the rims of all rays: where an object of a similar
colour touches the ball, those rays are outliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.detectors.marker.static_background import is_known
from protocols.geometry.types import Bools, Floats, Image

_RAYS = 48  # across the outline, evenly spaced
_MIN_SAMPLES = 20  # samples of the ball alone
_STEP = 0.5  # px between samples of a ray
_PASSES = 3  # each begins with the outline of the last
_PIXEL_STD = 6.0  # std of a colour about the mixture of its two ends, by noise and texture [8-bit steps]
_SHADE_STD = 0.04  # relative variation of either end's brightness along a ray, by shading and texture
_SHADE_RIDGE = 2.5  # px² of samples: with fewer pixels gradients stay small
_CURVED_RIDGE = 2.5  # the same for the curvature of the shading
_SHADING_RADIUS = 13.0  # px: radius from which a ball's shading is well determined
_INNER_BAND, _INNER_RIDGE = 1.0, 2.0  # px inside the rim where the shading model is corrected, and px² of its ridge
_OUTER_BAND = 3.0  # px beyond the rim from which the background's colour is taken
_BACKGROUND_CHANGE = 8.0  # 8-bit steps: largest change of the background since it was seen without the ball
_FLOOR_PX = 0.01  # px: std of the centre without noise or texture,
_FLOOR_SHADE = 0.002  # plus this share of the radius: shading beyond the model of a matt ball,
_FLOOR_SMEAR = 0.005  # plus this share of the rim width added by motion
_SHARP = 2.2  # px: width of a sharp rim after noise and sampling
_CORRELATION = 3.5  # px: correlation length of rays along a sharp rim,
_CORRELATION_GROWS = 1.5  # and the power of the rim's width with which it grows
_SHARPEST_SHARE = 4  # one part in so many of the rays: motion along the rim leaves it as sharp as lens and encoder do
_CHROMA = 0.6  # weight of colour differences against luma: cameras and encoders subsample them by two

_COLOUR_STD = 0.7  # std of the colours of ball and background at a sharp rim, over a part of it [8-bit steps]
_COLOUR_ERROR_SHADE = 0.2  # as _SHADE_STD, of the colours with that error
_CORRELATION_ANGLE = 0.6  # rad: correlation angle of such errors along the rim

_ANGLE = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
_DIRECTION = np.column_stack([np.cos(_ANGLE), np.sin(_ANGLE)])
_LUMA = np.array([[0.114, 0.587, 0.299], [0.5, -0.331, -0.169], [-0.081, -0.419, 0.5]])  # Y, Cb, Cr of BGR
_METRIC = (_LUMA / np.linalg.norm(_LUMA, axis=1)[:, None] * np.array([[1.0], [_CHROMA], [_CHROMA]])).T
_DESIGN = np.column_stack([np.ones(_RAYS), np.cos(_ANGLE), np.sin(_ANGLE), np.cos(2.0 * _ANGLE), np.sin(2.0 * _ANGLE)])
_RAY_CORRELATION = np.exp((np.cos(_ANGLE[:, None] - _ANGLE) - 1.0) / _CORRELATION_ANGLE**2)


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Fitted outline of a ball.

    centre: (2,) [px of the image]. diameter: of the disc of equal area [px]. covariance: (2, 2) of the centre [px²].
    agreement: share of rays that agree with the fitted curve, 0..1. smear: width of the rim where it is widest [px].
    """

    centre: Floats
    diameter: float
    covariance: Floats
    agreement: float
    smear: float


def measure_outline(
    image: Image, centre: Floats, radius: float, background: tuple[Image, Image] | None = None
) -> Outline | None:
    """Fit the outline of a blob in an image (H, W, 3) BGR.

    centre (2,), radius: of the blob, to about a third of its radius [px]. background: the image without the ball (H, W,
    3) and its sample counts (H, W), if known; it is not used on rays where the image beyond the rim differs from it.
    None where the fit diverges or leaves the image.
    """
    centre = np.asarray(centre, dtype=np.float64).copy()
    shape = np.array([radius, 0.0, 0.0])  # mean radius and its second harmonic
    width = np.full(_RAYS, 1.0 + 0.5 * radius)  # of the rim; generous before the first measurement
    systematic_std = np.zeros(_RAYS)
    weight = np.ones(_RAYS)
    residual = np.zeros(_RAYS)
    spread = 0.0
    for index in range(_PASSES):
        rim = _DESIGN[:, [0, 3, 4]] @ shape
        half = np.minimum(1.25 + 0.6 * width, 0.75 * rim + 1.0)
        offset, measured_width, systematic_std = _rim_offsets(image, centre, rim, half, background)
        if offset is None:
            return None
        correction, weight, residual, spread = _fit(offset, np.maximum(measured_width, 1.5))
        limit = 0.5 * shape[0]
        if index == 0 and np.abs(correction).max() > limit + 1.0:
            return None
        centre += np.clip(correction[1:3], -limit, limit)
        shape += np.clip(correction[[0, 3, 4]], -limit, limit)
        if not (1.0 < shape[0] < 3.0 * radius + 3.0) or np.hypot(*(centre)) > 1e6:
            return None
        width = _opposite_mean(measured_width)
    rim = _DESIGN[:, [0, 3, 4]] @ shape
    covariance = _covariance(weight, spread, width, float(shape[0]), systematic_std)
    return Outline(
        centre=centre,
        diameter=float(2.0 * np.sqrt(np.mean(rim * rim))),
        covariance=covariance,
        agreement=float(np.mean(np.abs(residual) < max(0.2 * shape[0], 0.75))),
        smear=float(width.max()),
    )


def _rim_offsets(
    image: Image, centre: Floats, rim: Floats, half: Floats, background: tuple[Image, Image] | None
) -> tuple[Floats | None, Floats, Floats]:
    """Position of the rim on each ray, relative to ``rim`` (n,) [px], its width (n,) [px], and its systematic std (n,)
    [px].

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
    # of a ball smeared by its own diameter the middle is the best that is available
    pure |= radius < 0.4 * rim[:, None]
    pure &= radius > 0.0
    if pure.sum() < _MIN_SAMPLES:
        return None, half, half
    # how well the shading of a ball of this size is determined
    reliability = min(float(rim.mean()) / _SHADING_RADIUS, 1.0) ** 3
    ball_colour = _shading_model(colour, radius / rim[:, None], pure, _CURVED_RIDGE / reliability**2)
    just_inside = pure & (along >= -half[:, None] - _INNER_BAND) & (along <= -half[:, None])
    ball_colour = ball_colour + reliability**4 * _shading_correction(
        colour - ball_colour, just_inside * np.maximum(radius, 0.0) * _STEP * _ANGLE[1]
    )
    beyond = (along >= half[:, None]) & (along <= half[:, None] + _OUTER_BAND)
    background_colour = np.broadcast_to(_band_mean(colour, beyond)[:, None], colour.shape)
    if background is not None:
        known_image, known_counts = (one[top:bottom, left:right] for one in background)
        unoccluded = cv2.remap(known_image, x - left, y - top, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        counts = cv2.remap(known_counts, x - left, y - top, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        needed = (np.abs(along) <= half[:, None]) | beyond
        background_colour = _background_along_rays(
            background_colour,
            unoccluded.astype(np.float64),
            is_known(np.asarray(counts, dtype=np.uint8)) | ~needed,
            beyond,
        )
    cover = np.clip(_mixture(colour, ball_colour, background_colour, _SHADE_STD / reliability), -0.25, 1.25)
    # The end samples count by the part of their step that lies within the mixed part.
    share = np.clip((half[:, None] - np.abs(along)) / _STEP + 0.5, 0.0, 1.0) * _STEP
    covered = (cover * share).sum(axis=1)
    mixed = (np.clip(cover * (1.0 - cover), 0.0, None) * share).sum(axis=1)
    middle = np.searchsorted(along, 0.0)
    systematic_std = _share_std(ball_colour[:, middle], background_colour[:, middle]) * half
    return covered - 0.5 * share.sum(axis=1), 6.0 * mixed, systematic_std  # a ramp of width w integrates to w / 6


def _background_along_rays(beside: Floats, unoccluded: Floats, known: Bools, beyond: Bools) -> Floats:
    """Background colour at each sample (n, m, 3): as seen without the ball, offset by the present change beside it.

    beside: (n, m, 3) each ray's colour beyond the rim, which is kept where the background ``unoccluded`` (n, m, 3) is
    not ``known`` (n, m) all along the ray or differs there: the camera or an object has moved.
    """
    change = beside[:, :1] - _band_mean(unoccluded, beyond)[:, None]
    holds = known.all(axis=1) & (np.abs(change).max(axis=(1, 2)) < _BACKGROUND_CHANGE)
    return np.where(holds[:, None, None], unoccluded + change, beside)


def _share_std(ball_colour: Floats, background_colour: Floats) -> Floats:
    """Std (n,) of the share by errors ``_COLOUR_STD`` of the colours (n, 3): large where the two are similar."""
    ball_colour, background_colour = ball_colour @ _METRIC, background_colour @ _METRIC
    tolerance = (_PIXEL_STD / _COLOUR_ERROR_SHADE) ** 2
    ff = (ball_colour * ball_colour).sum(axis=-1) + tolerance
    bb = (background_colour * background_colour).sum(axis=-1) + tolerance
    fb = (ball_colour * background_colour).sum(axis=-1) + tolerance
    return np.asarray(_COLOUR_STD * np.sqrt((ff + bb + 2.0 * fb) / np.maximum(4.0 * (ff * bb - fb * fb), 1e-6)))


def _mixture(colour: Floats, ball_colour: Floats, background_colour: Floats, shade: float) -> Floats:
    """Share of the ball's colour in colours (…, 3) mixed of ball and background.

    Least squares for ``colour = p ball + q background`` with p + q near 1, share = p / (p + q): the brightness of the
    ball (shading) and of the background (texture) may vary along the ray without moving the rim. Luma counts more than
    chroma: Bayer sensors and video subsample colours by two, and encoders blur their edges.
    """
    colour, ball_colour, background_colour = colour @ _METRIC, ball_colour @ _METRIC, background_colour @ _METRIC
    tolerance = (_PIXEL_STD / shade) ** 2
    ff = (ball_colour * ball_colour).sum(axis=-1) + tolerance
    bb = (background_colour * background_colour).sum(axis=-1) + tolerance
    fb = (ball_colour * background_colour).sum(axis=-1) + tolerance
    fc = (ball_colour * colour).sum(axis=-1) + tolerance
    bc = (background_colour * colour).sum(axis=-1) + tolerance
    p, q = bb * fc - fb * bc, ff * bc - fb * fc
    return np.asarray(p / np.maximum(p + q, 0.2 * (ff * bb - fb * fb) + 1e-6))


def _shading_model(colour: Floats, depth: Floats, pure: Bools, curved: float) -> Floats:
    """The ball's own colour (n, m, 3) at all samples, extrapolated from those that show nothing else.

    colour: (n, m, 3). depth: (n, m) distance from the centre in radii. pure: (n, m). curved: ridge of the second order.
    The brightness of a matt sphere in any light is, within some percent, a second-order function of its normal (x, y, z
    = sqrt(1 - x² - y²)), because it averages over half of all directions. That function is fitted robustly to each
    channel, because a specular highlight is not matt.
    """
    inside = np.clip(depth, 0.0, 1.0)
    x, y = inside * _DIRECTION[:, :1], inside * _DIRECTION[:, 1:]
    z = np.sqrt(np.maximum(1.0 - inside * inside, 0.0))
    basis = np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y], axis=-1)
    known, values = basis[pure], colour[pure]
    # Samples are denser towards the centre: each is weighted by the area that it represents.
    area = depth[pure]
    weight = area
    # With few pixels the gradients stay small: a ridge of 2.5 px² of samples for each of them.
    ridge = np.diag([1e-6, *[_SHADE_RIDGE] * 3, *[curved] * 4])
    model = np.zeros((8, 3))
    for _ in range(3):
        weighted = known * weight[:, None]
        model = np.linalg.solve(weighted.T @ known + ridge, weighted.T @ values)
        residual = np.abs(values - known @ model).max(axis=1)
        scale = 2.0 * float(np.median(residual)) + 1.0
        weight = area / (1.0 + (residual / scale) ** 2) ** 2
    return np.asarray(basis @ model)


def _shading_correction(off: Floats, area: Floats) -> Floats:
    """Deviation of a ray's ball colour (n, 1, 3) from the model just inside its rim, from ``off`` (n, m, 3).

    area: (n, m) [px²] that each sample represents. A model within some percent of the ball's colour still biases the
    rim where the background is nearly as bright: at the dark lower side of a ball over a wooden floor, always in the
    same direction. With few pixels the correction would be their noise.
    """
    count = _around(area.sum(axis=1)[:, None], 1)
    return np.asarray((_around(np.einsum("nmk,nm->nk", off, area), 1) / (count + _INNER_RIDGE))[:, None])


def _band_mean(colour: Floats, band: Bools) -> Floats:
    """Mean colour (n, 3) over a band (n, m) of each ray's samples (n, m, 3) and of its neighbours'."""
    share = band.astype(np.float64)
    total = np.einsum("nmk,nm->nk", colour, share)
    count = share.sum(axis=1)
    total, count = _around(total, 1), _around(count[:, None], 1)
    return np.asarray(total / np.maximum(count, 1e-9))


def _around(values: Floats, rays: int) -> Floats:
    """Sums (n, k) over each ray and ``rays`` to either side, around the circle."""
    padded = np.concatenate([values[-rays:], values, values[:rays]])
    sums = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), padded]), axis=0)
    return np.asarray(sums[2 * rays + 1 :] - sums[: -2 * rays - 1])


def _opposite_mean(width: Floats) -> Floats:
    """Rim widths (n,) smoothed and averaged over opposite sides: motion smears both equally."""
    both = 0.5 * (width + np.roll(width, _RAYS // 2))
    return np.asarray(_around(both[:, None], 2)[:, 0] / 5.0)


def _fit(offset: Floats, width: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Robust fit of mean, first and second harmonic to rim offsets (n,) [px]; wide rims have a lower weight.

    Returns the five coefficients, the weights (n,), the residuals (n,) [px] and their robust std for a rim of mean
    width.
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
        # Five degrees of freedom are lost to the fit of 48 residuals.
        spread = 1.4826 * float(np.median(np.abs(scaled))) * np.sqrt(_RAYS / (_RAYS - 5.0)) + 1e-4
        weight = prior / (1.0 + (scaled / (2.0 * spread)) ** 2) ** 2
    return coefficients, weight, residual, spread


def _covariance(weight: Floats, spread: float, width: Floats, radius: float, systematic_std: Floats) -> Floats:
    """Covariance (2, 2) of the centre [px²] from the scatter of the rims about the curve, and from the errors
    correlated between neighbouring rays: ``systematic_std`` (n,) [px].

    The correlation of rays and the error of colours depend on lens, sampling and encoder, which the width of the rim
    shows where motion does not smear it. Both grow with that width, as measured on raw images, JPEG and H.264 (films in
    `tests/bench/marker_detector.py`).
    """
    prior = width.mean() / np.maximum(width, 1.5)
    blur = float(np.sort(width)[: _RAYS // _SHARPEST_SHARE].mean())
    wider = blur / _SHARP
    correlated_rays = max(1.0, _CORRELATION * wider**_CORRELATION_GROWS * _RAYS / (2.0 * np.pi * radius))
    effective = np.minimum(weight, prior)
    information = (_DESIGN * effective[:, None]).T @ _DESIGN
    inverse = np.linalg.inv(information + 1e-9 * np.eye(5))
    correlated = ((inverse @ (_DESIGN * effective[:, None]).T)[1:3]) * systematic_std * wider
    floor = _FLOOR_PX**2 + (_FLOOR_SHADE * radius) ** 2 + (_FLOOR_SMEAR * (float(width.max()) - blur)) ** 2
    return np.asarray(
        spread**2 * correlated_rays * inverse[1:3, 1:3]
        + correlated @ _RAY_CORRELATION @ correlated.T
        + floor * np.eye(2)
    )
