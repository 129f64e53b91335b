"""Every alignment of two image tracks at once: which lags make one epipolar geometry possible.

METHODS A, step 2, for all lags together: the 9x9 moment matrix of ``s_a(t) ⊗ s_b(t + lag)`` is made of 36
cross-correlations, done by FFT; its smallest generalised eigenvalue (Taubin's normalisation) is the mean
squared epipolar distance, in units of the noise, that the best fundamental matrix leaves at that lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from hub.trajectory.image_tracks import SmoothTrack
from protocols.geometry.types import Bools, Floats, Ints

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
PAIR_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Which of the six monomials is the product of two homogeneous coordinates."""
_OF_A, _OF_B = (PAIR_OF[np.ix_(index, index)] for index in np.divmod(np.arange(9), 3))
"""(9, 9): which of the monomials of a, and of b, an entry of ``(s_a ⊗ s_b)(s_a ⊗ s_b)ᵀ`` is the product of."""
_SIDE = np.array([0, 1, 3, 4, 6, 7])
"""Entries of ``s_a ⊗ s_b`` that hold one of b's two coordinates, which have noise."""
_ITERATIONS = 6
_PARALLEL = 1e-10  # part of a vector that is not along the other, squared, below which it tells nothing
_COMPARED = 400
_SLOW_PX = 20.0  # px/s: image speed at which a moment counts half
_CHUNK = 4096  # lags per batch of eigenvalue problems


@dataclass(frozen=True, slots=True, eq=False)
class GridTrack:
    """One camera's tracks on a regular grid of its time, in coordinates centred and scaled for conditioning.

    begin: time of the first sample [s]. step: [s]. points: (labels, n, 2). weight: (labels, n) 0 where there is
    no track, near 0 where it stands still, up to 1 where it moves. sigma: noise in the scaled coordinates.
    transform: (3, 3), scaled from normalised homogeneous coordinates.
    """

    begin: float
    step: float
    points: Floats
    weight: Floats
    sigma: float
    transform: Floats


def grid_tracks(tracks: Sequence[SmoothTrack], step: float, sigma_px: float) -> GridTrack:
    """Sample one camera's tracks, one a label, every ``step`` seconds; sigma_px: the noise to reckon with."""
    begin = float(np.floor(min(track.basis.begin for track in tracks) / step) * step)
    end = max(track.basis.end for track in tracks)
    time = begin + step * np.arange(int(np.ceil((end - begin) / step)) + 1, dtype=np.float64)
    points = np.stack([track.at(time) for track in tracks])
    focal = tracks[0].focal
    speed = np.stack([np.linalg.norm(track.at(time, 1), axis=1) for track in tracks]) * focal
    there = np.asarray(np.isfinite(points).all(axis=2))
    # Several labels are rarely independent: together they count as the root of their number.
    share = len(tracks) ** -0.25  # a moment has a's weight times b's
    weight = np.where(there, share * speed / (speed + _SLOW_PX), 0.0)
    points = np.where(there[:, :, None], points, 0.0)
    total = max(float(weight.sum()), 1e-9)
    centre = (weight[:, :, None] * points).sum(axis=(0, 1)) / total
    variance = float((weight * ((points - centre) ** 2).sum(axis=2)).sum()) / total / 2.0
    spread = np.sqrt(max(variance, 1e-12))
    transform = np.array([[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1.0]])
    return GridTrack(begin, step, (points - centre) / spread, weight, sigma_px / focal / spread, transform)


