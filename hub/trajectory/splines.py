"""Uniform cubic B-splines over separate stretches of time, and their robust banded fit.

One basis serves the smoothing of an image track (hub.timing) and the 3-D trajectory of the joint
adjustment (hub.poses). A stretch is a span without long gaps; each has its own control points, and all
control points lie in one vector, so that every normal matrix is banded.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solveh_banded

from protocols.geometry.types import Bools, Floats, Ints

SUPPORT = 4
"""Control points that act at one time."""


@dataclass(frozen=True, slots=True, eq=False)
class SplineBasis:
    """Cubic B-splines with knots every ``spacing`` seconds (``widths`` in truth) on each stretch.

    starts: (s,) first knot of each stretch [s]. intervals: (s,) knot intervals of each.
    """

    spacing: float
    starts: Floats
    intervals: Ints
    widths: Floats
    """(s,) knot interval of each stretch [s]: ``spacing``, or a little less where a stretch is filled exactly."""
    offsets: Ints = field(init=False)
    """(s,) index of each stretch's first control point."""

    def __post_init__(self) -> None:
        each = self.intervals + 3
        object.__setattr__(self, "offsets", np.cumsum(each) - each)

    @classmethod
    def over(cls, begins: Floats, ends: Floats, spacing: float) -> SplineBasis:
        """A basis that covers the stretches [begins[i], ends[i]], sorted and disjoint."""
        intervals = np.maximum(1, np.ceil((ends - begins) / spacing - 1e-9)).astype(np.int64)
        # A stretch that is no multiple of the spacing is covered evenly from both sides.
        starts = begins - 0.5 * (intervals * spacing - (ends - begins))
        return cls(spacing, starts, intervals, np.full(len(starts), spacing))

    @classmethod
    def within(cls, begins: Floats, ends: Floats, spacing: float) -> SplineBasis:
        """A basis whose stretches are exactly [begins[i], ends[i]], so that they may follow each other at once."""
        intervals = np.maximum(1, np.ceil((ends - begins) / spacing - 1e-9)).astype(np.int64)
        return cls(spacing, begins, intervals, np.maximum((ends - begins) / intervals, 1e-9))

    @property
    def size(self) -> int:
        """Number of control points."""
        return int(self.intervals.sum() + 3 * len(self.intervals))

    @property
    def begin(self) -> float:
        """First time of the first stretch [s]."""
        return float(self.starts[0])

    @property
    def end(self) -> float:
        """Last time of the last stretch [s]."""
        return float(self.starts[-1] + self.intervals[-1] * self.widths[-1])

    @property
    def middles(self) -> Floats:
        """(size,) times about which the control points act [s]."""
        stretches = zip(self.starts, self.widths, self.intervals, strict=True)
        return np.concatenate([start + width * (np.arange(count + 3) - 1.0) for start, width, count in stretches])

    def locate(self, time: Floats, beyond: float = 0.0) -> tuple[Ints, Floats, Bools, Floats]:
        """First control point (n,), place in the knot interval (n,) in [0, 1], inside a stretch (n,), width (n,).

        beyond: knot intervals by which the polynomials at a stretch's ends go on; there the place is outside [0, 1].
        """
        known = np.isfinite(time)
        if not known.all():
            time = np.where(known, time, self.starts[0])
        stretch = np.searchsorted(self.starts - beyond * self.widths, time, side="right") - 1
        inside = known & (stretch >= 0)
        np.maximum(stretch, 0, out=stretch)
        width = self.widths[stretch]
        place = (time - self.starts[stretch]) / width
        count = self.intervals[stretch]
        inside &= place <= count + beyond + 1e-9
        interval = np.clip(place, 0.0, count - 1.0).astype(np.int64)
        place -= interval
        return self.offsets[stretch] + interval, place, inside, width

    def weights(self, time: Floats, derivative: int = 0) -> tuple[Ints, Floats, Bools]:
        """First control point (n,), the 4 weights (n, 4), and whether inside a stretch (n,).

        derivative: 0 value, 1 first, 2 second derivative by time.
        """
        index, u, inside, width = self.locate(time)
        weights = basis_weights(u, derivative)
        if derivative:
            weights /= (width**derivative)[:, None]
        return index, weights, inside

    def weights_both(self, time: Floats, beyond: float = 0.0) -> tuple[Ints, Floats, Floats, Bools]:
        """First control point (n,), the weights of value and of first derivative (n, 4) each, inside (n,).

        beyond: as for `locate`.
        """
        index, u, inside, width = self.locate(time, beyond)
        return index, basis_weights(u), basis_weights(u, 1) / width[:, None], inside

    def evaluate(self, control: Floats, time: Floats, derivative: int = 0) -> Floats:
        """Values (n, d) at ``time`` of the spline with ``control`` (size, d); NaN outside the stretches."""
        index, weights, inside = self.weights(time, derivative)
        values = combined(control, index, weights)
        if not inside.all():
            values[~inside] = np.nan
        return values

    def evaluate_both(self, control: Floats, time: Floats) -> tuple[Floats, Floats]:
        """Values and first derivatives, (n, d) each, at ``time``; NaN outside the stretches."""
        index, u, inside, width = self.locate(time)
        values = combined(control, index, basis_weights(u))
        slopes = combined(control, index, basis_weights(u, 1)) / width[:, None]
        if not inside.all():
            values[~inside] = np.nan
            slopes[~inside] = np.nan
        return values, slopes

    def scaled(self, factor: float) -> SplineBasis:
        """The same basis on a time axis stretched by ``factor``."""
        return SplineBasis(self.spacing * factor, self.starts * factor, self.intervals, self.widths * factor)

    def interval_starts(self) -> Ints:
        """(m,) first control point of every knot interval."""
        return np.concatenate(
            [offset + np.arange(count) for offset, count in zip(self.offsets, self.intervals, strict=True)]
        )


