"""Re-identification: a target that reappears gets its former track number, by colour, size and position."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.association.initiation import LengthScale
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.filter.target_models import TARGET_MODELS
from hub.tracking.filter.target_states import LostTrack, MultiTargetState, Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats

_COLOUR_STD = 18.0
"""Of one channel of the mean colour of one target between two appearances."""
_LOG_SIZE_STD = 0.05  # of a person's height from one appearance to the next
_MAX_MOTION_S = 4.0
"""A target lost for longer may be anywhere: only its appearance is compared."""
_MAX_COST, _MIN_MARGIN = 14.0, 4.0
_SPEED_FACTOR = 2.5
_COASTING_S = 0.4
"""A person without detections for this long, and for one and a half frames, may be the one that begins again; a
marker, of which there are few and which may change its velocity abruptly, after a quarter of a frame."""
_UPRIGHT = np.array([model.upright for model in TARGET_MODELS])


def reidentify(state: MultiTargetState, ready: Bools, scale: LengthScale) -> MultiTargetState:
    """Confirm targets, each with the number of a matching lost or coasting track, or with a new number."""
    if not ready.any():
        return state
    assert state.time_ns is not None
    targets = state.targets
    number, keep = targets.number.copy(), np.ones(len(targets), dtype=np.bool_)
    unseen_s = np.where(_UPRIGHT[targets.kind], max(_COASTING_S, 1.5 * state.interval_s), 0.25 * state.interval_s)
    coasting = targets.confirmed & ((state.time_ns - targets.seen_ns) / NANOSECONDS > unseen_s)
    coasting_rows = [-1] * len(state.lost_tracks) + np.flatnonzero(coasting).tolist()
    lost_tracks = [
        *state.lost_tracks,
        *(_lost_track(targets, i, state.time_ns) for i in np.flatnonzero(coasting).tolist()),
    ]
    next_number = state.next_number
    for index in np.flatnonzero(ready).tolist():
        mean, colour = targets.mean[index], targets.colour[index]
        kind = int(targets.kind[index])
        cost = [_dissimilarity(lost, mean, colour, kind, state.time_ns, scale) for lost in lost_tracks]
        order = np.argsort(cost, kind="stable") if cost else np.zeros(0, dtype=np.int64)
        is_match = len(order) and cost[order[0]] < _MAX_COST
        if is_match and len(order) > 1 and cost[order[1]] - cost[order[0]] < _MIN_MARGIN:
            is_match = False  # ambiguous: a new number is the safe choice
        if is_match:
            best = int(order[0])
            number[index] = lost_tracks.pop(best).number
            coasting_row = coasting_rows.pop(best)
            if coasting_row >= 0:
                keep[coasting_row] = False
        else:
            number[index], next_number = next_number, next_number + 1
    left = tuple(one for one, coasting_row in zip(lost_tracks, coasting_rows, strict=True) if coasting_row < 0)
    named = replace(targets, number=number)
    return replace(state, targets=named.select(keep), lost_tracks=left, next_number=next_number)


def store_lost_tracks(state: MultiTargetState, lost: Bools, remember_s: float, most: int) -> MultiTargetState:
    """Store newly lost tracks; forget those lost long ago. most: how many are kept."""
    assert state.time_ns is not None
    new = [_lost_track(state.targets, i, state.time_ns) for i in np.flatnonzero(lost).tolist()]
    kept = [one for one in (*state.lost_tracks, *new) if state.time_ns - one.seen_ns <= remember_s * NANOSECONDS]
    return replace(state, lost_tracks=tuple(kept[-most:]))


def _lost_track(targets: Targets, i: int, time_ns: int) -> LostTrack:
    seen = int(targets.seen_ns[i])
    mean = targets.mean[i].copy()
    # The position at the last detection, not the extrapolated one.
    mean[POSITION] -= mean[VELOCITY] * ((time_ns - seen) / NANOSECONDS)
    kind, number = int(targets.kind[i]), int(targets.number[i])
    return LostTrack(number, kind, mean, seen, targets.colour[i], float(targets.colour_count[i]))


def _dissimilarity(lost: LostTrack, mean: Floats, colour: Floats, kind: int, time_ns: int, scale: LengthScale) -> float:
    """The cost of identifying a new target, as it is at ``time_ns``, with a lost one; inf where that is impossible."""
    if lost.kind != kind:
        return float("inf")
    gap_s = (time_ns - lost.seen_ns) / NANOSECONDS
    model = TARGET_MODELS[kind]
    units_per_m = float(np.exp(lost.mean[LOG_SIZE])) / model.size_m if model.upright else scale.units_per_m
    distance = float(np.linalg.norm(mean[POSITION] - lost.mean[POSITION]))
    max_distance = (0.5 + _SPEED_FACTOR * model.speed_std_m_s * abs(gap_s)) * units_per_m
    if distance > max_distance and gap_s < 30.0:
        return float("inf")
    colour_cost = float(((colour - lost.colour) ** 2).sum()) / _COLOUR_STD**2
    if np.isnan(colour_cost):
        colour_cost = 3.0 + (0.0 if gap_s < _MAX_MOTION_S else _MAX_COST)  # no colour known: only soon after and nearby
    size_cost = float((mean[LOG_SIZE] - lost.mean[LOG_SIZE]) ** 2) / _LOG_SIZE_STD**2 if model.upright else 0.0
    distance_cost = (distance / max(max_distance, 1e-12)) ** 2 if gap_s < _MAX_MOTION_S else 0.0
    return colour_cost + size_cost + 2.0 * distance_cost
