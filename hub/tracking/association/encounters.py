"""Who is who after two people have met, judged by what they do next.

Two who walk towards each other and stop, or turn together, are where the other was expected, and one scan may exchange
them. What follows shows it. So of two within reach the other hypothesis is kept for a while: that they were exchanged
at one scan, each having made the detections that the other got since. Once these are more probable so, they are
exchanged: two hypotheses of Reid, "An algorithm for tracking multiple targets" (1979), for one pair of people.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.association.assignment import colour_score
from hub.tracking.association.scan import FrameEvidence, ScanResult, associate_jointly
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, STATE_DIM, log_density, with_information
from hub.tracking.filter.prediction import (
    log_evidence,
    log_mixture,
    manoeuvre_hypothesis,
    on_floor,
    predict_targets,
    widened_by_evidence,
)
from hub.tracking.filter.target_models import UPRIGHT
from hub.tracking.filter.target_states import Encounters, Scan, Targets
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats, Ints

_REACH = 1.0  # heights, between two who may be exchanged
_CERTAIN = 2.0
"""Log odds from which on two are exchanged (7 to 1): a wrong exchange costs as much as one that is left out."""
_HOPELESS = -8.0  # log odds, below which the other hypothesis is given up: once in 3000
_MAX_S = 4.0  # who was exchanged is known a second after they part; beyond, a stop or turn says nothing of it


def resolve_encounters(
    encounters: Encounters,
    scan: Scan,
    targets: Targets,
    now_ns: int,
    floor: Floor | None,
    colour_std: float,
    parameters: TrackerParameters,
) -> tuple[Encounters, Targets]:
    """The other hypotheses after a scan, and the targets, exchanged where these are more probable.

    encounters: after the scan before. targets: after the scan's frames, whose associations it holds.
    """
    none = replace(Encounters.empty(), time_ns=now_ns)
    if scan.prior_ns is None or scan.prior_ns != encounters.time_ns or now_ns <= scan.prior_ns:
        return none, targets
    elapsed = (now_ns - scan.prior_ns) / NANOSECONDS
    known = targets.confirmed & UPRIGHT[targets.kind] & np.isin(targets.initiation_number, scan.prior.initiation_number)
    numbers = np.sort(targets.initiation_number[known])
    before, after = _in_order(scan.prior, numbers), _in_order(targets, numbers)
    prior = on_floor(predict_targets(before, elapsed, parameters), floor, elapsed)
    kept = np.isin(encounters.pair, numbers).all(axis=1) & (now_ns - encounters.opened_ns <= _MAX_S * NANOSECONDS)
    encounters = encounters.select(np.flatnonzero(kept))
    met = numbers[_exchangeable(prior, after, elapsed, parameters)]
    pair = np.concatenate([encounters.pair, met])
    if not len(pair):
        return none, targets
    concerned = np.searchsorted(numbers, np.unique(pair))
    before, after, prior = before.select(concerned), after.select(concerned), prior.select(concerned)
    rows = np.searchsorted(np.unique(pair), pair).ravel()
    other, opened = before.select(rows), 2 * len(encounters.pair)
    mean, covariance, colour = other.mean.copy(), other.covariance.copy(), other.colour.copy()
    mean[:opened] = encounters.mean.reshape(-1, STATE_DIM)
    covariance[:opened] = encounters.covariance.reshape(-1, STATE_DIM, STATE_DIM)
    colour[:opened] = encounters.colour.reshape(-1, 3)
    other = replace(other, mean=mean, covariance=covariance, colour=colour)
    other = on_floor(predict_targets(other, elapsed, parameters), floor, elapsed)
    said = associate_jointly(scan.frames, after, now_ns, prior, parameters.up, colour_std, 0)
    colours = _colours(scan, said)
    exchanged = rows.reshape(-1, 2)[:, ::-1].ravel()
    present, _ = _updated(prior.select(rows), elapsed, said.total.of(rows), colours[:, rows], colour_std, parameters)
    fit, other = _updated(other, elapsed, said.total.of(exchanged), colours[:, exchanged], colour_std, parameters)
    every = Encounters(
        now_ns,
        pair,
        other.mean.reshape(-1, 2, STATE_DIM),
        other.covariance.reshape(-1, 2, STATE_DIM, STATE_DIM),
        other.colour.reshape(-1, 2, 3),
        np.append(encounters.log_odds, np.zeros(len(met))) + (fit - present).reshape(-1, 2).sum(axis=1),
        np.append(encounters.opened_ns, np.full(len(met), now_ns)),
    )
    return _decided(every, targets)


def _exchangeable(prior: Targets, after: Targets, elapsed: float, parameters: TrackerParameters) -> Ints:
    """Pairs (k, 2) of targets each of which may as well have come to where the other is now. prior: where expected."""
    off = after.mean[None, :, POSITION] - prior.mean[:, None, POSITION]
    near = np.linalg.norm(off, axis=2) < _REACH * np.exp(prior.mean[:, LOG_SIZE])
    i, j = np.nonzero(np.triu(near | near.T, 1))
    change = manoeuvre_hypothesis(prior, elapsed, parameters.scale.units_per_m, parameters.up)
    spread = change.covariance[:, POSITION, POSITION]

    def fit(a: Ints, b: Ints) -> Floats:
        return log_density(off[a, b], spread[a] + after.covariance[b, POSITION, POSITION])

    return np.stack([i, j], axis=1)[fit(i, j) + fit(j, i) - fit(i, i) - fit(j, j) > 2.0 * _HOPELESS]


def _in_order(targets: Targets, numbers: Ints) -> Targets:
    """The targets with sorted initiation numbers."""
    order = np.argsort(targets.initiation_number)
    return targets.select(order[np.searchsorted(targets.initiation_number[order], numbers)])


def _colours(scan: Scan, said: ScanResult) -> Floats:
    """Colours (f, n, 3) of the detections that each target has in the frames, NaN = none."""
    every = np.full((len(scan.frames), len(said.targets), 3), np.nan)
    for row, one, each in zip(every, scan.frames, said.evidence, strict=True):
        seen = each.column >= 0
        row[seen] = one.frame.colour[each.column[seen]]
    return every


def _updated(
    predicted: Targets,
    elapsed: float,
    said: FrameEvidence,
    colours: Floats,
    colour_std: float,
    parameters: TrackerParameters,
) -> tuple[Floats, Targets]:
    """Log likelihoods (n,) of what a scan says of targets, but for what depends on it alone, and the targets after."""
    change = manoeuvre_hypothesis(predicted, elapsed, parameters.scale.units_per_m, parameters.up)
    measured = said.information, said.vector
    smooth, changed = (
        log_evidence(predicted.mean, one, *measured) for one in (predicted.covariance, change.covariance)
    )
    fit = log_mixture(change.prior_odds, smooth, changed)
    fit = fit + sum(colour_score(one, predicted.colour, colour_std) for one in colours)
    widened = widened_by_evidence(predicted, change, *measured)
    mean, covariance, _ = with_information(predicted.mean, widened, *measured)
    return fit, replace(predicted, mean=mean, covariance=covariance)


def _decided(encounters: Encounters, targets: Targets) -> tuple[Encounters, Targets]:
    """One hypothesis a pair, those that may still be true, and the targets after at most one exchange each."""
    order = np.argsort(-encounters.log_odds, kind="stable")
    _, first = np.unique(encounters.pair[order], axis=0, return_index=True)
    encounters = encounters.select(order[np.sort(first)])
    done: set[int] = set()
    place = {number: row for row, number in enumerate(targets.initiation_number.tolist())}
    mean, covariance, colour = targets.mean.copy(), targets.covariance.copy(), targets.colour.copy()
    seen_ns, seen_by, existence = targets.seen_ns.copy(), targets.seen_by.copy(), targets.existence.copy()
    for k in np.flatnonzero(encounters.log_odds > _CERTAIN).tolist():
        pair = encounters.pair[k].tolist()
        if done & set(pair):
            continue
        done |= set(pair)
        # What they are stays; where they are, and when and by whom they were seen, was the other's.
        rows = [place[number] for number in pair]
        mean[rows], covariance[rows], colour[rows] = encounters.mean[k], encounters.covariance[k], encounters.colour[k]
        for values in (seen_ns, seen_by, existence):
            values[rows] = values[rows[::-1]]
    targets = replace(
        targets, mean=mean, covariance=covariance, colour=colour, seen_ns=seen_ns, seen_by=seen_by, existence=existence
    )
    free = ~np.isin(encounters.pair, list(done)).any(axis=1)
    return encounters.select(np.flatnonzero(free & (encounters.log_odds > _HOPELESS))), targets