def basis_weights(u: Floats, derivative: int = 0) -> Floats:
    """The four cubic B-spline weights (n, 4), or a derivative by u, at u in [0, 1] of a knot interval."""
    v = 1.0 - u
    out = np.empty((SUPPORT, len(u)))
    if derivative == 0:
        square = u * u
        cube = square * u
        out[0] = v * v * v
        out[1] = 3 * cube - 6 * square + 4
        out[2] = -3 * cube + 3 * square + 3 * u + 1
        out[3] = cube
    elif derivative == 1:
        square = u * u
        out[0] = -3 * v * v
        out[1] = 9 * square - 12 * u
        out[2] = -9 * square + 6 * u + 3
        out[3] = 3 * square
    else:
        out[0], out[1], out[2], out[3] = 6 * v, 18 * u - 12, -18 * u + 6, 6 * u
    out /= 6.0
    return out.T


def combined(control: Floats, index: Ints, weights: Floats) -> Floats:
    """Sums (n, d) of four control points from ``index`` (n,) on, of ``control`` (size, d), with ``weights`` (n, 4)."""
    out = np.empty((control.shape[1], len(index)))
    # Coordinate by coordinate: numpy is slow along axes of two or three.
    for values, column in zip(out, np.ascontiguousarray(control.T), strict=True):
        np.multiply(weights[:, 0], column.take(index), out=values)
        for k in range(1, SUPPORT):
            values += weights[:, k] * column[k:].take(index)
    return out.T


def normal_bands(index: Ints, weights: Floats, row_weight: Floats, size: int) -> Floats:
    """Upper bands (4, size) of the normal matrix of rows with ``weights`` (n, 4) at ``index`` (n,)."""
    bands = np.zeros((SUPPORT, size))
    for a in range(SUPPORT):
        for b in range(a, SUPPORT):
            products = row_weight * weights[:, a] * weights[:, b]
            bands[SUPPORT - 1 - (b - a)] += np.bincount(index + b, products, minlength=size)
    return bands


def fit_spline(basis: SplineBasis, time: Floats, values: Floats, row_weight: Floats, stiffness: float = 1e-6) -> Floats:
    """Weighted least-squares control points (size, d) of ``values`` (n, d) at ``time`` (n,).

    stiffness: weight of squared third differences relative to one row; only closes empty intervals.
    """
    index, weights, inside = basis.weights(time)
    used = np.where(inside, row_weight, 0.0)
    bands = normal_bands(index, weights, used, basis.size)
    intervals = basis.interval_starts()
    third = np.tile(np.array([-1.0, 3.0, -3.0, 1.0]), (len(intervals), 1))
    bands += normal_bands(intervals, third, np.full(len(intervals), stiffness), basis.size)
    bands[-1] += 1e-12
    target = np.zeros((basis.size, values.shape[1]))
    for d in range(values.shape[1]):
        for k in range(SUPPORT):
            target[:, d] += np.bincount(index + k, used * weights[:, k] * values[:, d], minlength=basis.size)
    return np.asarray(solveh_banded(bands, target, check_finite=False))


def stretches(time: Floats, longest_gap: float, piece: Ints | None = None) -> tuple[Floats, Floats]:
    """Begins and ends of the stretches of sorted ``time`` (n,) that no gap over ``longest_gap`` cuts.

    piece: (n,) rising numbers; where they change, a stretch ends too.
    """
    if len(time) == 0:
        return np.zeros(0), np.zeros(0)
    apart = np.diff(time) > longest_gap
    if piece is not None:
        apart |= np.diff(piece) > 0
    cuts = np.flatnonzero(apart)
    return time[np.r_[0, cuts + 1]], time[np.r_[cuts, len(time) - 1]]
