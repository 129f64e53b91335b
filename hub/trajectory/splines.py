"""Uniform cubic B-splines over disjoint stretches of time, their banded least-squares fit, and Cholesky factors.

One basis serves the smoothing of image tracks (`hub.trajectory.image_tracks`) and the 3-D trajectories of the bundle
adjustment (`hub.bundle`). A stretch is a time span without long gaps; each has its own control points, and all
control points lie in one vector, so that every normal matrix is banded.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg.lapack import dpbsv, dpbtrf, dpbtrs, dptsv, dtbtrs

from protocols.geometry import kernels
from protocols.geometry.types import Bools, Floats, Ints

SUPPORT = 4
"""Control points with non-zero weight at one time (the order of a cubic spline)."""
_POWERS = np.array([[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]) / 6.0
"""Coefficients of 1, u, u², u³ of the four weights."""


@dataclass(frozen=True, slots=True, eq=False)
class SplineBasis:
    """Cubic B-splines with knots about every ``spacing`` seconds (exactly: ``widths``) on each stretch.

    starts: (s,) first knot of each stretch [s]. intervals: (s,) knot intervals of each.
    """

    spacing: float
    starts: Floats
    intervals: Ints
    widths: Floats
    """(s,) knot interval of each stretch [s]: ``spacing``, or slightly less where a stretch is covered exactly."""
    offsets: Ints = field(init=False)
    """(s,) index of each stretch's first control point."""
    table: Floats = field(init=False)
    """(4, s) starts, widths, intervals and offsets, for the compiled kernels."""

    def __post_init__(self) -> None:
        each = self.intervals + 3
        object.__setattr__(self, "offsets", np.cumsum(each) - each)
        table = np.array([self.starts, self.widths, self.intervals, self.offsets], dtype=np.float64)
        object.__setattr__(self, "table", table)

    @classmethod
    def covering(cls, begins: Floats, ends: Floats, spacing: float) -> SplineBasis:
        """A basis that covers the stretches [begins[i], ends[i]], sorted and disjoint."""
        intervals = np.maximum(1, np.ceil((ends - begins) / spacing - 1e-9)).astype(np.int64)
        # A stretch that is not a multiple of the spacing is exceeded equally at both ends.
        starts = begins - 0.5 * (intervals * spacing - (ends - begins))
        return cls(spacing, starts, intervals, np.full(len(starts), spacing))

    @classmethod
    def spanning(cls, begins: Floats, ends: Floats, spacing: float) -> SplineBasis:
        """A basis whose stretches are exactly [begins[i], ends[i]]; they may touch."""
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
    def centres(self) -> Floats:
        """(size,) time on which each control point's basis function is centred [s]."""
        each = zip(self.starts, self.widths, self.intervals, strict=True)
        return np.concatenate([start + width * (np.arange(count + 3) - 1.0) for start, width, count in each])

    def locate(self, time: Floats, extrapolation: float = 0.0) -> tuple[Ints, Floats, Bools, Floats]:
        """First control point (n,), parameter u in the knot interval (n,), inside a stretch (n,), interval width.

        The width is (n,), or (1,) where all are alike.

        extrapolation: knot intervals by which a stretch's end polynomials are extended; there u is outside [0, 1].
        """
        if len(self.starts) == 1 and len(time):  # no gaps: most tracks, and half of the time
            last = float(self.intervals[0])
            place = (time - self.starts[0]) / self.widths[0]
            if np.minimum.reduce(place) >= 0.0 and np.maximum.reduce(place) <= last + extrapolation + 1e-9:  # no NaN
                interval = np.minimum(place, last - 1.0).astype(np.int64)
                place -= interval
                return interval, place, np.ones(len(place), dtype=np.bool_), self.widths
        known = np.isfinite(time)
        if not known.all():
            time = np.where(known, time, self.starts[0])
        stretch = np.searchsorted(self.starts - extrapolation * self.widths, time, side="right") - 1
        inside = known & (stretch >= 0)
        np.maximum(stretch, 0, out=stretch)
        width = self.widths[stretch]
        place = (time - self.starts[stretch]) / width
        count = self.intervals[stretch]
        inside &= place <= count + extrapolation + 1e-9
        interval = np.clip(place, 0.0, count - 1.0).astype(np.int64)
        place -= interval
        return self.offsets[stretch] + interval, place, inside, width

    def weights(self, time: Floats, derivative: int = 0) -> tuple[Ints, Floats, Bools]:
        """First control point (n,), the 4 weights (n, 4), and whether inside a stretch (n,).

        derivative: 0 value, 1 first, 2 second derivative by time.
        """
        if kernels.AVAILABLE and derivative < 2 and len(self.starts):
            index, weights, slopes, inside = kernels.spline_weights(self.table, time, 0.0, derivative == 1)
            return index, (slopes if derivative else weights).T, inside
        index, u, inside, width = self.locate(time)
        weights = basis_weights(u, derivative)
        if derivative:
            weights /= (width**derivative)[:, None]
        return index, weights, inside

    def weights_and_derivatives(self, time: Floats, extrapolation: float = 0.0) -> tuple[Ints, Floats, Floats, Bools]:
        """First control point (n,), the weights of value and first derivative, (n, 4) each, and inside (n,).

        extrapolation: as in `locate`.
        """
        if kernels.AVAILABLE and len(self.starts):
            index, weights, slopes, inside = kernels.spline_weights(self.table, time, extrapolation, True)
            return index, weights.T, slopes.T, inside
        index, u, inside, width = self.locate(time, extrapolation)
        return index, basis_weights(u), basis_weights(u, 1) / width[:, None], inside

    def evaluate(self, control: Floats, time: Floats, derivative: int = 0) -> Floats:
        """Values (n, d) at ``time`` of the spline with ``control`` (size, d); NaN outside the stretches."""
        index, weights, inside = self.weights(time, derivative)
        values = weighted_sums(control, index, weights)
        if not inside.all():
            values[~inside] = np.nan
        return values

    def polynomials(self, control: Floats) -> Floats:
        """(4, d, size - 3) coefficients of 1, u, u², u³ in the knot interval that begins at each control point."""
        size = len(control) - SUPPORT + 1
        points = np.stack([control[k : k + size].T for k in range(SUPPORT)])
        return np.asarray((_POWERS @ points.reshape(SUPPORT, -1)).reshape(points.shape))

    def evaluate_with_derivatives(self, polynomials: Floats, time: Floats) -> tuple[Floats, Floats]:
        """Values and first derivatives, (n, d) each, at ``time``, of a spline's `polynomials`; NaN outside."""
        if kernels.AVAILABLE and len(self.starts):
            values, slopes = kernels.spline_values(self.table, time, polynomials)
            return values.T, slopes.T
        index, u, inside, width = self.locate(time)
        constant, first, second, third = polynomials.take(index, axis=2)
        slopes = third * u  # Horner's scheme for both, in place
        values = slopes + second
        slopes += values
        values *= u
        values += first
        slopes *= u
        slopes += values
        slopes /= width
        values *= u
        values += constant
        if not inside.all():
            values[:, ~inside] = np.nan
            slopes[:, ~inside] = np.nan
        return values.T, slopes.T

    def scaled(self, factor: float) -> SplineBasis:
        """The same basis on a time axis scaled by ``factor``."""
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


