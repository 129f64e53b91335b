"""Changepoint fits to frame delays (arrival at the hub less device time): a change of slope, or a step.

Each bin holds the frame with the lowest delay of half a second. Pure arithmetic; the detector that uses it is
`hub.clocks.change_detector`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from protocols.geometry.types import Floats

MIN_RATE_CHANGE = 1e-4
"""Smallest rate change that is reported; with temperature, crystals change by a tenth of it."""
MAX_RATE_CHANGE = 2e-3
"""Largest plausible rate change: no crystal does more. A steeper slope is a growing network or processing delay."""
WINDOW_BINS = (4, 5, 6, 8, 12)
"""Lengths, in bins, of the windows after a possible changepoint; each is tested."""
LEVEL_BINS = 4
"""Bins that are averaged for the delay just before the changepoint."""
MIN_SCATTER_S = 2e-5
"""Lower bound of the scatter of delays [s]."""
_MAX_EARLY_RATE_CHANGE = 6e-4
"""As MAX_RATE_CHANGE for the shorter windows: time services slew at 500 ppm. Faster changes need the longest window."""
_DETECTION_SIGMAS = 6.0  # two in 10^9 by chance
_RAMP_MISFIT = 0.15
"""Residual of a ramp relative to its height: its onset does not coincide with a bin"""
_MAX_RAMP_TO_STEP_MISFIT = 0.3
"""Largest ratio of the ramp's to the step's sum of squared residuals"""
_PERSISTENT_LATE_BINS = 4
"""As many late bins in a row are taken as real, not as single delayed frames"""
_RECENT_BINS = 20  # 10 s: half of those that refine a rate change
_SMALL_SAMPLE_FACTOR = 1.2
"""A scatter from so few bins is sometimes underestimated"""


@dataclass(slots=True)
class RateChangeEstimator:
    """Least-squares refinement of a detected rate change by the bins after it. Times in device seconds.

    change_index: of the change in the detector's list. first_onset, first_slope_change: the changepoint as first
    estimated, at device time ``detected_at``. baseline, sigma: line (delay at time 0, slope) and scatter of the delays
    before it. count, sum_t, sum_tt, sum_d, sum_td: sums over the bins since the onset of 1, t, t², d and t d, with t
    from first_onset and d the delay in excess of the baseline. late_in_a_row: consecutive bins far later than expected.
    """

    change_index: int
    first_onset: float
    detected_at: float
    baseline: tuple[float, float]
    sigma: float
    onset: float
    slope_change: float
    first_slope_change: float
    count: int = 0
    sum_t: float = 0.0
    sum_tt: float = 0.0
    sum_d: float = 0.0
    sum_td: float = 0.0
    late_in_a_row: int = 0
    recent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_RECENT_BINS))
    """The last excess delays"""

    @property
    def recent_slope(self) -> float:
        """Slope of the last excess delays by themselves: where the delay has changed and stays, there is none."""
        return fit_line(np.array(self.recent))[1]

    def update(self, time: float, delay: float) -> None:
        """Add one bin and fit the line of the excess delays again."""
        excess = delay - self.baseline[0] - self.baseline[1] * time
        expected = self.slope_change * (time - self.onset)
        margin = 4.0 * self.sigma + 1e-4
        # A single delayed frame carries no information; one earlier than expected, or persistent lateness, does.
        self.late_in_a_row = self.late_in_a_row + 1 if excess > expected + margin else 0
        if 0 < self.late_in_a_row < _PERSISTENT_LATE_BINS:
            excess = expected + margin
        time -= self.first_onset
        self.recent.append((time, excess))
        self.count += 1
        self.sum_t += time
        self.sum_tt += time * time
        self.sum_d += excess
        self.sum_td += time * excess
        spread = self.sum_tt - self.sum_t * self.sum_t / self.count
        if spread <= 0.0:
            return
        slope_change = (self.sum_td - self.sum_t * self.sum_d / self.count) / spread
        at = (self.sum_t - self.sum_d / slope_change) / self.count if slope_change != 0.0 else 0.0
        if slope_change * self.slope_change <= 0.0 or not abs(at) <= 1.0:
            # The onset cannot be that far from the first estimate: bound it and estimate the slope alone.
            at = min(max(at, -1.0), 1.0) if slope_change * self.slope_change > 0.0 else 0.0
            slope_change = (self.sum_td - at * self.sum_d) / (
                self.sum_tt - 2.0 * at * self.sum_t + self.count * at * at
            )
        self.onset, self.slope_change = self.first_onset + at, slope_change


@dataclass(slots=True)
class StepEstimator:
    """Refinement of a detected clock step by the delays after it.

    change_index: of the change in the detector's list. step, std: first estimate from two time stamps [s]. baseline,
    sigma: line (delay at time 0, slope) and scatter of the delays before it, on the old clock. count, total: number of
    accepted bins after it, and the sum of their steps. bins_seen: number of all bins after it.
    """

    change_index: int
    step: float
    std: float
    baseline: tuple[float, float]
    sigma: float
    count: int = 0
    total: float = 0.0
    bins_seen: int = 0

    def update(self, time: float, delay: float) -> tuple[float, float]:
        """Add one bin, on the new clock; returns the present estimate of the step and its std [s]."""
        # The step of the clock lowers the delay by as much: delay + step = level + slope (time - step).
        observed = (self.baseline[0] + self.baseline[1] * time - delay) / (1.0 + self.baseline[1])
        self.bins_seen += 1
        if abs(observed - self.step) < 5.0 * float(np.hypot(self.std, self.sigma)):  # else the network path changed too
            self.count += 1
            self.total += observed
        if not self.count:
            return self.step, self.std
        # The error of the baseline is common to all bins: more than a few of them add nothing.
        stamps, delays = 1.0 / self.std**2, min(self.count, 3) / self.sigma**2
        mean = (stamps * self.step + delays * self.total / self.count) / (stamps + delays)
        return mean, float(1.0 / np.sqrt(stamps + delays))


def slope_has_changed(bins: Floats, span: int, expected_slope: float) -> bool:
    """Test for a slope change over the last ``span`` of the bins (n, 2): device time, delay [s].

    The slope must be significant against the slopes of all earlier windows of the same length, within the plausible
    rates, and must fit better than a step. expected_slope: rms of slopes over a longer past than these bins.
    """
    level, slope, sigma = fit_line(bins[:-span])
    time, excess = bins[:, 0], bins[:, 1] - level - slope * bins[:, 0]
    # Delays over the level just before each window; the last window is compared with those that do not overlap it.
    before = np.convolve(excess, np.full(LEVEL_BINS, 1.0 / LEVEL_BINS), "valid")[:-span]
    since = sliding_window_view(time, span + 1)[LEVEL_BINS - 1 :]
    since = since[:, 1:] - since[:, :1]
    rise = sliding_window_view(excess, span)[LEVEL_BINS:] - before[:, None]
    weight = (since**2).sum(axis=1)
    slopes = (since * rise).sum(axis=1) / weight
    change = float(slopes[-1])
    most = MAX_RATE_CHANGE if span == WINDOW_BINS[-1] else _MAX_EARLY_RATE_CHANGE
    if not MIN_RATE_CHANGE < abs(change) < most:
        return False
    usual_slope = _SMALL_SAMPLE_FACTOR * max(float(np.sqrt((slopes[:-span] ** 2).mean())), expected_slope)
    if abs(change) <= _DETECTION_SIGMAS * float(np.hypot(usual_slope, sigma / np.sqrt(weight[-1]))):
        return False
    residual = rise[-1] - change * since[-1]
    ramp_misfit = float(residual @ residual)
    if ramp_misfit > span * float(np.hypot(_RAMP_MISFIT * change * since[-1, -1], 1.3 * sigma)) ** 2:
        return False
    # A delay that changes at one frame and stays (another route) is a step, not a ramp.
    return ramp_misfit < _MAX_RAMP_TO_STEP_MISFIT * min(_step_misfit(rise[-1], first) for first in range(span - 1))


def _step_misfit(excess: Floats, first: int) -> float:
    """Sum of squared residuals of excess delays (n,) about a step just before index ``first``."""
    return float((excess[:first] ** 2).sum() + ((excess[first:] - excess[first:].mean()) ** 2).sum())


def fit_changepoint(bins: Floats, span: int) -> tuple[float, float]:
    """Onset time [s] and change of slope of the best continuous two-segment line through the bins (n, 2).

    The onset is searched on a grid of six places a bin about the beginning of the last ``span`` bins.
    """
    time, delay = bins[:, 0], bins[:, 1]
    best, found = np.inf, (0.0, 0.0)
    for at in np.linspace(time[-span - 3], time[-3], 6 * span + 1):
        rows = np.column_stack([np.ones_like(time), time, np.maximum(time - at, 0.0)])
        fitted = np.linalg.lstsq(rows, delay, rcond=None)[0]
        misfit = float(((rows @ fitted - delay) ** 2).sum())
        if misfit < best:
            best, found = misfit, (float(at), float(fitted[2]))
    return found


def fit_line(bins: Floats) -> tuple[float, float, float]:
    """Delay at time 0, slope and residual scatter (at least MIN_SCATTER_S) of the line through the bins (n, 2)."""
    time, delay = bins[:, 0], bins[:, 1]
    middle, mean = float(time.mean()), float(delay.mean())
    away = time - middle
    slope = float(away @ delay) / float(away @ away)
    rest = delay - mean - slope * away
    return mean - slope * middle, slope, max(float(np.sqrt(rest @ rest / max(len(bins) - 2, 1))), MIN_SCATTER_S)
