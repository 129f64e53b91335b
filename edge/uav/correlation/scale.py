"""Size of the target: optical flow inside its box from frame to frame, and a scale filter against drift.

The flow follows width and height apart (Kalal, Mikolajczyk, Matas: Forward-backward error, ICPR 2010); the filter is
the one-dimensional correlation filter over scales of Danelljan et al. (DSST, BMVC 2014), on a coarse grid.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.correlation.features import cell_features
from edge.uav.correlation.filter import refined
from edge.uav.correlation.oriented_box import OrientedBox, crop
from edge.uav.image_motion.scene_motion import middle
from protocols.geometry.types import Floats, Image

_FLOW_PX = 72  # longer side of the resampled box [px]
_FLOW_GRID = 7  # points a side
_FLOW_MARGIN = 1.5  # of the resampled region, over the box
_MIN_POINTS = 8  # of 49: of fewer, two wrong ones change the sides
_FLOW_PRIOR = 8.0  # points whose weight holds the size where the flow is weak
_INDEPENDENT = 4.0  # px of the image that tell one motion: 2 x 2 of a colour sensor
_MAX_STEP = 1.12  # change of a side in one frame
_MAX_TURN = 0.15  # in one frame [rad]

_SCALES = 9  # the present one in their middle: 0.87 to 1.15 of it, more than a side changes in a frame
_STEP = 1.035  # between neighbouring scales
_SIDE = 24  # of the resampled box [px]
_RATE = 0.03  # share of a frame in what is learnt: a second's mean at 30 fps
_REGULARISATION = 0.05  # over the mean energy: frequencies with less have little weight


class BoxFlow:
    """Change of the box's sides and angle between two frames."""

    def __init__(self) -> None:
        self._old: tuple[npt.NDArray[np.uint8], float, OrientedBox] | None = None

    def remember(self, image: Image, box: OrientedBox) -> None:
        """Keep the box for the next frame."""
        per_pixel = _FLOW_PX / max(box.width, box.height)
        sides = np.maximum(np.rint(_FLOW_MARGIN * per_pixel * box.sides), 16.0)
        self._old = self._patch(image, box, sides, per_pixel), per_pixel, box

    def _patch(self, image: Image, box: OrientedBox, sides: Floats, per_pixel: float) -> npt.NDArray[np.uint8]:
        patch = crop(image, box.sized(sides / per_pixel), (int(sides[0]), int(sides[1])))
        return np.asarray(cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY))

    def change(self, image: Image, box: OrientedBox, stood: Floats | None) -> tuple[float, float, float]:
        """Factors of width and height, and turn [rad], since ``remember``, beyond those of ``box`` itself.

        box: as it is expected now; stood: (2,) where its centre were if it stood in the scene, if known [px].
        """
        none = (1.0, 1.0, 0.0)
        if self._old is None:
            return none
        old, per_pixel, last = self._old
        per_pixel *= float(np.sqrt(np.prod(last.sides / box.sides)))
        centre = box.centre
        new = self._patch(image, box, np.array(old.shape[::-1], dtype=np.float64), per_pixel)
        unit = 0.9 * ((np.arange(_FLOW_GRID) + 0.5) / _FLOW_GRID - 0.5)
        gx, gy = np.meshgrid(unit * box.width * per_pixel, unit * box.height * per_pixel)
        middle = 0.5 * (np.array(old.shape[::-1]) - 1.0)
        points = np.asarray(np.column_stack([gx.ravel(), gy.ravel()]) + middle, np.float32)
        moved, ok, _ = cv2.calcOpticalFlowPyrLK(old, new, points, points.copy(), winSize=(9, 9), maxLevel=2)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(new, old, moved, points.copy(), winSize=(9, 9), maxLevel=2)
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (np.square(back - points).sum(axis=1) < 1.0)
        seen = centre + (points - middle) / per_pixel @ box.axes.T
        good &= ((seen >= 1.0) & (seen <= np.array(image.shape[1::-1]) - 2.0)).all(axis=1)
        p, q = points[good].astype(np.float64) - middle, moved[good].astype(np.float64) - middle
        if stood is not None:
            shift = (stood - centre) @ box.axes * per_pixel
            # From a pixel here, and half of one in the image, on: what moves as the scene does is background.
            if np.hypot(*shift) > max(1.0, 0.5 * per_pixel):
                good = np.square(q - p - shift).sum(axis=1) > np.square(q - p).sum(axis=1)
                p, q = p[good], q[good]
        if len(p) < _MIN_POINTS:
            return none
        near = np.abs(q - p - np.median(q - p, axis=0)).max(axis=1) < 0.08 * _FLOW_PX
        if near.sum() < _MIN_POINTS:
            return none
        p, q = p[near], q[near]
        prior = _FLOW_PRIOR * max(_FLOW_GRID**2 * _INDEPENDENT / (box.width * box.height), 1.0)
        wider, skew = _slope(p, q[:, 0], 0, prior)
        higher, skew_y = _slope(p, q[:, 1], 1, prior)
        return wider, higher, 0.5 * (skew_y - skew)


