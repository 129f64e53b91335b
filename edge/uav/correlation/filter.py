"""Discriminative correlation filter with a spatial mask.

Lukezic, Vojir, Cehovin, Matas, Kristan: Discriminative correlation filter with channel and spatial reliability (CVPR
2017): per channel, the filter that answers a Gaussian peak and vanishes outside the target, by the alternating
direction method of multipliers. The mask here is the target's box with soft edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from edge.uav.correlation.features import CHANNELS, Features, cell_features
from edge.uav.correlation.memory import CHANGED, RunningNormal
from edge.uav.correlation.oriented_box import OrientedBox, crop
from protocols.geometry.types import Image

_CELL = 4  # [px]
_AREA_PX = 150  # square root of the area of the resampled window [px]
_PADDING = 2.4  # of the window, over the mean side of the target, added on both axes alike
_LABEL_STD = 1.0 / 16.0  # of the wanted peak, over the geometric mean of the target's sides
_ITERATIONS, _PENALTY, _PENALTY_GROWTH, _REGULARISATION = 3, 5.0, 3.0, 0.01  # of the published method
_LEARNING_RATE = 0.05  # every second frame: 0.025 a frame as in DSST (Danelljan et al. 2014)
_FIRST_VIEWS, _FORGETTING = 4, 0.02  # that the filter of the whole past begins with; share of a later one in it
_ON, _OFF = (1.1, 0.4), (0.1, 0.3)  # mean and std of the log of the ratio, on the target and off it
_LIMIT = 3.0  # of the log likelihood ratio
_CENTRE_STD = 0.8  # of the mask, over half a side: a box's corners show background

Spectrum = npt.NDArray[np.complex64]


@dataclass(frozen=True, slots=True)
class Response:
    """Peak of the filter's answer. x, y: offset of the target from the window's centre [image px].

    peak: height; 1 where the target looks as it was learnt. ratio: what the filter of the whole past answers at the
    same place, over its highest answer elsewhere in the window; on: mean and std of its log on this target.
    """

    x: float
    y: float
    peak: float
    ratio: float
    on: tuple[float, float] = _ON

    @property
    def log(self) -> float:
        """Natural logarithm of the ratio."""
        return float(np.log(max(self.ratio, 1e-3)))

    @property
    def log_ratio(self) -> float:
        """log p(ratio | on the target) - log p(ratio | on the background), natural, bounded."""
        value = self.log
        off = float(np.exp(-0.5 * (max(value - _OFF[0], 0.0) / _OFF[1]) ** 2)) / _OFF[1]
        on = float(np.exp(-0.5 * (min(value - self.on[0], 0.0) / self.on[1]) ** 2)) / self.on[1]
        return float(min(np.log(((1.0 - CHANGED) * on + CHANGED * off) / off), _LIMIT))


class CorrelationFilter:
    """The filter of one target. width, height: of its box in the first image [px]."""

    def __init__(self, width: float, height: float) -> None:
        window = np.array([width, height]) + (_PADDING - 1.0) * 0.5 * (width + height)
        per_pixel = _AREA_PX / np.sqrt(window[0] * window[1])
        cells = np.maximum(np.rint(window * per_pixel / _CELL).astype(int), 8)
        self._cells = (int(cells[0]), int(cells[1]))
        self._window = window / np.array([width, height])  # over the box
        self._patch = (self._cells[0] * _CELL, self._cells[1] * _CELL)
        hann = np.outer(np.hanning(cells[1] + 2)[1:-1], np.hanning(cells[0] + 2)[1:-1])
        self._hann = hann.astype(np.float32)
        y, x = np.mgrid[: cells[1], : cells[0]].astype(np.float64)
        self._dx = (x - cells[0] // 2, y - cells[1] // 2)
        target = np.array([width, height]) * per_pixel / _CELL  # in cells
        std = _LABEL_STD * float(np.sqrt(target[0] * target[1])) * 2.0
        std = max(std, 0.6)
        label = np.exp(-0.5 * (self._dx[0] ** 2 + self._dx[1] ** 2) / std**2)
        self._label = self._fft(np.fft.ifftshift(label).astype(np.float32))
        middle = 0.5 * (cells - 1.0)
        outside = np.maximum(np.abs(x - middle[0]) - 0.5 * target[0], np.abs(y - middle[1]) - 0.5 * target[1])
        squared = ((x - middle[0]) / (0.5 * target[0])) ** 2 + ((y - middle[1]) / (0.5 * target[1])) ** 2
        self._mask = (np.clip(0.5 - outside, 0.0, 1.0) * np.exp(-0.5 * squared / _CENTRE_STD**2)).astype(np.float32)
        self._exclude = max(1.5, 0.35 * float(target.min()))
        self._filter: Spectrum | None = None
        self._past: Spectrum | None = None  # mean of all that was learnt, against drift
        self._count = 0
        self._on = RunningNormal(*_ON, 4.0, 60.0)
        self._weights = np.full((CHANNELS, 1, 1), 1.0 / CHANNELS, np.float32)

    def learn(self, image: Image, box: OrientedBox, lasting: bool = True) -> None:
        """Learn from the target's box; ``lasting``: also for the filter of the whole past."""
        spectrum = self._spectrum(image, box)
        new, weights = self._train(spectrum)
        if self._filter is None:
            self._filter, self._weights = new, weights
        else:
            rate = np.float32(_LEARNING_RATE)
            self._filter = (1 - rate) * self._filter + rate * new
            self._weights = (1 - rate) * self._weights + rate * weights
        if lasting:
            self._count += 1
            share = np.float32(1.0 / self._count if self._count <= _FIRST_VIEWS else _FORGETTING)
            self._past = new * weights if self._past is None else (1 - share) * self._past + share * new * weights

    def respond(self, image: Image, box: OrientedBox, std: float = np.inf) -> Response:
        """The answer in a window about a box, for a target of its size and angle; std: of its centre [image px].

        The peak is that of the answer times a Cauchy weight: one of its kind beside it may answer more.
        """
        assert self._filter is not None
        assert self._past is not None
        spectrum = self._spectrum(image, box)
        product = (np.conj(self._filter) * spectrum * self._weights).sum(axis=0)
        answer = np.fft.fftshift(scipy.fft.irfft2(product, s=self._cells[::-1]))
        step = box.sides * self._window / np.array(self._cells)
        squared = (self._dx[0] * step[0]) ** 2 + (self._dx[1] * step[1]) ** 2
        row, column = divmod(int((answer / (1.0 + 0.5 * squared / std**2)).argmax()), answer.shape[1])
        peak = float(answer[row, column])
        away = np.maximum(
            np.abs(self._dx[0] - self._dx[0][row, column]), np.abs(self._dx[1] - self._dx[1][row, column])
        )
        product = (np.conj(self._past) * spectrum).sum(axis=0)
        past = np.fft.fftshift(scipy.fft.irfft2(product, s=self._cells[::-1]))
        near, other = float(past[away <= 1.5].max()), float(past[away > self._exclude].max())
        dx = self._dx[0][row, column] + refined(answer[row], column)
        dy = self._dx[1][row, column] + refined(answer[:, column], row)
        offset = box.axes @ (np.array([dx, dy]) * step)
        ratio, on = max(near, 0.0) / max(other, 1e-3), (self._on.mean, self._on.std)
        return Response(float(offset[0]), float(offset[1]), peak, ratio, on)

    def confirm(self, answer: Response, probability: float) -> None:
        """Learn what the filter answers on the target; probability: that this is it."""
        self._on.add(answer.log, probability)

    def _spectrum(self, image: Image, box: OrientedBox) -> Spectrum:
        patch = crop(image, box.sized(box.sides * self._window), self._patch)
        return self._fft(windowed(cell_features(patch, _CELL), self._hann))

    def _fft(self, planes: npt.NDArray[np.float32]) -> Spectrum:
        return np.asarray(scipy.fft.rfft2(planes), np.complex64)

    def _train(self, spectrum: Spectrum) -> tuple[Spectrum, npt.NDArray[np.float32]]:
        """Filter and channel weights of one window (the channel's own peak, its reliability in the publication)."""
        power = (spectrum * np.conj(spectrum)).real
        wanted = spectrum * np.conj(self._label)
        shape = self._cells[::-1]
        scale = np.float32(max(power.mean(), 1e-12))  # 0 where the window has one colour
        power, wanted = power / scale, wanted / scale
        found = wanted / (power + np.float32(_REGULARISATION))
        found = self._fft(scipy.fft.irfft2(found, s=shape) * self._mask)
        dual = np.zeros_like(found)
        penalty = np.float32(_PENALTY)
        for _ in range(_ITERATIONS):
            free = (wanted + penalty * found - dual) / (power + penalty)
            masked = scipy.fft.irfft2(penalty * free + dual, s=shape) * self._mask
            found = self._fft(masked / (np.float32(_REGULARISATION) + penalty))
            dual = dual + penalty * (free - found)
            penalty = penalty * np.float32(_PENALTY_GROWTH)
        answers = scipy.fft.irfft2(np.conj(found) * spectrum, s=shape)
        weights = np.maximum(answers.reshape(len(answers), -1).max(axis=1), 1e-6)
        weights = (weights / weights.sum()).astype(np.float32)[:, None, None]
        return found.astype(np.complex64), weights


def windowed(features: Features, window: npt.NDArray[np.float32]) -> Features:
    """Features without their mean, times the window: else the window itself would be what the filter locks on to."""
    mean = (features * window).sum(axis=(1, 2), keepdims=True) / window.sum()
    return np.asarray((features - mean) * window, np.float32)


def refined(values: npt.NDArray[np.floating], at: int) -> float:
    """Offset of the maximum of a parabola through a maximum and its two neighbours (cyclic)."""
    left, mid, right = float(values[at - 1]), float(values[at]), float(values[(at + 1) % len(values)])
    curvature = left - 2.0 * mid + right
    return float(np.clip(0.5 * (left - right) / curvature, -0.5, 0.5)) if curvature < -1e-6 else 0.0