def weighted_sums(control: Floats, index: Ints, weights: Floats) -> Floats:
    """Sums (n, d) of four control points from ``index`` (n,) on, of ``control`` (size, d), with ``weights`` (n, 4)."""
    if kernels.AVAILABLE:
        return kernels.weighted_sums(control, index, weights.T).T
    out = np.empty((control.shape[1], len(index)))
    # One coordinate at a time: numpy is slow along axes of length two or three.
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


def fit_spline(
    basis: SplineBasis, rows: tuple[Ints, Floats, Bools], values: Floats, row_weight: Floats, stiffness: float = 1e-6
) -> Floats:
    """Weighted least-squares control points (size, d) of ``values`` (n, d) at the times of `SplineBasis.weights`.

    stiffness: weight of squared third differences relative to one row; it only bridges empty intervals.
    """
    index, weights, inside = rows
    used, size = np.where(inside, row_weight, 0.0), basis.size
    if kernels.AVAILABLE:
        bands, target = kernels.spline_normal((index, weights.T), used, values, basis.table, stiffness, size)
        return solve_banded(bands, target.T)
    bands = normal_bands(index, weights, used, size)
    intervals = basis.interval_starts()
    third = (-1.0, 3.0, -3.0, 1.0)
    for a in range(SUPPORT):
        for b in range(a, SUPPORT):
            bands[SUPPORT - 1 - (b - a), intervals + b] += stiffness * third[a] * third[b]
    bands[-1] += 1e-12
    right = np.zeros((size, values.shape[1]))
    for k in range(SUPPORT):
        weighted = used * weights[:, k]
        for d in range(values.shape[1]):
            right[:, d] += np.bincount(index + k, weighted * values[:, d], minlength=size)
    return solve_banded(bands, right)