def _slope(old: Floats, new: Floats, axis: int, prior: float) -> tuple[float, float]:
    """Robust derivatives of one new coordinate by the same and by the other old one, with a prior of 1 and 0."""
    spread = old.var(axis=0)
    step: Floats = np.zeros(2)
    weight: Floats = np.ones(len(old))
    for _ in range(3):
        change = new - old[:, axis]
        residual = change - old @ step
        residual = residual - weight @ residual / weight.sum()
        scale = max(middle(np.abs(residual)), 0.1)
        weight = np.asarray(1.0 / (1.0 + np.square(residual / (2.0 * scale))), np.float64)
        centred = old - weight @ old / weight.sum()
        normal = centred.T @ (weight[:, None] * centred) + np.diag(prior * spread + 1e-6)
        step = np.asarray(np.linalg.solve(normal, centred.T @ (weight * change)), np.float64)
    slope = float(np.clip(1.0 + step[axis], 1.0 / _MAX_STEP, _MAX_STEP))
    return slope, float(np.clip(step[1 - axis], -_MAX_TURN, _MAX_TURN))


class ScaleFilter:
    """A correlation filter over scales of the box."""

    def __init__(self) -> None:
        steps = np.arange(_SCALES) - _SCALES // 2
        self._factors = _STEP ** steps.astype(np.float64)
        self._window = np.hanning(_SCALES + 2)[1:-1].astype(np.float32)
        self._label = np.fft.rfft(np.fft.ifftshift(np.exp(-0.5 * np.square(steps / 1.0))))
        self._steps = steps
        self._numerator: npt.NDArray[np.complex128] | None = None
        self._denominator = np.zeros(0)

    def learn(self, image: Image, box: OrientedBox) -> None:
        """Learn that the box has this size."""
        spectrum = self._spectrum(image, box)
        numerator = np.conj(self._label) * spectrum
        denominator = np.square(np.abs(spectrum)).sum(axis=0)
        if self._numerator is None:
            self._numerator, self._denominator = numerator, denominator
        else:
            self._numerator = (1 - _RATE) * self._numerator + _RATE * numerator
            self._denominator = (1 - _RATE) * self._denominator + _RATE * denominator

    def factor(self, image: Image, box: OrientedBox) -> float:
        """The factor that brings a box of this size to the learnt scale."""
        if self._numerator is None or not self._denominator.any():  # nothing was learnt, or a uniform patch
            return 1.0
        spectrum = self._spectrum(image, box)
        regular = _REGULARISATION * float(self._denominator.mean())
        product = (np.conj(self._numerator) * spectrum).sum(axis=0) / (self._denominator + regular)
        answer = np.fft.fftshift(np.fft.irfft(product, n=_SCALES))
        k = int(answer.argmax())
        between = refined(answer, k) if 0 < k < _SCALES - 1 else 0.0
        return float(_STEP ** (self._steps[k] + between))

    def _spectrum(self, image: Image, box: OrientedBox) -> npt.NDArray[np.complex128]:
        stack = np.concatenate([crop(image, box.sized(box.sides * f), (_SIDE, _SIDE)) for f in self._factors], axis=0)
        features = cell_features(stack)
        cells = _SIDE // 4
        per_scale = features.reshape(len(features), _SCALES, cells, cells).transpose(0, 2, 3, 1)
        vectors = per_scale.reshape(-1, _SCALES)
        weighted = vectors - (vectors * self._window).sum(axis=1, keepdims=True) / self._window.sum()
        return np.asarray(np.fft.rfft(weighted * self._window, axis=1))
