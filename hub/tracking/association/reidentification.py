"""Names that survive: a target that comes into view again gets the name that it had."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.association.initiation import Scale
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.filter.target_models import BODIES
from hub.tracking.filter.target_states import Gone, State, Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats

_COLOUR_STD = 18.0
"""Of one channel of the mean colour of one target between two of its lives."""
_SIZE_STD = 0.05
_FARTHEST_S = 4.0
"""A target lost for longer may be anywhere: only its looks tell."""
_LIMIT, _MARGIN = 14.0, 4.0
_FASTER = 2.5
_COASTING_NS = 400_000_000


def recall(state: State, ready: Bools, scale: Scale) -> State:
    """Confirm targets: each under the name of a lost or coasting one that it can be, or under a new one."""
    if not ready.any():
        return state
    assert state.time_ns is not None
    targets = state.targets
    number, keep = targets.number.copy(), np.ones(len(targets), dtype=np.bool_)
    coasting = targets.confirmed & (targets.seen_ns < state.time_ns - _COASTING_NS)
    places = [-1] * len(state.gone) + np.flatnonzero(coasting).tolist()
    gone = [*state.gone, *(_as_gone(targets, i, state.time_ns) for i in np.flatnonzero(coasting).tolist())]
    next_number = state.next_number
    for index in np.flatnonzero(ready).tolist():
        mean, colour = targets.mean[index], targets.colour[index]
        kind, born_ns = int(targets.kind[index]), int(targets.born_ns[index])
        cost = [_difference(lost, mean, colour, kind, born_ns, scale) for lost in gone]
        order = np.argsort(cost, kind="stable") if cost else np.zeros(0, dtype=np.int64)
        sure = len(order) and cost[order[0]] < _LIMIT
        if sure and len(order) > 1 and cost[order[1]] - cost[order[0]] < _MARGIN:
            sure = False  # two could be meant: a new name is no lie
        if sure:
            best = int(order[0])
            number[index] = gone.pop(best).number
            place = places.pop(best)
            if place >= 0:
                keep[place] = False
        else:
            number[index], next_number = next_number, next_number + 1
    left = tuple(one for one, place in zip(gone, places, strict=True) if place < 0)
    named = replace(targets, number=number)
    return replace(state, targets=named.kept(keep), gone=left, next_number=next_number)


def remember(state: State, lost: Bools, remember_s: float, most: int) -> State:
    """Keep what is known of lost targets; forget what was lost long ago."""
    assert state.time_ns is not None
    new = [_as_gone(state.targets, i, state.time_ns) for i in np.flatnonzero(lost).tolist()]
    kept = [one for one in (*state.gone, *new) if state.time_ns - one.seen_ns <= remember_s * NANOSECONDS]
    return replace(state, gone=tuple(kept[-most:]))


def _as_gone(targets: Targets, i: int, time_ns: int) -> Gone:
    seen = int(targets.seen_ns[i])
    mean = targets.mean[i].copy()
    # Where it was last seen, not where it would have gone.
    mean[POSITION] -= mean[VELOCITY] * ((time_ns - seen) / NANOSECONDS)
    kind, number = int(targets.kind[i]), int(targets.number[i])
    return Gone(number, kind, mean, seen, targets.colour[i], float(targets.colour_count[i]))


def _difference(lost: Gone, mean: Floats, colour: Floats, kind: int, born_ns: int, scale: Scale) -> float:
    """How unlike a lost target and a new one are; inf where they can't be one."""
    if lost.kind != kind:
        return float("inf")
    away = (born_ns - lost.seen_ns) / NANOSECONDS
    body = BODIES[kind]
    metre = float(np.exp(lost.mean[LOG_SIZE])) / body.size_m if body.upright else scale.metre
    distance = float(np.linalg.norm(mean[POSITION] - lost.mean[POSITION]))
    reach = (0.5 + _FASTER * body.speed_m_s * abs(away)) * metre
    if distance > reach and away < 30.0:
        return float("inf")
    off = float(((colour - lost.colour) ** 2).sum()) / _COLOUR_STD**2
    if np.isnan(off):
        off = 3.0 + (0.0 if away < _FARTHEST_S else _LIMIT)  # no looks known: only at once and nearby
    tall = float((mean[LOG_SIZE] - lost.mean[LOG_SIZE]) ** 2) / _SIZE_STD**2 if body.upright else 0.0
    near = (distance / max(reach, 1e-12)) ** 2 if away < _FARTHEST_S else 0.0
    return off + tall + 2.0 * near
