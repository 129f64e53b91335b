"""Scan of all lags of two image tracks: epipolar cost of the best fundamental matrix at every lag.

The 9x9 moment matrix of ``s_a(t) ⊗ s_b(t + lag)`` consists of 36 cross-correlations, computed for all lags by FFT. Its
smallest generalised eigenvalue under Taubin's normalisation is the mean squared epipolar distance, over the squared
noise, that the best fundamental matrix leaves at that lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.fft import irfft, rfft
from numpy.typing import NDArray

from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack
from protocols.geometry import kernels
from protocols.geometry.order_statistics import median, quantile
from protocols.geometry.types import Bools, Floats, Ints

_MONOMIALS = 6  # of two homogeneous coordinates
MONOMIAL_INDEX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Index of the product of two homogeneous coordinates among the six monomials (x², xy, x, y², y, 1)."""
_MONOMIAL_OF_A, _MONOMIAL_OF_B = (MONOMIAL_INDEX[np.ix_(index, index)] for index in np.divmod(np.arange(9), 3))
"""(9, 9): the monomials of a, and of b, whose product is an entry of ``(s_a ⊗ s_b)(s_a ⊗ s_b)ᵀ``."""
_NOISY_IN_B = np.array([0, 1, 3, 4, 6, 7])
"""Entries of ``s_a ⊗ s_b`` with one of b's two noisy coordinates."""
_ITERATIONS = 6  # of the inverse iteration
_MIN_ORTHOGONAL = 1e-10  # squared relative length of a vector orthogonal to the other, below which the two are parallel
_COMPARISON_LAGS = 400  # scanned outside a lag window, for comparison
_HALF_WEIGHT_SPEED_PX = 20.0  # px/s: image speed at which a sample has half weight
_BATCH = 4096  # lags per batch of eigenvalue problems
_SCAN_STEPS = (0.01, 0.0125, 0.016, 0.02, 0.025, 0.033, 0.05)  # s


@dataclass(frozen=True, slots=True, eq=False)
class GridTrack:
    """One camera's tracks resampled on a regular time grid, in centred and scaled coordinates for conditioning.

    begin: time of the first sample [s]. step: [s]. points: (labels, n, 2). weight: (labels, n) 0 where there is
    no track, near 0 where the point stands still, up to 1 where it moves. sigma: noise std in the scaled coordinates.
    transform: (3, 3), scaled from normalised homogeneous coordinates.
    """

    begin: float
    step: float
    points: Floats
    weight: Floats
    sigma: float
    transform: Floats


def fast_image_speed(track: SmoothTrack) -> float:
    """Image speed [px/s] of a track: its 90 % quantile."""
    return quantile(np.hypot(*track.point_and_velocity(track.time)[1].T), 0.9) * track.focal


def scan_step(speed_px: float, s: PairSettings) -> float:
    """Grid step of the lag scan [s] in which a point at ``speed_px`` [px/s] moves by about ``scan_step_px``."""
    target = s.scan_step_px / max(speed_px, 1e-9)
    allowed = [step for step in _SCAN_STEPS if s.min_scan_step <= step <= min(s.max_scan_step, target)]
    return max(allowed, default=s.min_scan_step)


def grid_tracks(tracks: Sequence[SmoothTrack], step: float, sigma_px: float) -> GridTrack:
    """Resample one camera's tracks, one per label, every ``step`` [s]. sigma_px: assumed image noise std [px]."""
    begin = float(np.floor(min(track.basis.begin for track in tracks) / step) * step)
    end = max(track.basis.end for track in tracks)
    time = begin + step * np.arange(int(np.ceil((end - begin) / step)) + 1, dtype=np.float64)
    both = [track.point_and_velocity(time) for track in tracks]
    points, focal = np.stack([one.T for one, _ in both]), tracks[0].focal  # (labels, 2, n)
    speed = np.stack([np.hypot(*velocity.T) for _, velocity in both]) * focal
    present = np.asarray(np.isfinite(speed))
    # Labels are rarely independent: n of them count as sqrt(n).
    share = len(tracks) ** -0.25  # a moment has a's weight times b's
    weight = np.where(present, share * speed / (speed + _HALF_WEIGHT_SPEED_PX), 0.0)
    points = np.where(present[:, None], points, 0.0)
    total = max(float(weight.sum()), 1e-9)
    centre = np.einsum("kn,kin->i", weight, points) / total
    points -= centre[:, None]
    variance = float(np.einsum("kn,kin,kin->", weight, points, points)) / total / 2.0
    scale = np.sqrt(max(variance, 1e-12))
    transform = np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1.0]])
    points /= scale
    return GridTrack(begin, step, points.transpose(0, 2, 1), weight, sigma_px / focal / scale, transform)


