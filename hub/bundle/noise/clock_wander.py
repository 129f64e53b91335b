"""Clock wander: slow changes of a clock's rate, estimated from the time shifts of its frames.

A time service slews a clock by hundreds of ppm, and a crystal that warms up drifts by some ppm. What such a clock shows
beside an even one is an integrated random walk of its rate (random-walk frequency modulation): a smoothing spline whose
noise is found by restricted maximum likelihood, which leaves offset and rate free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocols.geometry.types import Floats

_KNOT_S, _MOST_KNOTS, _LEAST_KNOTS = 1.0, 60, 4
"""Least distance of knots [s], and most and least of one camera: in ten minutes one every ten seconds."""
_RATE_NOISE = np.geomspace(1e-8, 1e-4, 9)
"""Random-walk noise of the rate [1/sqrt(s)]: from an even clock's to that of one slewed by 500 ppm, the most that NTP
does, for a part of a minute."""
_MOST_RATE_CHANGE = 1e-3
"""Range of the rates (a tenth of them beyond either end) of two clocks that are slewed by 500 ppm against each other.
What changes more is no clock: one camera's labels of a recorded rig ask for 1.9e-3, and slewed clocks for 4.5e-4."""


@dataclass(frozen=True, slots=True, eq=False)
class Wander:
    """By how much frames are later than a camera's clock shows, beside an even clock that agrees with it in offset and
    rate at ``instant`` [s].

    camera: index. knots, values: (m,) [s], linear between them. gain: of twice the log-likelihood. std, rate_std: of
    the clock [s] and of its rate at the instant, beyond those of an even one.
    """

    camera: int
    instant: float
    knots: Floats
    values: Floats
    gain: float
    std: float
    rate_std: float

    @property
    def is_plausible(self) -> bool:
        """Whether a clock's rate may change by so much."""
        rates = np.diff(self.values) / np.diff(self.knots)
        return float(np.ptp(np.quantile(rates, [0.1, 0.9]))) < _MOST_RATE_CHANGE

    def at(self, time: Floats) -> Floats:
        """(n,) [s] at camera times (n,); beyond the knots at the last rate."""
        index = np.clip(np.searchsorted(self.knots, time) - 1, 0, len(self.knots) - 2)
        slope = np.diff(self.values) / np.diff(self.knots)
        return np.asarray(self.values[index] + slope[index] * (time - self.knots[index]))


def fit_wander(camera: int, time: Floats, shift: Floats, weight: Floats, instant: float) -> Wander | None:
    """The most probable wander of a camera whose frames at ``time`` (n,), increasing, are later by ``shift`` (n,) [s].

    weight: (n,) [1/s²] of the shifts. None where the time is too short for any.
    """
    count = min(int(np.ptp(time) / _KNOT_S) + 1, _MOST_KNOTS)
    if count < _LEAST_KNOTS:
        return None
    knots = np.linspace(time[0], time[-1], count)
    width = float(knots[1] - knots[0])
    index = np.minimum(((time - knots[0]) / width).astype(np.int64), count - 2)
    design, rows = np.zeros((len(time), count)), np.arange(len(time))
    design[rows, index + 1] = (time - knots[index]) / width
    design[rows, index] = 1.0 - design[rows, index + 1]
    normal, right = design.T @ (weight[:, None] * design), design.T @ (weight * shift)
    bend = np.diff(np.eye(count), 2, axis=0)  # changes of the rate, times the distance of two knots
    precision = normal + (bend.T @ bend / width**3) / _RATE_NOISE[:, None, None] ** 2
    solved = np.linalg.solve(precision, np.broadcast_to(right[:, None], (len(_RATE_NOISE), count, 1)))[:, :, 0]
    cost = np.linalg.slogdet(precision)[1] + 2 * (count - 2) * np.log(_RATE_NOISE) - solved @ right
    best = int(np.argmin(cost))
    curve = Wander(camera, instant, knots, solved[best], float(cost[0] - cost[best]), 0.0, 0.0)
    place = np.clip(instant, knots[0] + width, knots[-1] - width)
    slope = np.interp(knots, place + np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) * width, [0.0, -0.5, 0.0, 0.5, 0.0]) / width
    at = np.maximum(1.0 - np.abs(knots - np.clip(instant, knots[0], knots[-1])) / width, 0.0)
    values = curve.values - curve.at(np.array([instant])) - (slope @ curve.values) * (knots - instant)
    more = np.linalg.inv(precision[best]) - np.linalg.inv(precision[0])
    std, rate_std = (float(np.sqrt(max(one @ more @ one, 0.0))) for one in (at, slope))
    return Wander(camera, instant, knots, values, curve.gain, std, rate_std)
