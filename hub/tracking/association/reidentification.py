"""Re-identification: a target that reappears gets its former track number, by colour, size and motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY, log_density
from hub.tracking.filter.prediction import log_mixture, manoeuvre_hypothesis, predict_targets, units_of
from hub.tracking.filter.target_models import TARGET_MODELS, UPRIGHT
from hub.tracking.filter.target_states import MultiTargetState, Targets
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats

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
