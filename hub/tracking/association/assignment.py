"""Which detection of a frame is which target: joint assignment by what the filter expects and by colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.tracking.camera_frame import Frame, TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE
from hub.tracking.filter.measurement import FOOT, HEAD, POINT, SEEN_SIZE, Expected
from hub.tracking.filter.target_models import BODIES
from hub.tracking.filter.target_states import Targets
from protocols.geometry.types import Bools, Floats, Ints

POINT_GATE = 18.4
"""Of the representative point: chance beyond 1e-4 (chi2, 2 dof)."""
PART_GATE = 13.8
"""Of head and foot: chance beyond 1e-3; beyond, that part is something else and is not used."""
_SIZE_GATE = 9.0
_MOST = 45.0
"""Cost of leaving a detection alone: that of a fit at the gate by a target known to some 10 px."""
_PART_SHARE, _PART_MOST = 0.5, 12.0
COLOUR_STD = 28.0
"""Of one channel between cameras, at the most: light and white balance differ. How far is learnt (`alikeness`)."""
_LEAST_COLOUR_STD, _TAILS = 14.0, 2.0
"""At the least, and how much wider than its std a colour's error is taken: parts of others come into it."""
_SURE, _LEARNT = 0.05, 0.002
"""Pairings more doubtful than this teach nothing; weight of one that does."""
_COLOUR_MOST = 12.0
_HINT = 2.0
"""What the camera's own matching counts."""
_STRANGER = 30.0
"""Cost at which a person's detection may as well be that of somebody who is not followed yet."""
_TEMPER = 4.0
"""Costs by which a pairing is e times less likely: 2 if what frames tell were independent; errors last for a while."""
_WIDTH = 0.2
_LENGTH = 0.6
"""Where silhouettes touch: shares of the sum of two lengths, across and along the body."""
_UPRIGHT = np.array([body.upright for body in BODIES])


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Of n targets and m detections. total: (n, m), inf beyond the gate.

    distance: (n, m, 3) squared Mahalanobis distances of point, head, foot, NaN where not told.
    """

    total: Floats
    distance: Floats


def costs(
    frame: Frame,
    value: Floats,
    noise: Floats,
    targets: Targets,
    expected: Expected,
    names: tuple[str, ...],
    colour_std: float = COLOUR_STD,
) -> Costs:
    """How ill each detection fits each target.

    value, noise: (m, 7), (m, 7, 7) of the frame. names: of the targets. colour_std: of a channel.
    """
    n, m = len(targets), len(frame)
    distance = np.full((n, m, 3), np.nan)
    spread = np.zeros((n, m))
    for part, rows in enumerate((POINT, HEAD, FOOT)):
        slope = expected.slope[:, rows]
        own = slope @ targets.covariance @ slope.transpose(0, 2, 1) + expected.body_noise[:, rows, rows]
        both = own[:, None] + noise[None, :, rows, rows]
        a, b, c = both[..., 0, 0], both[..., 0, 1], both[..., 1, 1]
        determinant = a * c - b * b
        off = value[None, :, rows] - expected.value[:, None, rows]
        x, y = off[..., 0], off[..., 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            distance[:, :, part] = (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
            if rows is POINT:
                spread = np.log(determinant / frame.per[None, :] ** 4)
    parts = np.minimum(np.nan_to_num(distance[:, :, 1:], nan=_PART_MOST / 3.0), _PART_MOST).sum(axis=2)
    with np.errstate(invalid="ignore"):
        shade = ((frame.colour[None] - targets.colour[:, None]) ** 2).sum(axis=2) / colour_std**2
    shade = np.minimum(np.nan_to_num(shade, nan=_COLOUR_MOST / 4.0), _COLOUR_MOST)
    total = distance[:, :, 0] + spread + _PART_SHARE * parts + shade
    if any(frame.target):
        total = total - _HINT * (np.array(names)[:, None] == np.array(frame.target)[None, :])
    good = (distance[:, :, 0] < POINT_GATE) & (targets.kind[:, None] == frame.kind[None, :]) & (total < _MOST)
    return Costs(np.where(good, total, np.inf), distance)


def either(one: Costs, other: Costs, odds: Floats) -> Costs:
    """Costs if one of two hypotheses of each target holds. odds: (n,) of the second against the first."""
    with np.errstate(divide="ignore"):
        less = 2.0 * np.log(odds)[:, None]
    better = other.total - less < one.total
    total = -2.0 * np.logaddexp(-0.5 * one.total, 0.5 * (less - other.total))
    return Costs(np.asarray(total), np.where(better[:, :, None], other.distance, one.distance))


def assign(total: Floats) -> tuple[Ints, Ints]:
    """Rows and columns of the cheapest joint assignment; what is cheaper alone stays alone. total: (n, m)."""
    if not np.isfinite(total).any():
        none = np.zeros(0, dtype=np.int64)
        return none, none
    rows, columns = linear_sum_assignment(np.where(np.isfinite(total), total, _MOST))
    good = np.isfinite(total[rows, columns])
    return rows[good].astype(np.int64), columns[good].astype(np.int64)


def strangers(kind: Ints) -> Floats:
    """What it costs (k,) to take a detection for that of nobody who is followed. kind: (k,) of the targets.

    People come in numbers and look alike; a marker is seldom another's.
    """
    return np.where(_UPRIGHT[kind], _STRANGER, np.inf)


def ambiguity(total: Floats, row: Ints, column: Ints, stranger: Floats) -> Floats:
    """How probable it is of matched pairs (k,) that the detection is another's: 0 to 1/2.

    Other targets either exchange their own with it or, where they have none, take it; or it is a stranger's, whom no
    target follows. total: (n, m) costs, inf = cannot be. stranger: (k,) as `strangers` says.
    """
    if not len(row):
        return np.zeros(0)
    own = total[row, column]
    crossed = total[np.ix_(row, column)]
    np.fill_diagonal(crossed, np.inf)
    more = (crossed + crossed.T - own[:, None] - own[None, :]).min(axis=1)
    idle = np.setdiff1d(np.arange(len(total)), row)
    if len(idle):
        more = np.minimum(more, total[np.ix_(idle, column)].min(axis=0) - own)
    more = np.minimum(more, stranger - own)
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(more / _TEMPER, 0.0, 60.0))))


def alikeness(before: float, told: Floats, known: Floats, doubtful: Floats) -> float:
    """The variance of one channel between what is told and what is known, renewed by a frame's pairings.

    told, known: (k, 3) colours, NaN where none is. doubtful: (k,) as `ambiguity` says.
    """
    off = np.minimum(((told - known) ** 2).mean(axis=1), COLOUR_STD**2)
    for one in off[(doubtful < _SURE) & np.isfinite(off)].tolist():
        before += _LEARNT * (one - before)
    return before


def colour_std(variance: float) -> float:
    """The std of a channel with which detections are told apart."""
    return float(np.clip(_TAILS * np.sqrt(variance), _LEAST_COLOUR_STD, COLOUR_STD))


def rows_used(value: Floats, expected: Expected, distance: Floats, covariance: Floats) -> Bools:
    """Which rows (k, 7) of matched measurements count: a head or foot out of its gate is another's, or hidden."""
    used = np.isfinite(value) & np.isfinite(expected.value)
    for part, rows in ((1, HEAD), (2, FOOT)):
        used[:, rows] &= (distance[:, part] < PART_GATE)[:, None]
    slope = expected.slope[:, SEEN_SIZE]
    spread = np.einsum("ni,nij,nj->n", slope, covariance, slope) + expected.body_noise[:, SEEN_SIZE, SEEN_SIZE]
    with np.errstate(invalid="ignore"):
        used[:, SEEN_SIZE] &= (value[:, SEEN_SIZE] - expected.value[:, SEEN_SIZE]) ** 2 < _SIZE_GATE * spread
    return used


