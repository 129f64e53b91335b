"""Lag and relative pose of two cameras from the poses of one rigid body in their views, over all lags.

At the true lag the motion from camera a's axes to camera b's, ``T_b(t + lag) T_a(t)^-1``, is the same for all views. Of
all lags of a grid the one is taken at which most views agree. Rotations are averaged as the largest eigenvector of the
sum of their quaternions' outer products (Markley et al., "Averaging Quaternions", 2007).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from hub.calibration.rigid_body.views import ViewPoses
from protocols.geometry import so3
from protocols.geometry.types import Bools, Floats, Ints

_MAX_VIEWS = 300  # of camera a in a scan
_CHUNK = 256  # lags at a time
_ANGLE, _DISTANCE = np.deg2rad(6.0), 0.06  # rad; of the body's distance: a view this far off agrees no more
_MIN_OVERLAP = 10  # views
_MAX_GAPS = 3.2  # median frame intervals across which a pose is interpolated
_MIN_AGREEMENT = 0.5  # share of the overlap's views
_MAX_SECOND = 0.8  # of the second-best lag's agreement over the best one's
_PEAK = 0.6  # s around the best lag that belong to it, at least


@dataclass(frozen=True, slots=True, eq=False)
class BodyPair:
    """Lag and relative pose of a pair: ``t_b = t_a + lag``, ``x_b = rotation x_a + translation``.

    agreement: number of views that agree, softly. share: of the views in the overlap. reason: "" = accepted.
    """

    lag: float
    rotation: Floats
    translation: Floats
    agreement: float
    share: float
    reason: str = ""


def solve_body_pair(a: ViewPoses, b: ViewPoses, lags: Floats | None = None) -> BodyPair:
    """Lag and relative pose of two cameras; refused with a reason.

    lags: the ones to be tried [s]; None = all with an overlap.
    """
    nothing = BodyPair(0.0, np.eye(3), np.zeros(3), 0.0, 0.0)
    if min(len(a.time), len(b.time)) < _MIN_OVERLAP:
        few = min(len(a.time), len(b.time))
        return _refused(nothing, f"the board's pose is known in only {few} frames of one of them")
    scan = _Scan(a, b)
    grid = scan.grid() if lags is None else lags
    if not len(grid):
        return _refused(nothing, "too few frames with the board")
    agreement, share = scan.score(grid)
    agreement = np.where(share >= _MIN_AGREEMENT, agreement, 0.0)
    best = int(np.argmax(agreement))
    if agreement[best] < _MIN_OVERLAP * 0.5:
        return _refused(nothing, "the board's motions agree at no lag")
    step = float(np.median(np.diff(grid))) if len(grid) > 1 else 0.0
    lag = float(grid[best])
    for width in (step, step / 4, step / 16):
        if width > 0.0:
            fine = lag + width * np.linspace(-1.0, 1.0, 9)
            values, _ = scan.score(fine)
            lag = float(fine[int(np.argmax(values))])
    rotation, translation, value, part = scan.motion(lag)
    found = BodyPair(lag, rotation, translation, value, part)
    elsewhere = np.abs(grid - lag) > max(_PEAK, 4.0 * step)
    second = float(agreement[elsewhere].max(initial=0.0))
    if second > _MAX_SECOND * value:
        other = float(grid[elsewhere][int(np.argmax(agreement[elsewhere]))])
        return _refused(found, f"two lags fit the board's motion, {lag:.2f} and {other:.2f} s: move it less evenly")
    return found


def _refused(pair: BodyPair, reason: str) -> BodyPair:
    return BodyPair(pair.lag, pair.rotation, pair.translation, pair.agreement, pair.share, reason)


class _Scan:
    """Agreement of two cameras' views at many lags."""

    def __init__(self, a: ViewPoses, b: ViewPoses) -> None:
        chosen = np.unique(np.linspace(0, len(a.time) - 1, min(len(a.time), _MAX_VIEWS)).round().astype(int))
        self._time = a.time[chosen]
        self._body = a.body[chosen]
        self._turn_a = quaternions(a.rotation[chosen, 0])
        self._place_a = a.translation[chosen, 0]
        self._b = b
        self._turn_b = quaternions(b.rotation[:, 0])
        self._gap_a, self._gap_b = _interval(a), _interval(b)
        self._weight = _motion_weights(a)[chosen]

    def grid(self) -> Floats:
        """All lags with an overlap, at half the shorter frame interval."""
        step = 0.5 * min(self._gap_a, self._gap_b)
        first = self._b.time.min() - self._time.max()
        last = self._b.time.max() - self._time.min()
        return np.asarray(np.arange(np.ceil(first / step), np.floor(last / step) + 1) * step)

    def score(self, lags: Floats) -> tuple[Floats, Floats]:
        """Views that agree (n,), and their share (n,) of the overlap, at lags (n,)."""
        parts = [self._evaluate(lags[i : i + _CHUNK])[2:] for i in range(0, len(lags), _CHUNK)]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def motion(self, lag: float) -> tuple[Floats, Floats, float, float]:
        """Rotation (3, 3) and translation (3,) from a to b at a lag, with agreement and share."""
        turn, place, agreement, share = self._evaluate(np.array([lag]))
        return rotations(turn)[0], place[0], float(agreement[0]), float(share[0])

    def _evaluate(self, lags: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        turn_b, place_b, known = self._interpolated(self._time + lags[:, None])
        count = (known * self._weight).sum(axis=1)
        relative = _multiply(turn_b, self._turn_a * np.array([1.0, -1.0, -1.0, -1.0]))
        weight = np.where(known, self._weight, 0.0)
        depth = np.linalg.norm(place_b, axis=2) + np.linalg.norm(self._place_a, axis=1)
        turn, place, cost = np.zeros((len(lags), 4)), np.zeros((len(lags), 3)), np.ones(known.shape)
        for _ in range(3):
            moment = np.einsum("li,lia,lib->lab", weight, relative, relative)
            turn = np.linalg.eigh(moment)[1][:, :, -1]
            angle = 2.0 * np.arccos(np.clip(np.abs(np.einsum("lia,la->li", relative, turn)), 0.0, 1.0))
            shift = place_b - np.einsum("lab,ib->lia", rotations(turn), self._place_a)
            total = np.maximum(weight.sum(axis=1), 1e-12)
            place = np.einsum("li,lia->la", weight, shift) / total[:, None]
            distance = np.linalg.norm(shift - place[:, None], axis=2) / np.maximum(0.5 * depth, 1e-12)
            cost = (angle / _ANGLE) ** 2 + (distance / _DISTANCE) ** 2
            weight = np.where(known, self._weight / (1.0 + cost) ** 2, 0.0)
        agreement = np.where(known, self._weight / (1.0 + cost), 0.0).sum(axis=1)
        enough = known.sum(axis=1) >= _MIN_OVERLAP
        return turn, place, np.where(enough, agreement, 0.0), np.where(enough, agreement / np.maximum(count, 1e-9), 0.0)

    def _interpolated(self, time: Floats) -> tuple[Floats, Floats, Bools]:
        """Camera b's poses at times (l, m), and whether each is known; each of the body that camera a saw."""
        turn, place = np.zeros((*time.shape, 4)), np.ones((*time.shape, 3))
        turn[..., 0] = 1.0
        known = np.zeros(time.shape, dtype=np.bool_)
        for body in np.unique(self._body):
            of_b = np.flatnonzero(self._b.body == body)
            mine = np.flatnonzero(self._body == body)
            if len(of_b) < 2:
                continue
            stamps = self._b.time[of_b]
            after = np.clip(np.searchsorted(stamps, time[:, mine]), 1, len(stamps) - 1)
            first, last = of_b[after - 1], of_b[after]
            gap = self._b.time[last] - self._b.time[first]
            u = (time[:, mine] - self._b.time[first]) / np.maximum(gap, 1e-9)
            known[:, mine] = (u >= 0.0) & (u <= 1.0) & (gap <= _MAX_GAPS * self._gap_b)
            turn[:, mine] = _between(self._turn_b[first], self._turn_b[last], u)
            ends = self._b.translation[:, 0]
            place[:, mine] = ends[first] + u[..., None] * (ends[last] - ends[first])
        return turn, place, known


def _interval(views: ViewPoses) -> float:
    """Median time between a body's views [s]."""
    same = np.diff(views.body) == 0
    steps = np.diff(views.time)[same]
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 1.0


def _motion_weights(views: ViewPoses) -> Floats:
    """Weights (m,) of the views: small where the body hardly moves, because such views agree at every lag."""
    if len(views.time) < 3:
        return np.ones(len(views.time))
    turn = quaternions(views.rotation[:, 0])
    cosine = np.abs((turn[1:] * turn[:-1]).sum(axis=1))
    depth = np.linalg.norm(views.translation[:, 0], axis=1)
    step = np.linalg.norm(np.diff(views.translation[:, 0], axis=0), axis=1) / np.minimum(depth[1:], depth[:-1])
    motion = 2.0 * np.arccos(np.clip(cosine, 0.0, 1.0)) / _ANGLE + step / _DISTANCE
    motion[np.diff(views.body) != 0] = 0.0
    each = np.maximum(np.r_[motion, 0.0], np.r_[0.0, motion])
    usual = max(float(np.median(each)), 1e-6)
    return np.asarray(np.clip(each / usual, 0.05, 1.0))


def quaternions(rotation: Floats) -> Floats:
    """Unit quaternions w, x, y, z (n, 4) of rotations (n, 3, 3)."""
    return np.array([so3.quaternion(one) for one in rotation]).reshape(-1, 4)


def rotations(turn: Floats) -> Floats:
    """Rotations (n, 3, 3) of quaternions w, x, y, z (n, 4) of any norm."""
    w, x, y, z = (turn / np.linalg.norm(turn, axis=-1, keepdims=True)).T
    return np.asarray(
        np.stack(
            [
                np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
                np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
                np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
            ],
            axis=-2,
        )
    )


def aligned(turn: Floats, order: Ints) -> Floats:
    """The quaternions (n, 4) with signs such that each is near its predecessor in ``order``."""
    out = turn.copy()
    for before, after in itertools.pairwise(order):
        if out[before] @ out[after] < 0.0:
            out[after] = -out[after]
    return out


def _multiply(p: Floats, q: Floats) -> Floats:
    """Products of quaternions, broadcast over all axes but the last."""
    pw, px, py, pz = np.moveaxis(p, -1, 0)
    qw, qx, qy, qz = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def _between(first: Floats, last: Floats, u: Floats) -> Floats:
    """Normalised linear interpolation of quaternions on the shorter way."""
    sign = np.where((first * last).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    mixed = (1.0 - u[..., None]) * first + u[..., None] * sign * last
    return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=-1, keepdims=True), 1e-12))
