"""Re-identification: reappearing targets get their former track numbers; which track's future is another's past."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY, log_density
from hub.tracking.filter.prediction import (
    ManoeuvreHypothesis,
    log_mixture,
    manoeuvre_hypothesis,
    predict_targets,
    units_of,
)
from hub.tracking.filter.target_models import CLUTTER_COLOUR_STD, TARGET_MODELS, UPRIGHT
from hub.tracking.filter.target_states import MultiTargetState, Targets
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats, Ints

_REGION_M = 1.5
"""Radius within which entries and exits are counted: a walker's way in a second."""
_MAX_LINK_M = 6.0  # between where the past would be and the future: farther pairs are not scored
_COLOUR_MAX = 12.0  # chi-squared of three channels: once in 140 by chance; a shadow or a wrong box
_COLOUR_STD = 18.0
"""Of one channel of the mean colour of one target between two appearances."""
_LOG_SIZE_STD = 0.05  # of a person's height from one appearance to the next
_MAX_MOTION_S = 4.0
"""A target lost for longer may be anywhere: only its appearance is compared."""
_MAX_COST, _MIN_MARGIN = 14.0, 4.0  # chi-squared of colour and size: once in 140 by chance; odds of seven
_IMPOSSIBLE = 1e6  # above all costs
_SPEED_FACTOR = 2.5  # stds of a kind's velocity: faster once in 80
_COASTING_S = 0.4
"""A person without detections for this long, and for one and a half frames, may be the one that begins again; a
marker, of which there are few and which may change its velocity abruptly, after a quarter of a frame."""
_SPEED = np.array([model.speed_std_m_s for model in TARGET_MODELS])


def reidentify(state: MultiTargetState, ready: Bools, parameters: TrackerParameters) -> MultiTargetState:
    """Confirm targets, each with the number of a matching lost or coasting track, or with a new number."""
    if not ready.any():
        return state
    assert state.time_ns is not None
    targets = state.targets
    number, keep = targets.number.copy(), np.ones(len(targets), dtype=np.bool_)
    unseen_s = np.where(UPRIGHT[targets.kind], max(_COASTING_S, 1.5 * state.interval_s), 0.25 * state.interval_s)
    coasting = np.flatnonzero(targets.confirmed & ((state.time_ns - targets.seen_ns) / NANOSECONDS > unseen_s))
    new = np.flatnonzero(ready)
    lost = state.lost.concatenate(targets.select(coasting))
    lost_ns = np.append(state.lost_ns, np.full(len(coasting), state.time_ns))
    cost = _dissimilarity(lost, lost_ns, targets.select(new), state.time_ns, parameters)
    next_number = state.next_number
    for index, best in zip(new.tolist(), _assigned(cost), strict=True):
        if best >= 0:
            number[index] = lost.number[best]
            if best >= len(state.lost):
                keep[coasting[best - len(state.lost)]] = False
        else:
            number[index], next_number = next_number, next_number + 1
    left = ~np.isin(state.lost.number, number)
    named = replace(targets, number=number).select(keep)
    return replace(
        state, targets=named, lost=state.lost.select(left), lost_ns=state.lost_ns[left], next_number=next_number
    )


def _assigned(cost: Floats) -> list[int]:
    """Which lost track each new target is, -1 = none, for costs (n, k): jointly, and only what is certain.

    Certain: every assignment in which the target is another one, or none, costs more by a margin.
    """
    n, k = cost.shape
    every = np.hstack([np.minimum(cost, _IMPOSSIBLE), np.full((n, n), _MAX_COST)])
    row, column = linear_sum_assignment(every)
    least, out = every[row, column].sum(), []
    for i, j in zip(row.tolist(), column.tolist(), strict=True):
        other = every.copy()
        other[i, j] = _IMPOSSIBLE
        certain = j < k and other[linear_sum_assignment(other)].sum() - least >= _MIN_MARGIN
        out.append(j if certain else -1)
    return out