def most_active_window(track: GridTrack, seconds: float) -> GridTrack:
    """The window of ``seconds`` with the most motion; the whole track if it is not longer."""
    length = max(1, round(seconds / track.step))
    total = np.cumsum(np.r_[0.0, track.weight.sum(axis=0)])
    if len(total) - 1 <= length:
        return track
    begin = int(np.argmax(total[length:] - total[:-length]))
    part = slice(begin, begin + length)
    return replace(
        track, begin=track.begin + begin * track.step, points=track.points[:, part], weight=track.weight[:, part]
    )


@dataclass(frozen=True, slots=True, eq=False)
class LagScan:
    """Epipolar cost at every lag.

    offset: (n,) time maps ``t_a = t_b + offset`` [s]. support: (n,) seconds in which both tracks move.
    cost: (n,) mean squared epipolar distance over the squared noise; inf where not computed.
    """

    offset: Floats
    support: Floats
    cost: Floats


@cache
def fast_length(least: int) -> int:
    """The smallest length of 2, 3 and 5 as factors, no less than ``least``: for the FFT of real numbers."""
    found = 1 << (least - 1).bit_length()
    odd = [3**i * 5**j for i in range(21) for j in range(15) if 3**i * 5**j < found]
    lengths: list[int] = [part << (-(-least // part) - 1).bit_length() for part in odd]
    return min([found, *lengths])


class PairMoments:
    """Moment matrices of two grid tracks at any lag, from 36 cross-correlations of monomials.

    lags: (n,) in grid steps. offset: (n,) time maps ``t_a = t_b + offset`` [s]. support: (n,) seconds in which both
    tracks move, computed at once; the moments are computed for the lags that are first requested, and kept.
    """

    def __init__(self, a: GridTrack, b: GridTrack) -> None:
        self.a, self.b = a, b
        n_a, n_b = a.weight.shape[1], b.weight.shape[1]
        self._length = fast_length(n_a + n_b)
        self.lags: Ints = np.arange(-(n_a - 1), n_b, dtype=np.int64)
        self.offset: Floats = np.asarray(a.begin - b.begin - self.lags * a.step, dtype=np.float64)
        self._weight = self._correlation(np.conj(rfft(a.weight, self._length)), rfft(b.weight, self._length))
        common = self._weight[self.lags % self._length]
        self.support: Floats = np.asarray(np.maximum(common, 0.0) * a.step, dtype=np.float64)
        self._column = np.full(len(self.lags), -1, dtype=np.int64)
        self._moments = np.zeros((_MONOMIALS, _MONOMIALS, 0))

    def _correlation(self, of_a: NDArray[np.complex128], of_b: NDArray[np.complex128]) -> Floats:
        """c[lag] = sum_n a[n] b[n + lag], summed over labels; negative lags from the end.

        of_a: spectrum (labels, m). of_b: (labels, m), or (labels, k, m) for k correlations at once, in half the time.
        """
        product = of_a[0] * of_b[0]
        for k in range(1, len(of_a)):
            product += of_a[k] * of_b[k]
        return np.asarray(irfft(product, self._length), dtype=np.float64)

    def within(self, offset: float, window: float) -> Bools:
        """Lags (n,) within ``window`` of ``offset`` [s]."""
        return np.asarray(np.abs(self.offset - offset) <= window)

    def moment_sums(self, which: Ints) -> Floats:
        """(6, 6, m) sums of products of monomials of a and of b at lags of index ``which`` (m,)."""
        missing = which[self._column[which] < 0]
        if len(missing):
            place = self.lags[missing] % self._length
            fresh = np.empty((_MONOMIALS, _MONOMIALS, len(missing)))
            spectra_a = np.conj(rfft(monomials(self.a), self._length))
            spectra_b = rfft(monomials(self.b), self._length)
            for i in range(_MONOMIALS):
                fresh[i] = self._correlation(spectra_a[:, i], spectra_b).take(place, axis=1)
            self._column[missing] = self._moments.shape[2] + np.arange(len(missing))
            self._moments = np.concatenate([self._moments, fresh], axis=2) if self._moments.size else fresh
        if len(which) == self._moments.shape[2] and bool((self._column[which] == np.arange(len(which))).all()):
            return self._moments
        return self._moments[:, :, self._column[which]]

    def matrices(self, which: Ints) -> tuple[Floats, Floats]:
        """Moment matrices (m, 9, 9) and Taubin's normalisation (m, 9, 9) of lags ``which`` (m,), per sample."""
        sums = self.moment_sums(which)
        c = np.moveaxis(sums / np.maximum(sums[5, 5], 1e-9), -1, 0)
        full = c[:, MONOMIAL_INDEX][:, :, :, MONOMIAL_INDEX]  # (m, i, j, k, l): sum a_i a_j b_k b_l
        moment = full.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
        return moment, taubin_normalisation(full, self.a.sigma, self.b.sigma)

    def min_costs(self, which: Ints) -> Floats:
        """Smallest generalised eigenvalue (m,) at lags ``which``: mean squared distance over the squared noise."""
        out = np.full(len(which), np.inf)
        sums = self.moment_sums(which)
        for begin in range(0, len(which), _BATCH):
            part = slice(begin, begin + _BATCH)
            out[part] = smallest_eigenvalues(sums[:, :, part], self.a.sigma, self.b.sigma)
        return out

    def costs_given(self, which: Ints, matrix: Floats) -> Floats:
        """Mean squared distance over the squared noise (m,) under a given ``m_aᵀ F m_b = 0`` at lags ``which``."""
        theta = to_grid_coordinates(matrix, self.a, self.b).reshape(3, 3)
        plane = np.diag([1.0, 1.0, 0.0])
        of_both, each = (_MONOMIALS * _MONOMIAL_OF_A + _MONOMIAL_OF_B).ravel(), MONOMIAL_INDEX.ravel()
        misfit = np.bincount(of_both, np.outer(theta, theta).ravel(), _MONOMIALS**2)
        misfit = misfit.reshape(_MONOMIALS, -1)
        of_b = np.bincount(each, (self.a.sigma**2 * theta.T @ plane @ theta).ravel())
        of_a = np.bincount(each, (self.b.sigma**2 * theta @ plane @ theta.T).ravel())
        chosen = self.moment_sums(which)
        noise = of_b @ chosen[5] + of_a @ chosen[:, 5]
        total = np.maximum(chosen[5, 5], 1e-9)
        left = np.tensordot(misfit, chosen, 2)
        return np.asarray(np.maximum(left / total, 0.0) / np.maximum(noise / total, 1e-30))

    def fundamental(self, which: int) -> Floats:
        """The best fundamental matrix (3, 3) at one lag, of normalised points: ``m_aᵀ F m_b = 0``, norm 1."""
        moment, norm = self.matrices(np.array([which]))
        reduced = moment[0, :8, :8] - np.outer(moment[0, :8, 8], moment[0, 8, :8]) / moment[0, 8, 8]
        lower = np.linalg.inv(np.linalg.cholesky(norm[0, :8, :8] + 1e-14 * np.eye(8)))
        _, vectors = np.linalg.eigh(lower @ reduced @ lower.T)
        head = lower.T @ vectors[:, 0]
        theta = np.r_[head, -moment[0, 8, :8] @ head / moment[0, 8, 8]].reshape(3, 3)
        matrix = self.a.transform.T @ theta @ self.b.transform
        return np.asarray(matrix / np.linalg.norm(matrix))


def taubin_normalisation(full: Floats, sigma_a: float, sigma_b: float) -> Floats:
    """Taubin's normalisation (m, 9, 9) of moments ``full`` (m, 3, 3, 3, 3), sum of a_i a_j b_k b_l."""
    plane = np.diag([1.0, 1.0, 0.0])
    bb, aa = full[:, 2, 2], full[:, :, :, 2, 2]
    first = sigma_a**2 * plane[None, :, None, :, None] * bb[:, None, :, None, :]
    second = sigma_b**2 * aa[:, :, None, :, None] * plane[None, None, :, None, :]
    return np.asarray((first + second).reshape(-1, 9, 9))


def smallest_eigenvalues(moments: Floats, sigma_a: float, sigma_b: float) -> Floats:
    """Smallest generalised eigenvalues (m,) of moments (6, 6, m) under Taubin's normalisation.

    By inverse iteration over all lags at once. An eigenvalue is at most a few per cent too large where the next one is
    nearly as small, that is where no geometry is distinguished at that lag anyway.
    """
    if kernels.AVAILABLE:
        return kernels.smallest_eigenvalues(moments, sigma_a, sigma_b, _ITERATIONS, _MIN_ORTHOGONAL)
    scaled = moments / np.maximum(moments[5, 5], 1e-9)
    factor, pivots = _ldl_factors(_eliminate_constant(scaled))
    noise_a, noise_b = (sigma_b**2 * scaled[:, 5])[MONOMIAL_INDEX], (sigma_a**2 * scaled[5])[MONOMIAL_INDEX]
    start = np.repeat(np.cos(1.7 * np.arange(1.0, 9.0) ** 2)[:, None], moments.shape[2], axis=1)
    image = _apply_normalisation(noise_a, noise_b, start)
    vector, by_moment = start, image
    for _ in range(_ITERATIONS):
        by_moment = image
        vector = _ldl_solve(factor, pivots, image)
        image = _apply_normalisation(noise_a, noise_b, vector)
        over = 1.0 / np.sqrt(np.maximum((vector * image).sum(axis=0), 1e-300))
        vector *= over
        image *= over
        by_moment = by_moment * over
    # A Rayleigh-Ritz step on the last two vectors is worth as many iterations again.
    last = _ldl_solve(factor, pivots, image)
    return np.maximum(_rayleigh_ritz(vector, last, by_moment, image, _apply_normalisation(noise_a, noise_b, last)), 0.0)


def _eliminate_constant(scaled: Floats) -> Floats:
    """Moment matrices (8, 8, m), lower triangles only, of scaled moments (6, 6, m), the constant term eliminated.

    The constant term has no noise: its row of the normalisation is zero.
    """
    out = np.empty((8, 8, scaled.shape[2]))
    border = scaled[_MONOMIAL_OF_A[:8, 8], _MONOMIAL_OF_B[:8, 8]]
    share = border / scaled[5, 5]
    for p in range(8):
        np.multiply(border[: p + 1], -share[p], out=out[p, : p + 1])
        for q in range(p + 1):
            out[p, q] += scaled[_MONOMIAL_OF_A[p, q], _MONOMIAL_OF_B[p, q]]
    return out


def _apply_normalisation(noise_a: Floats, noise_b: Floats, vector: Floats) -> Floats:
    """Product (8, m) of Taubin's normalisation with vectors (8, m). noise_a, noise_b: (3, 3, m) of monomials."""
    out = np.empty_like(vector)
    np.einsum("jlm,ilm->ijm", noise_b, vector[:6].reshape(2, 3, -1), out=out[:6].reshape(2, 3, -1))
    out[6:] = 0.0
    out[_NOISY_IN_B] += np.einsum("ikm,kjm->ijm", noise_a, vector[_NOISY_IN_B].reshape(3, 2, -1)).reshape(6, -1)
    return out


def _rayleigh_ritz(y: Floats, z: Floats, moment_y: Floats, norm_y: Floats, norm_z: Floats) -> Floats:
    """Smallest generalised eigenvalues (m,) over the spans of y and z (n, m), z being the next iterate of y.

    moment_y, norm_y, norm_z: products of the moments and of the normalisation with them; y has length 1 in that norm.
    """
    moment_yz, moment_z = np.ones(y.shape[1]), (z * norm_y).sum(axis=0)
    length, along = np.maximum((z * norm_z).sum(axis=0), 1e-300), (y * norm_z).sum(axis=0)
    value, share = moment_z / length, along / length
    rest = np.maximum(1.0 - along * share, 0.0)
    apart = rest > _MIN_ORTHOGONAL
    safe = np.where(apart, rest, 1.0)
    across = (moment_yz - share * moment_z) ** 2 / (length * safe)
    other = ((y * moment_y).sum(axis=0) - 2.0 * share * moment_yz + share**2 * moment_z) / safe
    half = 0.5 * (other - value)
    lower = across / np.maximum(half + np.sqrt(half**2 + across), 1e-300)
    return np.asarray(np.where(apart, value - lower, value))


def _ldl_factors(work: Floats) -> tuple[Floats, Floats]:
    """L (n, n, m), below its diagonal, and D (n, m) of symmetric ``L D Lᵀ`` (n, n, m), in place of its lower half."""
    least = 1e-13 * np.maximum(np.einsum("ppm->m", work), 1e-300)
    for k in range(len(work)):
        np.maximum(work[k, k], least, out=work[k, k])
        column = work[k + 1 :, k].copy()
        work[k + 1 :, k] /= work[k, k]
        for i in range(k + 1, len(work)):
            work[i, k + 1 : i + 1] -= work[i, k] * column[: i - k]
    return work, np.einsum("ppm->pm", work)


def _ldl_solve(factor: Floats, pivots: Floats, right: Floats) -> Floats:
    """(n, m) solutions of ``L D Lᵀ x = right``."""
    out = right.copy()
    for k in range(len(out)):
        out[k + 1 :] -= factor[k + 1 :, k] * out[k]
    out /= pivots
    for k in reversed(range(len(out))):
        out[:k] -= factor[k, :k] * out[k]
    return out


def costs_given_geometry(moment: Floats, norm: Floats, theta: Floats) -> Floats:
    """Mean squared distances over the squared noise (m,) under one matrix ``theta`` (9,).

    moment, norm: (m, 9, 9) moments and their normalisation.
    """
    return np.asarray(np.maximum((moment @ theta @ theta) / np.maximum(norm @ theta @ theta, 1e-30), 0.0))


def to_grid_coordinates(matrix: Floats, a: GridTrack, b: GridTrack) -> Floats:
    """Entries (9,), in the grids' coordinates, of a matrix (3, 3) of normalised points, ``m_aᵀ F m_b = 0``."""
    return np.asarray(np.linalg.inv(a.transform).T @ matrix @ np.linalg.inv(b.transform)).reshape(9)


def monomials(track: GridTrack) -> Floats:
    """(labels, 6, n): weight times the six monomials of the homogeneous coordinates."""
    x, y = track.points[:, :, 0], track.points[:, :, 1]
    out = np.empty((len(x), _MONOMIALS, x.shape[1]))
    out[:, 2], out[:, 4], out[:, 5] = track.weight * x, track.weight * y, track.weight
    out[:, 0], out[:, 1], out[:, 3] = out[:, 2] * x, out[:, 2] * y, out[:, 4] * y
    return out


def scan_lags(
    moments: PairMoments,
    min_scan_support: float,
    known_fundamental: Floats | None = None,
    lag_window: tuple[float, float] | None = None,
) -> LagScan:
    """Cost at every lag with at least ``min_scan_support`` seconds of common motion.

    known_fundamental: (3, 3) ``m_aᵀ F m_b = 0`` of normalised points, where the geometry is given. lag_window: offset
    and half-width [s] to scan; of the other lags then only a few hundred, for comparison.
    """
    cost = np.full(len(moments.lags), np.inf)
    selected = moments.support >= min_scan_support
    if lag_window is not None:
        thinned = np.zeros_like(selected)
        thinned[:: max(1, len(thinned) // _COMPARISON_LAGS)] = True
        selected &= thinned | moments.within(*lag_window)
    which = np.flatnonzero(selected)
    if len(which):
        cost[which] = (
            moments.min_costs(which) if known_fundamental is None else moments.costs_given(which, known_fundamental)
        )
    return LagScan(moments.offset, moments.support, cost)


def candidate_lags(
    scan: LagScan, candidates_per_octave: int, max_candidates: int, lag_window: tuple[float, float] | None = None
) -> Ints:
    """Indices of candidate lags: local minima of the cost, the best few in each octave of support.

    Any lag fits where little overlaps; comparing only lags of similar support keeps the true lag on the list.
    lag_window: offset and half-width [s] that contain all candidates.
    """
    return ranked_minima(scan, candidates_per_octave, lag_window)[0][:max_candidates]


def ranked_minima(
    scan: LagScan, candidates_per_octave: int, lag_window: tuple[float, float] | None = None
) -> tuple[Ints, Floats]:
    """Candidate lags and their scores, best first: support [s] times the log of the median cost over the lag's."""
    cost = scan.cost
    with np.errstate(invalid="ignore"):
        known = np.isfinite(cost)
        minimum: Bools = known.copy()
        minimum[1:] &= ~(cost[1:] > cost[:-1])
        minimum[:-1] &= cost[:-1] <= cost[1:]
    if lag_window is not None:
        minimum &= np.abs(scan.offset - lag_window[0]) <= lag_window[1]
    where = np.flatnonzero(minimum)
    octave = np.floor(np.log2(scan.support[where])).astype(np.int64)
    chosen: list[tuple[float, int]] = []
    for level in np.unique(octave):
        members = where[octave == level]
        typical = max(median(cost[known & (scan.support >= 2.0**level)]), 1e-9)
        for index in members[np.argsort(cost[members], kind="stable")][:candidates_per_octave]:
            rank = scan.support[index] * np.log(typical / max(float(cost[index]), 0.05) + 1.0)
            chosen.append((-float(rank), int(index)))
    chosen.sort()
    return np.array([index for _, index in chosen], dtype=np.int64), np.array([-rank for rank, _ in chosen])