def overlaps(camera: TrackingCamera, expected: Expected, targets: Targets) -> tuple[Bools, Bools]:
    """Of targets in one image: (crowded, hidden), (n,) each.

    crowded: its silhouette touches that of another confirmed target, so that the two may be one. hidden: that other
    one stands in front.
    """
    n = len(targets)
    point = expected.value[:, POINT]
    length = np.exp(targets.mean[:, LOG_SIZE]) / np.where(expected.depth > 0.0, expected.depth, np.inf)
    along = expected.value[:, HEAD] - expected.value[:, FOOT]
    norm = np.linalg.norm(along, axis=1)
    upright = np.isfinite(norm) & (norm > 0.0)
    along = np.where(upright[:, None], along / np.where(upright, norm, 1.0)[:, None], [0.0, 1.0])
    length = np.where(upright, norm, length)
    off = point[None] - point[:, None]
    with np.errstate(invalid="ignore"):
        lengthwise = np.abs((off * along[:, None]).sum(axis=2))
        across = np.abs(off[..., 0] * along[:, None, 1] - off[..., 1] * along[:, None, 0])
        total = length[:, None] + length[None, :]
        width = np.where(upright, _WIDTH, _LENGTH)
        touching = (across < width[:, None] * total) & (lengthwise < _LENGTH * total)
    seen = camera.sees(point, expected.depth)
    touching &= targets.confirmed[None, :] & seen[None, :] & seen[:, None]
    touching[np.arange(n), np.arange(n)] = False
    behind = expected.depth[:, None] > expected.depth[None, :]
    return touching.any(axis=1), (touching & behind).any(axis=1)