def split_at_gaps(time: Floats, max_gap: float) -> tuple[Floats, Floats]:
    """Begins and ends of the stretches of sorted ``time`` (n,), split at gaps longer than ``max_gap``."""
    if len(time) == 0:
        return np.zeros(0), np.zeros(0)
    cuts = np.flatnonzero(np.diff(time) > max_gap)
    return time[np.r_[0, cuts + 1]], time[np.r_[cuts, len(time) - 1]]


# LAPACK's routines without the checks of scipy's wrappers, which take as long again.
def cholesky_banded(band: Floats) -> Floats:
    """Upper band (k, n) of the factor U, ``A = Uᵀ U``, of the upper band of A. Raises LinAlgError if not definite."""
    factor, info = dpbtrf(band) if band.size else (band, 0)
    if info:
        raise np.linalg.LinAlgError(f"the leading {info} rows of a banded matrix are not positive definite")
    return np.asarray(factor)


def cho_solve_banded(factor: Floats, right: Floats, *, overwrite: bool = False) -> Floats:
    """A⁻¹ right, (n,) or (n, p). factor: of A, by `cholesky_banded`. overwrite: right's memory, in Fortran's order."""
    solution = dpbtrs(factor, right, overwrite_b=overwrite)[0] if right.size else np.zeros_like(right)
    return np.asarray(solution).reshape(right.shape)


def solve_upper_transposed(factor: Floats, right: Floats) -> Floats:
    """U⁻ᵀ right (n, p), in right's memory, which is in Fortran's order."""
    return np.asarray(dtbtrs(factor, right, trans="T", overwrite_b=True)[0])  # a factor's diagonal is never zero


def solve_banded(band: Floats, right: Floats) -> Floats:
    """A⁻¹ right (n, p) of the upper band (k, n) of A; both are overwritten. Raises LinAlgError if not definite."""
    _, solution, info = dpbsv(band, right, overwrite_ab=1, overwrite_b=1)
    if info:
        raise np.linalg.LinAlgError("a banded matrix is not positive definite")
    return np.asarray(solution)


def solve_tridiagonal(diagonal: Floats, beside: Floats, right: Floats) -> tuple[Floats, Floats]:
    """A⁻¹ right (n, p), and the pivots (n,) of A, whose product is its determinant; diagonal (n,), beside (n - 1,).

    Raises LinAlgError if A is not positive definite.
    """
    pivots, _, solution, info = dptsv(diagonal, beside, right)
    if info:
        raise np.linalg.LinAlgError("a tridiagonal matrix is not positive definite")
    return np.asarray(solution), np.asarray(pivots)