def store_lost_tracks(state: MultiTargetState, lost: Bools, remember_s: float, most: int) -> MultiTargetState:
    """Store newly lost tracks; forget those lost long ago. most: how many are kept."""
    assert state.time_ns is not None
    every = state.lost.concatenate(state.targets.select(lost))
    lost_ns = np.append(state.lost_ns, np.full(int(lost.sum()), state.time_ns))
    kept = np.flatnonzero(state.time_ns - every.seen_ns <= remember_s * NANOSECONDS)[-most:]
    return replace(state, lost=every.select(kept), lost_ns=lost_ns[kept])


def _dissimilarity(lost: Targets, lost_ns: Floats, new: Targets, time_ns: int, parameters: TrackerParameters) -> Floats:
    """The cost (n, k) of identifying each new target, as it is at ``time_ns``, with each lost one; inf = impossible.

    Minus twice a log likelihood, over that of the same target at rest: colour, size, and the motion since, which may
    include a change of the velocity.
    """
    cost = np.full((len(new), len(lost)), np.inf)
    if not len(lost):
        return cost
    past = predict_targets(lost, (time_ns - lost_ns) / NANOSECONDS, parameters)
    gap_s = (time_ns - lost.seen_ns) / NANOSECONDS
    units = units_of(lost, parameters.scale.units_per_m)
    change = manoeuvre_hypothesis(past, gap_s, parameters.scale.units_per_m, parameters.up)
    place = lost.mean[:, POSITION] - ((lost_ns - lost.seen_ns) / NANOSECONDS)[:, None] * lost.mean[:, VELOCITY]
    reach = (0.5 + _SPEED_FACTOR * _SPEED[lost.kind] * np.abs(gap_s)) * units
    soon = gap_s < _MAX_MOTION_S
    for i in range(len(new)):
        near = np.linalg.norm(new.mean[i, POSITION] - place, axis=1) <= reach
        possible = (lost.kind == new.kind[i]) & (near | (gap_s >= 30.0))
        own = new.covariance[i, POSITION, POSITION]
        smooth, changed = past.covariance[:, POSITION, POSITION] + own, change.covariance[:, POSITION, POSITION] + own
        off = new.mean[i, POSITION] - past.mean[:, POSITION]
        fit, best = (
            log_mixture(change.prior_odds, log_density(one, smooth), log_density(one, changed))
            for one in (off, np.zeros_like(off))
        )
        # No colour known: only soon after and nearby.
        colour = ((new.colour[i] - lost.colour) ** 2).sum(axis=1) / _COLOUR_STD**2
        colour = np.where(np.isnan(colour), np.where(soon, 3.0, 3.0 + _MAX_COST), colour)
        size = np.where(UPRIGHT[lost.kind], (new.mean[i, LOG_SIZE] - lost.mean[:, LOG_SIZE]) ** 2, 0.0)
        total = colour + size / _LOG_SIZE_STD**2 + np.where(soon, 2.0 * (best - fit), 0.0)
        cost[i, possible] = total[possible]
    return cost


@dataclass(frozen=True, slots=True, eq=False)
class EntryExitRates:
    """Where tracks begin and end, a scan, as estimated from all tracks of a recording.

    Rates by counts within a radius, with Jeffreys' prior (half an event): people come and go at doors and at the
    borders of what the cameras see, not in the middle of a hall. Entry and exit zones: Makris and Ellis, "Learning
    semantic scene models from observing activity in visual surveillance" (2005).

    starts, ends: (n, 3) of each track, NaN where that is unknown. scans: their number.
    """

    starts: Floats
    ends: Floats
    scans: int
    radius: float
    _trees: tuple[cKDTree, cKDTree, cKDTree]

    @classmethod
    def of(cls, starts: Floats, ends: Floats, visits: Floats, scans: int, units_per_m: float) -> EntryExitRates:
        """From where tracks begin and end. visits: (v, 3) places of all tracks at all scans."""
        trees = [cKDTree(points[np.isfinite(points).all(axis=1)]) for points in (starts, ends, visits)]
        return cls(starts, ends, scans, _REGION_M * units_per_m, (trees[0], trees[1], trees[2]))

    def log_entry(self, track: Ints, place: Floats) -> Floats:
        """Log rate (n,) of others' beginnings, an area unit and a scan, where a track is. track: (n,) its number."""
        begun = self._within(0, place) - self._is_own(self.starts, track, place)
        return np.asarray(np.log((begun + 0.5) / (np.pi * self.radius**2 * self.scans)))

    def log_exit(self, track: Ints, place: Floats) -> Floats:
        """Log odds (n,) of ending at a scan, against going on, where a track is."""
        ended = self._within(1, place) - self._is_own(self.ends, track, place)
        return np.asarray(np.log((ended + 0.5) / (np.maximum(self._within(2, place) - ended, 0.0) + 0.5)))

    def _within(self, which: int, place: Floats) -> Floats:
        found = self._trees[which].query_ball_point(place, self.radius, return_length=True)
        return np.asarray(found, dtype=np.float64)

    def _is_own(self, points: Floats, track: Ints, place: Floats) -> Floats:
        return np.asarray(np.linalg.norm(points[track] - place, axis=1) <= self.radius, dtype=np.float64)


