"""Discrete-time trajectories for a shared clock: observations of equal time correspond; no smoothness is assumed.

``PointBasis`` and ``SampledTrack`` replace ``SplineBasis`` and ``SmoothTrack``, which serve independent clocks: every
instant has its own point, and there is none between instants.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.trajectory.splines import SUPPORT
from protocols.geometry.types import Bools, Floats, Ints

INSTANT_TOLERANCE_S = 1e-6
"""Times [s] that differ by less are the same instant: CSV files round."""


@dataclass(frozen=True, slots=True, eq=False)
class PointBasis:
    """One point per instant. instants: (n,) sorted times [s].

    It has the interface of a cubic spline basis (four weights a time, three of them 0), so that the same banded
    system serves both.
    """

    instants: Floats

    @property
    def size(self) -> int:
        """Number of control points; the last three are unused."""
        return len(self.instants) + SUPPORT - 1

    @property
    def spacing(self) -> float:
        """Median interval between instants [s]."""
        return float(np.median(np.diff(self.instants))) if len(self.instants) > 1 else 1.0

    @property
    def begin(self) -> float:
        """First instant [s]."""
        return float(self.instants[0])

    @property
    def end(self) -> float:
        """Last instant [s]."""
        return float(self.instants[-1])

    def locate(self, time: Floats) -> tuple[Ints, Floats, Bools]:
        """Index of the instant (n,), 0 (n,), and whether there is one (n,)."""
        index, found = find_instants(self.instants, time)
        return index, np.zeros(len(time)), found

    def weights(self, time: Floats, derivative: int = 0) -> tuple[Ints, Floats, Bools]:
        """Index (n,), weights (n, 4) and whether there is a point (n,); a point has no velocity."""
        index, found = find_instants(self.instants, time)
        weights = np.zeros((len(time), SUPPORT))
        if derivative == 0:
            weights[:, 0] = 1.0
        return index, weights, found

    def weights_and_derivatives(self, time: Floats, extrapolation: float = 0.0) -> tuple[Ints, Floats, Floats, Bools]:
        """As `weights`, for the value and the first derivative, which is 0; ``extrapolation`` has no effect."""
        index, weights, found = self.weights(time)
        return index, weights, np.zeros_like(weights), found

    def evaluate(self, control: Floats, time: Floats, derivative: int = 0) -> Floats:
        """Values (n, d); NaN where there is no point."""
        index, weights, found = self.weights(time, derivative)
        values = weights[:, :1] * control[index]
        values[~found] = np.nan
        return values

    def interval_starts(self) -> Ints:
        """(0,): no knot intervals, hence no smoothness prior."""
        return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class SampledTrack:
    """One label of one camera at its instants, in normalised coordinates; see ``SmoothTrack``."""

    time_origin: float
    time: Floats
    points: Floats
    inlier: Bools
    basis: PointBasis
    sigma: float
    focal: float

    def at(self, time: Floats, derivative: int = 0) -> Floats:
        """Points (n, 2) at instants of the track, NaN elsewhere; derivatives are 0."""
        return self.basis.evaluate(self.points, time, derivative)

    @property
    def sigma_px(self) -> float:
        """Noise of one coordinate [px]."""
        return self.sigma * self.focal

    @property
    def span(self) -> float:
        """Seconds from the first to the last row."""
        return float(self.time[-1] - self.time[0])


def sampled_track(time: Floats, normalised: Floats, focal: float, time_origin: float) -> SampledTrack | None:
    """The rows unchanged; None if the lens model can undistort none of them."""
    good = np.asarray(np.isfinite(normalised).all(axis=1))
    if not good.any():
        return None
    shifted = time[good] - time_origin
    return SampledTrack(time_origin, shifted, normalised[good], good, PointBasis(shifted), 0.5 / focal, focal)


def find_instants(instants: Floats, time: Floats) -> tuple[Ints, Bools]:
    """Index of the nearest instant to each time (n,), and whether it is within INSTANT_TOLERANCE_S."""
    if len(instants) == 0:
        return np.zeros(len(time), dtype=np.int64), np.zeros(len(time), dtype=np.bool_)
    after = np.clip(np.searchsorted(instants, time), 0, len(instants) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(instants[before] - time) < np.abs(instants[after] - time)
    index = np.where(nearer, before, after)
    return index.astype(np.int64), np.asarray(np.abs(instants[index] - time) < INSTANT_TOLERANCE_S)


def merged_instants(times: list[Floats]) -> Floats:
    """All instants (n,) of several tracks, merged within INSTANT_TOLERANCE_S."""
    joined = np.sort(np.concatenate(times)) if times else np.zeros(0)
    if len(joined) == 0:
        return joined
    return joined[np.r_[True, np.diff(joined) > INSTANT_TOLERANCE_S]]
