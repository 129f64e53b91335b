"""Delays of a camera's frames, arrival at the hub less device time, as lines over time: their bends and jumps.

Each bin is the frame with the lowest delay of half a second. An estimator's arithmetic; what is made of it stands in
`clock_watch`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from protocols.geometry.types import Floats

DRIFT = 1e-4
"""Least change of rate that is told; crystals change by a tenth of it with the temperature."""
MOST_DRIFT = 2e-3
"""Greatest change of rate that is one: no crystal does more. Beyond, frames are held up on their way, more and more."""
SPANS = (4, 5, 6, 8, 12)
"""Bins since the bend, any of which may tell it."""
LEVEL = 4
"""Bins by which the delay just before the bend is told."""
LEAST_S = 2e-5
"""Scatter of delays that is always reckoned with."""
_MOST_SOON = 6e-4
"""As MOST_DRIFT while there are only few seconds of it: clocks are slewed at 500 ppm. Faster ones await more."""
_SIGMAS = 6.0
_CROOKED = 0.15
"""What an even rise may leave of itself, for it did not begin with a bin"""
_UNLIKE_A_JUMP = 0.3
"""What it may leave of what a jump of delays would"""
_LATE_BINS = 4
"""From so many late ones in a row on they are no chance"""
_USUALLY = 1.2
"""So few bins tell their spread too small now and then"""


@dataclass(slots=True)
class Rise:
    """A drift that was told, while the seconds after it tell it better. number: of the event.

    first_at, first_rise: the bend as first told, at device time ``told``. line, sigma: of the delays before it.
    count … product: sums over the bins since the bend of 1, time, its square, the delay over the line, their product;
    times from first_at. late: bins in a row that were far later than awaited.
    """

    number: int
    first_at: float
    told: float
    line: tuple[float, float]
    sigma: float
    at: float
    rise: float
    first_rise: float
    count: int = 0
    time: float = 0.0
    square: float = 0.0
    delay: float = 0.0
    product: float = 0.0
    late: int = 0

    def take(self, time: float, delay: float) -> None:
        """One more bin: the line through what delays are over the old one."""
        over = delay - self.line[0] - self.line[1] * time
        awaited = self.rise * (time - self.at)
        room = 4.0 * self.sigma + 1e-4
        # Frames that are held up for once tell nothing; what comes sooner than awaited, or is late for long, does.
        self.late = self.late + 1 if over > awaited + room else 0
        if 0 < self.late < _LATE_BINS:
            over = awaited + room
        time -= self.first_at
        self.count += 1
        self.time += time
        self.square += time * time
        self.delay += over
        self.product += time * over
        spread = self.square - self.time * self.time / self.count
        if spread <= 0.0:
            return
        rise = (self.product - self.time * self.delay / self.count) / spread
        at = (self.time - self.delay / rise) / self.count if rise != 0.0 else 0.0
        if rise * self.rise <= 0.0 or not abs(at) <= 1.0:
            # It did not begin that long before or after: then the rate alone is told.
            at = min(max(at, -1.0), 1.0) if rise * self.rise > 0.0 else 0.0
            rise = (self.product - at * self.delay) / (self.square - 2.0 * at * self.time + self.count * at * at)
        self.at, self.rise = self.first_at + at, rise


@dataclass(slots=True)
class Jump:
    """A step that was told by two time stamps, while delays after it tell it better. number: of the event.

    step, std: as first told [s]. line, sigma: of the delays before it, on the old clock. count, total: of the bins
    after it, and of the steps that each tells.
    """

    number: int
    step: float
    std: float
    line: tuple[float, float]
    sigma: float
    count: int = 0
    total: float = 0.0
    heard: int = 0

    def take(self, time: float, delay: float) -> tuple[float, float]:
        """One more bin, on the new clock; returns the step as it is known by now, and its std [s]."""
        # What was put into the new clock is missing from the delay: delay + step = level + slope (time - step).
        told = (self.line[0] + self.line[1] * time - delay) / (1.0 + self.line[1])
        self.heard += 1
        if abs(told - self.step) < 5.0 * float(np.hypot(self.std, self.sigma)):  # else the way is another one too
            self.count += 1
            self.total += told
        if not self.count:
            return self.step, self.std
        # The bins before err together: more than a few after tell no more.
        stamps, delays = 1.0 / self.std**2, min(self.count, 3) / self.sigma**2
        mean = (stamps * self.step + delays * self.total / self.count) / (stamps + delays)
        return mean, float(1.0 / np.sqrt(stamps + delays))


def left_its_line(bins: Floats, span: int, known: float) -> bool:
    """Whether delays (n, 2) rise or fall evenly over the last ``span`` bins as they never did in as many before.

    known: how steeply they usually do, over longer than these bins.
    """
    level, slope, sigma = line(bins[:-span])
    time, over = bins[:, 0], bins[:, 1] - level - slope * bins[:, 0]
    # Over what they were just before, at every place: the last one is judged by all that have no part in it.
    before = np.convolve(over, np.full(LEVEL, 1.0 / LEVEL), "valid")[:-span]
    since = sliding_window_view(time, span + 1)[LEVEL - 1 :]
    since = since[:, 1:] - since[:, :1]
    rise = sliding_window_view(over, span)[LEVEL:] - before[:, None]
    weight = (since**2).sum(axis=1)
    slopes = (since * rise).sum(axis=1) / weight
    change = float(slopes[-1])
    most = MOST_DRIFT if span == SPANS[-1] else _MOST_SOON
    if not DRIFT < abs(change) < most:
        return False
    usual = _USUALLY * max(float(np.sqrt((slopes[:-span] ** 2).mean())), known)
    if abs(change) <= _SIGMAS * float(np.hypot(usual, sigma / np.sqrt(weight[-1]))):
        return False
    left = rise[-1] - change * since[-1]
    beside = float(left @ left)
    if beside > span * float(np.hypot(_CROOKED * change * since[-1, -1], 1.3 * sigma)) ** 2:
        return False
    # A delay that is another one from some frame on, the route being another, is no rise.
    return beside < _UNLIKE_A_JUMP * min(_jump(rise[-1], first) for first in range(span - 1))


def _jump(over: Floats, first: int) -> float:
    """Sum of squares that a jump of delays (n,) before the one at ``first`` leaves."""
    return float((over[:first] ** 2).sum() + ((over[first:] - over[first:].mean()) ** 2).sum())


def bend(bins: Floats, span: int) -> tuple[float, float]:
    """When delays (n, 2) left their old line, and by how much they rise faster since then.

    The line with one bend about the last ``span`` bins that fits best; its place is one of a grid, six to a bin.
    """
    time, delay = bins[:, 0], bins[:, 1]
    best, found = np.inf, (0.0, 0.0)
    for at in np.linspace(time[-span - 3], time[-3], 6 * span + 1):
        rows = np.column_stack([np.ones_like(time), time, np.maximum(time - at, 0.0)])
        fitted = np.linalg.lstsq(rows, delay, rcond=None)[0]
        left = float(((rows @ fitted - delay) ** 2).sum())
        if left < best:
            best, found = left, (float(at), float(fitted[2]))
    return found


def line(bins: Floats) -> tuple[float, float, float]:
    """Delay at time 0 and slope of the line through bins (n, 2), and the scatter around it, never below LEAST_S."""
    time, delay = bins[:, 0], bins[:, 1]
    middle, mean = float(time.mean()), float(delay.mean())
    away = time - middle
    slope = float(away @ delay) / float(away @ away)
    rest = delay - mean - slope * away
    return mean - slope * middle, slope, max(float(np.sqrt(rest @ rest / max(len(bins) - 2, 1))), LEAST_S)