def continuation_scores(
    past: Targets,
    future: Targets,
    manoeuvre: ManoeuvreHypothesis,
    gap_s: Floats,
    rates: tuple[Floats, Floats],
    units_per_m: float,
    typical: float,
    colour_std: float,
) -> Floats:
    """Log odds (h, t) of each future continuing each past, against the past ending and the future beginning anywhere.

    past, future: h and t tracks at one time, from the detections before and from those after it; two with one
    ``initiation_number`` are the same track. manoeuvre: second hypothesis of the pasts.
    gap_s: (h,) since the last detections. rates: log odds (h,) of the pasts' ending, and log rate (t,) of new tracks
    where the futures begin. typical: log of a typical size.
    """
    off = past.mean[:, None] - future.mean[None]
    near = np.linalg.norm(off[..., POSITION], axis=2) < _MAX_LINK_M * units_per_m
    a, b = np.nonzero(near & (past.kind[:, None] == future.kind[None, :]))
    score = np.full(near.shape, -np.inf)
    if not len(a):
        return score
    total = past.covariance[a] + future.covariance[b]
    changed = log_density(off[a, b], manoeuvre.covariance[a] + future.covariance[b])
    fit = log_mixture(manoeuvre.prior_odds[a], log_density(off[a, b], total), changed)
    # The same, had the future begun anywhere: position uniform, velocity and size from their priors.
    model = [TARGET_MODELS[kind] for kind in future.kind.tolist()]
    speed = np.array([one.speed_std_m_s for one in model]) * units_per_m
    free = future.covariance[:, VELOCITY, VELOCITY] + speed[:, None, None] ** 2 * np.eye(3)
    velocity = future.mean[:, VELOCITY]
    chance = -0.5 * (np.einsum("ni,nij,nj->n", velocity, np.linalg.inv(free), velocity) + np.linalg.slogdet(free)[1])
    size2 = np.array([one.log_size_std for one in model]) ** 2 + future.covariance[:, LOG_SIZE, LOG_SIZE]
    chance -= 0.5 * ((future.mean[:, LOG_SIZE] - typical) ** 2 / size2 + np.log(size2))
    # The height is that of the floor in both cases: only the two horizontal dimensions are free.
    vertical = np.linalg.eigvalsh(total[:, POSITION, POSITION])[:, 0]
    chance_of = chance[b] + rates[1][b] - 0.5 * np.log(vertical) + np.log(2.0 * np.pi)
    off2 = ((past.colour[a] - future.colour[b]) ** 2).sum(axis=1) / colour_std**2
    alike = np.nan_to_num(3.0 * np.log(CLUTTER_COLOUR_STD / colour_std) - 0.5 * np.minimum(off2, _COLOUR_MAX))
    alike[past.initiation_number[a] == future.initiation_number[b]] = 0.0  # one track's colour says nothing of it
    score[a, b] = fit - chance_of - rates[0][a] - gap_s[a] + alike
    return score