def busiest(track: GridTrack, seconds: float) -> GridTrack:
    """The stretch of that many seconds in which a camera's tracks move most; all of it where it is no longer."""
    length = max(1, round(seconds / track.step))
    total = np.cumsum(np.r_[0.0, track.weight.sum(axis=0)])
    if len(total) - 1 <= length:
        return track
    begin = int(np.argmax(total[length:] - total[:-length]))
    part = slice(begin, begin + length)
    return replace(
        track,
        begin=track.begin + begin * track.step,
        points=track.points[:, part],
        weight=track.weight[:, part],
    )


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Scan over all lags.

    offset: (n,) time maps ``t_a = t_b + offset`` [s]. support: (n,) seconds in which both move.
    cost: (n,) mean squared epipolar distance over the noise; inf where the support is too small.
    """

    offset: Floats
    support: Floats
    cost: Floats


class PairMoments:
    """The 36 cross-correlations of two grid tracks, from which the moments of any lag are read.

    Which lags have enough in common is known at once; the rest is made for the lags that are asked for first.
    """

    def __init__(self, a: GridTrack, b: GridTrack) -> None:
        self.a, self.b = a, b
        n_a, n_b = a.weight.shape[1], b.weight.shape[1]
        self._length = next_fast_len(n_a + n_b, real=True)
        self.lags: Ints = np.arange(-(n_a - 1), n_b, dtype=np.int64)
        self.offset: Floats = np.asarray(a.begin - b.begin - self.lags * a.step, dtype=np.float64)
        self._weight = self._correlation(np.conj(rfft(a.weight, self._length)), rfft(b.weight, self._length))
        common = self._weight[self.lags % self._length]
        self.support: Floats = np.asarray(np.maximum(common, 0.0) * a.step, dtype=np.float64)
        self._column = np.full(len(self.lags), -1, dtype=np.int64)
        self._moments = np.zeros((len(_PAIRS), len(_PAIRS), 0))

    def _correlation(self, of_a: NDArray[np.complex128], of_b: NDArray[np.complex128]) -> Floats:
        """c[lag] = sum_n a[n] b[n + lag], all labels together; negative lags from the end.

        of_a: spectrum (labels, m). of_b: (labels, m), or (labels, k, m) for k correlations at once: in half the time.
        """
        product = of_a[0] * of_b[0]
        for k in range(1, len(of_a)):
            product += of_a[k] * of_b[k]
        return np.asarray(irfft(product, self._length, overwrite_x=True), dtype=np.float64)

    def near(self, offset: float, window: float) -> Bools:
        """Lags (n,) within ``window`` of ``offset`` [s]."""
        return np.asarray(np.abs(self.offset - offset) <= window)

    def sums(self, which: Ints) -> Floats:
        """(6, 6, m) sums of the monomials' products at chosen lags."""
        missing = which[self._column[which] < 0]
        if len(missing):
            place = self.lags[missing] % self._length
            made = np.empty((len(_PAIRS), len(_PAIRS), len(missing)))
            spectra_a = np.conj(rfft(monomials(self.a), self._length))
            spectra_b = rfft(monomials(self.b), self._length)
            for i in range(len(_PAIRS)):
                made[i] = self._correlation(spectra_a[:, i], spectra_b).take(place, axis=1)
            self._column[missing] = self._moments.shape[2] + np.arange(len(missing))
            self._moments = np.concatenate([self._moments, made], axis=2) if self._moments.size else made
        if len(which) == self._moments.shape[2] and bool((self._column[which] == np.arange(len(which))).all()):
            return self._moments
        return self._moments[:, :, self._column[which]]

    def matrices(self, which: Ints) -> tuple[Floats, Floats]:
        """Moment matrices (m, 9, 9) and Taubin's normalisation (m, 9, 9) of chosen lags, per sample."""
        sums = self.sums(which)
        c = np.moveaxis(sums / np.maximum(sums[5, 5], 1e-9), -1, 0)
        full = c[:, PAIR_OF][:, :, :, PAIR_OF]  # (m, i, j, k, l): sum a_i a_j b_k b_l
        moment = full.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
        return moment, normalisation(full, self.a.sigma, self.b.sigma)

    def costs(self, which: Ints) -> Floats:
        """Smallest generalised eigenvalue (m,) at chosen lags: squared distance over noise."""
        out = np.full(len(which), np.inf)
        sums = self.sums(which)
        for begin in range(0, len(which), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            out[part] = eigen_costs(sums[:, :, part], self.a.sigma, self.b.sigma)
        return out

    def costs_of(self, which: Ints, matrix: Floats) -> Floats:
        """Mean squared distance over noise (m,) that a known ``m_aᵀ F m_b = 0`` leaves at chosen lags."""
        theta = in_grid(matrix, self.a, self.b).reshape(3, 3)
        plane = np.diag([1.0, 1.0, 0.0])
        misfit = np.zeros((len(_PAIRS), len(_PAIRS)))
        np.add.at(misfit, (_OF_A, _OF_B), np.outer(theta, theta))
        of_a, of_b = np.zeros(len(_PAIRS)), np.zeros(len(_PAIRS))
        np.add.at(of_b, PAIR_OF, self.a.sigma**2 * theta.T @ plane @ theta)
        np.add.at(of_a, PAIR_OF, self.b.sigma**2 * theta @ plane @ theta.T)
        chosen = self.sums(which)
        noise = of_b @ chosen[5] + of_a @ chosen[:, 5]
        total = np.maximum(chosen[5, 5], 1e-9)
        left = np.tensordot(misfit, chosen, 2)
        return np.asarray(np.maximum(left / total, 0.0) / np.maximum(noise / total, 1e-30))

    def fundamental(self, which: int) -> Floats:
        """The best matrix (3, 3) at one lag, in normalised coordinates: ``m_aᵀ F m_b = 0``, norm 1."""
        moment, norm = self.matrices(np.array([which]))
        reduced = moment[0, :8, :8] - np.outer(moment[0, :8, 8], moment[0, 8, :8]) / moment[0, 8, 8]
        lower = np.linalg.inv(np.linalg.cholesky(norm[0, :8, :8] + 1e-14 * np.eye(8)))
        _, vectors = np.linalg.eigh(lower @ reduced @ lower.T)
        head = lower.T @ vectors[:, 0]
        theta = np.r_[head, -moment[0, 8, :8] @ head / moment[0, 8, 8]].reshape(3, 3)
        matrix = self.a.transform.T @ theta @ self.b.transform
        return np.asarray(matrix / np.linalg.norm(matrix))


def normalisation(full: Floats, sigma_a: float, sigma_b: float) -> Floats:
    """Taubin's normalisation (m, 9, 9) of moments ``full`` (m, 3, 3, 3, 3), sum of a_i a_j b_k b_l."""
    plane = np.diag([1.0, 1.0, 0.0])
    bb, aa = full[:, 2, 2], full[:, :, :, 2, 2]
    first = sigma_a**2 * plane[None, :, None, :, None] * bb[:, None, :, None, :]
    second = sigma_b**2 * aa[:, :, None, :, None] * plane[None, None, :, None, :]
    return np.asarray((first + second).reshape(-1, 9, 9))


def eigen_costs(moments: Floats, sigma_a: float, sigma_b: float) -> Floats:
    """Smallest generalised eigenvalues (m,) of moments (6, 6, m) under Taubin's normalisation.

    By inverse iteration, all lags at a time: an eigenvalue comes out at most a few per cent too large where the
    next one is nearly as small, which says the same: no geometry stands out at that lag.
    """
    scaled = moments / np.maximum(moments[5, 5], 1e-9)
    factor, pivots = _factors(_reduced(scaled))
    noise_a, noise_b = (sigma_b**2 * scaled[:, 5])[PAIR_OF], (sigma_a**2 * scaled[5])[PAIR_OF]
    start = np.repeat(np.cos(1.7 * np.arange(1.0, 9.0) ** 2)[:, None], moments.shape[2], axis=1)
    image = _normalised(noise_a, noise_b, start)
    vector, by_moment = start, image
    for _ in range(_ITERATIONS):
        by_moment = image
        vector = _solved(factor, pivots, image)
        image = _normalised(noise_a, noise_b, vector)
        over = 1.0 / np.sqrt(np.maximum((vector * image).sum(axis=0), 1e-300))
        vector *= over
        image *= over
        by_moment = by_moment * over
    # The last two vectors together are worth as many iterations again.
    last = _solved(factor, pivots, image)
    return np.maximum(_least_of_two(vector, last, by_moment, image, _normalised(noise_a, noise_b, last)), 0.0)


def _reduced(scaled: Floats) -> Floats:
    """Moment matrices (8, 8, m), their lower halves only, of scaled moments (6, 6, m), constant term eliminated.

    That term is free: its row of the normalisation is zero.
    """
    out = np.empty((8, 8, scaled.shape[2]))
    border = scaled[_OF_A[:8, 8], _OF_B[:8, 8]]
    share = border / scaled[5, 5]
    for p in range(8):
        np.multiply(border[: p + 1], -share[p], out=out[p, : p + 1])
        for q in range(p + 1):
            out[p, q] += scaled[_OF_A[p, q], _OF_B[p, q]]
    return out


def _normalised(noise_a: Floats, noise_b: Floats, vector: Floats) -> Floats:
    """Taubin's normalisation, by the noise that a's and b's monomials (3, 3, m) carry, of vectors (8, m)."""
    out = np.empty_like(vector)
    np.einsum("jlm,ilm->ijm", noise_b, vector[:6].reshape(2, 3, -1), out=out[:6].reshape(2, 3, -1))
    out[6:] = 0.0
    out[_SIDE] += np.einsum("ikm,kjm->ijm", noise_a, vector[_SIDE].reshape(3, 2, -1)).reshape(6, -1)
    return out


def _least_of_two(y: Floats, z: Floats, moment_y: Floats, norm_y: Floats, norm_z: Floats) -> Floats:
    """Smallest generalised eigenvalues (m,) over the spans of y and z (n, m), of which z is one iteration on.

    moment_y, norm_y, norm_z: the moments' and the normalisation's products with them; y's length under that is 1.
    """
    moment_yz, moment_z = np.ones(y.shape[1]), (z * norm_y).sum(axis=0)
    length, along = np.maximum((z * norm_z).sum(axis=0), 1e-300), (y * norm_z).sum(axis=0)
    value, share = moment_z / length, along / length
    rest = np.maximum(1.0 - along * share, 0.0)
    apart = rest > _PARALLEL
    safe = np.where(apart, rest, 1.0)
    across = (moment_yz - share * moment_z) ** 2 / (length * safe)
    other = ((y * moment_y).sum(axis=0) - 2.0 * share * moment_yz + share**2 * moment_z) / safe
    half = 0.5 * (other - value)
    lower = across / np.maximum(half + np.sqrt(half**2 + across), 1e-300)
    return np.asarray(np.where(apart, value - lower, value))


def _factors(work: Floats) -> tuple[Floats, Floats]:
    """L (n, n, m), below its diagonal, and D (n, m) of symmetric ``L D Lᵀ`` (n, n, m), in place of its lower half."""
    least = 1e-13 * np.maximum(np.einsum("ppm->m", work), 1e-300)
    for k in range(len(work)):
        np.maximum(work[k, k], least, out=work[k, k])
        column = work[k + 1 :, k].copy()
        work[k + 1 :, k] /= work[k, k]
        for i in range(k + 1, len(work)):
            work[i, k + 1 : i + 1] -= work[i, k] * column[: i - k]
    return work, np.einsum("ppm->pm", work)


def _solved(factor: Floats, pivots: Floats, right: Floats) -> Floats:
    """(n, m) solutions of ``L D Lᵀ x = right``."""
    out = right.copy()
    for k in range(len(out)):
        out[k + 1 :] -= factor[k + 1 :, k] * out[k]
    out /= pivots
    for k in reversed(range(len(out))):
        out[:k] -= factor[k, :k] * out[k]
    return out


def fixed_costs(moment: Floats, norm: Floats, theta: Floats) -> Floats:
    """Mean squared distances over noise (m,) that one matrix ``theta`` (9,) leaves."""
    return np.asarray(np.maximum((moment @ theta @ theta) / np.maximum(norm @ theta @ theta, 1e-30), 0.0))


def in_grid(matrix: Floats, a: GridTrack, b: GridTrack) -> Floats:
    """The (9,) entries, in the grids' coordinates, of ``m_aᵀ F m_b = 0`` (3, 3) of normalised points."""
    return np.asarray(np.linalg.inv(a.transform).T @ matrix @ np.linalg.inv(b.transform)).reshape(9)


def monomials(track: GridTrack) -> Floats:
    """(labels, 6, n): weight times the six products of the homogeneous coordinates."""
    x, y = track.points[:, :, 0], track.points[:, :, 1]
    out = np.empty((len(x), len(_PAIRS), x.shape[1]))
    out[:, 2], out[:, 4], out[:, 5] = track.weight * x, track.weight * y, track.weight
    out[:, 0], out[:, 1], out[:, 3] = out[:, 2] * x, out[:, 2] * y, out[:, 4] * y
    return out


def scan_lags(
    moments: PairMoments, least_support: float, known: Floats | None = None, near: tuple[float, float] | None = None
) -> Scan:
    """Cost at every lag with at least ``least_support`` seconds of common motion.

    known: (3, 3) ``m_aᵀ F m_b = 0`` of normalised points, where the geometry is given. near: offset and
    window [s] where the offset is about known: of the other lags a few hundred, to compare with.
    """
    cost = np.full(len(moments.lags), np.inf)
    looked_at = moments.support >= least_support
    if near is not None:
        thinned = np.zeros_like(looked_at)
        thinned[:: max(1, len(thinned) // _COMPARED)] = True
        looked_at &= thinned | moments.near(*near)
    which = np.flatnonzero(looked_at)
    if len(which):
        cost[which] = moments.costs(which) if known is None else moments.costs_of(which, known)
    return Scan(moments.offset, moments.support, cost)


def candidates(scan: Scan, per_stratum: int, at_most: int, near: tuple[float, float] | None = None) -> Ints:
    """Lags worth a closer look: local minima of the cost, the best few in each octave of support.

    Where little overlaps, any lag fits: comparing only lags of like support keeps the truth on the list.
    near: offset and window [s] outside which none is.
    """
    return ranked(scan, per_stratum, near)[0][:at_most]


def ranked(scan: Scan, per_stratum: int, near: tuple[float, float] | None = None) -> tuple[Ints, Floats]:
    """Those lags, and what speaks for them: seconds of support times how much better than usual; best first."""
    cost = scan.cost
    with np.errstate(invalid="ignore"):
        minimum: Bools = np.isfinite(cost)
        minimum[1:] &= ~(cost[1:] > cost[:-1])
        minimum[:-1] &= cost[:-1] <= cost[1:]
    if near is not None:
        minimum &= np.abs(scan.offset - near[0]) <= near[1]
    where = np.flatnonzero(minimum)
    octave = np.floor(np.log2(scan.support[where])).astype(np.int64)
    chosen: list[tuple[float, int]] = []
    for level in np.unique(octave):
        members = where[octave == level]
        usual = max(float(np.median(cost[np.isfinite(cost) & (scan.support >= 2.0**level)])), 1e-9)
        for index in members[np.argsort(cost[members], kind="stable")][:per_stratum]:
            rank = scan.support[index] * np.log(usual / max(float(cost[index]), 0.05) + 1.0)
            chosen.append((-float(rank), int(index)))
    chosen.sort()
    return np.array([index for _, index in chosen], dtype=np.int64), np.array([-rank for rank, _ in chosen])
