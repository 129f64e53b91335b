"""Joint association over a scan: the last frames of all cameras, each at most once.

The tracker takes frames one after another. In a crowd, and at few frames a second, one camera alone cannot tell whose
detection is whose, while all cameras of an instant together can. So the association of each frame of the scan is
repeated given the detections of all others, until nothing changes: iterated conditional modes of the joint posterior
(Besag 1986), one camera's assignment at a time. All cameras may agree on a wrong one: the first exchanged two people,
and the others followed. So what all frames say of each target is then assigned to the targets as a whole.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.tracking.association.assignment import (
    assign,
    association_scores,
    colour_score,
    gated_rows,
    matched_noise,
    occlusions,
)
from hub.tracking.filter import kalman
from hub.tracking.filter.detection_model import (
    detection_probability,
    false_detections,
    independent_fraction,
    log_odds,
    posterior_existence,
    visible_fraction,
    with_frame_noise,
)
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, STATE_DIM
from hub.tracking.filter.measurement import PredictedMeasurement, noise_of, predict_measurement
from hub.tracking.filter.prediction import ManoeuvreHypothesis, log_evidence, log_mixture, widened_by_evidence
from hub.tracking.filter.target_states import ScanFrame, Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats, Ints

MAX_SWEEPS = 4  # of coordinate descent over the frames of a scan
_EXCHANGES = 2  # of whole scans, each followed by sweeps
_REACH = 1.0  # heights: further apart, two people's detections in one scan are not exchanged
_IMPOSSIBLE, _TIE = -1e6, 1e-6
"""Log likelihood of a pair that is out of reach; by how much another order must be better."""
MAX_LOG_ODDS = 9.0  # e^9: no single measurement may decide by more
AMBIGUOUS = 0.95
"""Association probability below which a frame's association is repeated with the others of its scan."""
_ITERATIONS = 12
"""Messages contract by a constant factor each time; after twelve, no probability of a crowd of 20 changed by 0.01."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameEvidence:
    """What one frame says of n targets: information (n, 7, 7) and its vector (n, 7) at the scan's time, change of the
    log odds of existence (n,), that change had it not been detected (n,), and the associated detection (n,), -1 =
    none."""

    information: Floats
    vector: Floats
    odds: Floats
    missed: Floats
    column: Ints

    def of(self, index: Ints) -> FrameEvidence:
        """The same of other targets; index: (k,) which of these each is, -1 = none of them: nothing is said of it."""
        known = index >= 0

        def part(values: Floats) -> Floats:
            out = np.zeros((len(index), *values.shape[1:]))
            out[known] = values[index[known]]
            return out

        column = np.full(len(index), -1)
        column[known] = self.column[index[known]]
        return FrameEvidence(part(self.information), part(self.vector), part(self.odds), part(self.missed), column)

    def __add__(self, other: FrameEvidence) -> FrameEvidence:
        """What both say; ``column`` is no longer of any frame."""
        return FrameEvidence(
            self.information + other.information,
            self.vector + other.vector,
            self.odds + other.odds,
            self.missed + other.missed,
            np.full_like(self.column, -1),
        )


@dataclass(frozen=True, slots=True, eq=False)
class ScanResult:
    """Joint association of a scan. targets: with its frames. frames: with their associations. evidence: of each frame.
    changed: whether an association is another one than before. hits: (n,) detections of each target."""

    targets: Targets
    frames: tuple[ScanFrame, ...]
    evidence: tuple[FrameEvidence, ...]
    changed: bool
    hits: Ints

    @property
    def total(self) -> FrameEvidence:
        """What all frames say together."""
        return reduce(operator.add, self.evidence)


def associate_jointly(
    frames: tuple[ScanFrame, ...],
    targets: Targets,
    now_ns: int,
    prior: Targets,
    up: Floats | None,
    colour_std: float,
    sweeps: int = MAX_SWEEPS,
    evidence: tuple[FrameEvidence, ...] | None = None,
    manoeuvre: ManoeuvreHypothesis | None = None,
) -> ScanResult:
    """The joint association of frames with targets.

    targets: at ``now_ns``, with the frames' present associations. prior: the same targets without these frames.
    evidence: of the frames, where it is known from before. manoeuvre: second hypothesis of ``prior``.
    """
    row = {number: i for i, number in enumerate(targets.initiation_number.tolist())}
    columns = []
    for one in frames:
        column = np.full(len(targets), -1)
        for number, j in zip(one.ids.tolist(), one.column.tolist(), strict=True):
            if number in row:
                column[row[number]] = j
        columns.append(column)
    found = list(evidence or ())
    if evidence is None:
        found = [
            _evidence(one, targets, now_ns, up, colour_std, column) for one, column in zip(frames, columns, strict=True)
        ]
    attempts = _EXCHANGES if sweeps else 0
    while True:
        before = _information_of(prior, manoeuvre, found)
        found = _swept(frames, targets, now_ns, up, colour_std, before, found, sweeps)
        if attempts == 0:
            break
        attempts -= 1
        order = _most_probable_order(frames, prior, manoeuvre, found, colour_std)
        if np.array_equal(order, np.arange(len(targets))):
            break
        found = [each.of(order) for each in found]
    ids = targets.initiation_number
    hits = np.sum([each.column >= 0 for each in found], axis=0)
    after = _combined(targets, *before, found)
    return ScanResult(
        replace(after, hits=targets.hits + hits - np.sum([column >= 0 for column in columns], axis=0)),
        tuple(
            replace(one, ids=ids[each.column >= 0], column=each.column[each.column >= 0], ambiguous=False)
            for one, each in zip(frames, found, strict=True)
        ),
        tuple(found),
        any(not np.array_equal(each.column, column) for each, column in zip(found, columns, strict=True)),
        hits,
    )


def _information_of(
    prior: Targets, manoeuvre: ManoeuvreHypothesis | None, found: list[FrameEvidence]
) -> tuple[Floats, Floats, Floats]:
    """Information (n, 7, 7) of targets before the scan, its vector (n, 7), and log odds (n,) of existence."""
    covariance = prior.covariance
    if manoeuvre is not None:
        said = reduce(operator.add, found)
        covariance = widened_by_evidence(prior, manoeuvre, said.information, said.vector)
    information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    return information, (information @ prior.mean[:, :, None])[:, :, 0], log_odds(prior.existence)


def _swept(
    frames: tuple[ScanFrame, ...],
    targets: Targets,
    now_ns: int,
    up: Floats | None,
    colour_std: float,
    prior: tuple[Floats, Floats, Floats],
    found: list[FrameEvidence],
    sweeps: int,
) -> list[FrameEvidence]:
    """The frames' evidence after each was associated again given all others, until nothing changes."""
    found, due = list(found), set(range(len(frames)))
    for _ in range(sweeps):
        for index, one in enumerate(frames):
            if index not in due:
                continue
            due.discard(index)
            without = _combined(targets, *prior, [each for k, each in enumerate(found) if k != index])
            new = _evidence(one, without, now_ns, up, colour_std, None)
            if not np.array_equal(new.column, found[index].column):
                due |= set(range(len(frames))) - {index}
            found[index] = new
        if not due:
            break
    return found


def _most_probable_order(
    frames: tuple[ScanFrame, ...],
    prior: Targets,
    manoeuvre: ManoeuvreHypothesis | None,
    found: list[FrameEvidence],
    colour_std: float,
) -> Ints:
    """Whose evidence (n,) each target gets, so that all together is most probable."""
    n = len(prior)
    said = reduce(operator.add, found)
    detected = np.any([each.column >= 0 for each in found], axis=0)
    off = np.linalg.norm(prior.mean[:, None, POSITION] - prior.mean[None, :, POSITION], axis=2)
    reach = _REACH * np.exp(prior.mean[:, LOG_SIZE])
    near = (off < reach[:, None]) & (prior.kind[:, None] == prior.kind[None, :]) & detected
    a, b = np.nonzero(near & (near.sum(axis=0) > 1))  # whose detections nobody else can have made keep them
    score = np.full((n, n), _IMPOSSIBLE)
    score[:, ~detected] = 0.0
    score[np.arange(n), np.arange(n)] = 0.0
    if len(a) <= 1:
        return np.arange(n)
    measured = said.information[b], said.vector[b]
    score[a, b] = log_evidence(prior.mean[a], prior.covariance[a], *measured)
    if manoeuvre is not None:
        changed = log_evidence(prior.mean[a], manoeuvre.covariance[a], *measured)
        score[a, b] = log_mixture(manoeuvre.prior_odds[a], score[a, b], changed)
    for one, each in zip(frames, found, strict=True):
        if np.isfinite(one.frame.colour).any():
            observed = np.where((each.column >= 0)[:, None], one.frame.colour[each.column], np.nan)[b]
            score[a, b] += colour_score(observed, prior.colour[a], colour_std)
    _, order = linear_sum_assignment(-score - _TIE * np.eye(n))
    return np.asarray(order, dtype=np.int64)


def _combined(
    targets: Targets, information: Floats, vector: Floats, odds: Floats, evidence: list[FrameEvidence]
) -> Targets:
    total = information + sum(one.information for one in evidence)
    covariance = np.linalg.inv(total)
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    mean = (covariance @ (vector + sum(one.vector for one in evidence))[:, :, None])[:, :, 0]
    every = np.clip(odds + sum(one.odds for one in evidence), -MAX_LOG_ODDS, MAX_LOG_ODDS)
    return replace(targets, mean=mean, covariance=covariance, existence=1.0 / (1.0 + np.exp(-every)))


def _evidence(
    one: ScanFrame, targets: Targets, now_ns: int, up: Floats | None, colour_std: float, fixed: Ints | None
) -> FrameEvidence:
    """What a frame says, given the targets' states without it; fixed: (n,) its association, where that is known."""
    n = len(targets)
    elapsed = (one.frame.reference_ns - now_ns) / NANOSECONDS
    step = np.eye(STATE_DIM)
    step[kalman.POSITION, kalman.VELOCITY] = elapsed * np.eye(3)
    there = replace(targets, mean=targets.mean @ step.T, covariance=step @ targets.covariance @ step.T)
    predicted = predict_measurement(one.frame.camera, there.mean, there.kind, up)
    touching, occluded = occlusions(one.frame.camera, predicted, there)
    predicted = with_frame_noise(predicted, touching, there.kind, one.statistics)
    probability = detection_probability(one.statistics, visible_fraction(one.frame.camera, predicted), occluded)
    information, vector = np.zeros((n, STATE_DIM, STATE_DIM)), np.zeros((n, STATE_DIM))
    column, detected = np.full(n, -1), np.zeros(n)
    if len(one.frame):
        noise = noise_of(one.noise_entries)
        scores = association_scores(one.frame, one.value, noise, there, predicted, ("",) * n, colour_std, fixed)
        expected = there.existence * probability
        clutter_rate = false_detections(one.statistics, there.kind)
        log_ratio = scores.log_ratio + np.log(expected / ((1.0 - expected) * clutter_rate))[:, None]
        marginal, _ = marginal_probabilities(np.exp(np.minimum(log_ratio, 50.0)))
        detected = np.minimum(marginal.sum(axis=1), 1.0)
        if fixed is None:
            rows, columns = assign(log_ratio)
            column[rows] = columns
        else:
            column = fixed
        rows = np.flatnonzero(column >= 0)
        if len(rows):
            sure = marginal[rows, column[rows]]
            information[rows], vector[rows] = _linearised(
                one.value[column[rows]],
                noise[column[rows]],
                there,
                predicted,
                scores.distance,
                rows,
                column[rows],
                sure,
                step,
            )
    fraction = independent_fraction(one.statistics.interval_s)
    odds = log_odds(posterior_existence(there.existence, probability, detected, fraction)) - log_odds(there.existence)
    return FrameEvidence(information, vector, odds, fraction * np.log1p(-probability), column)


def _linearised(
    value: Floats,
    noise: Floats,
    there: Targets,
    predicted: PredictedMeasurement,
    distance: Floats,
    rows: Ints,
    columns: Ints,
    sure: Floats,
    step: Floats,
) -> tuple[Floats, Floats]:
    """Information of pairs and its vector, of the state at the scan's time. value, noise: the measurements."""
    selected = predicted.select(rows)
    used = gated_rows(value, selected, distance[rows, columns], there.covariance[rows])
    innovation = np.where(used, value - selected.value, 0.0)
    total = matched_noise(noise, selected, distance[rows, columns], sure)
    innovation, jacobian, total = kalman.mask_rows(innovation, selected.jacobian, total, used)
    jacobian = jacobian @ step
    weighted = np.linalg.solve(total, jacobian).transpose(0, 2, 1)
    # The state at the scan's time is the inverse step of that at the frame's.
    now = there.mean[rows] @ np.linalg.inv(step).T
    measured = innovation + (jacobian @ now[:, :, None])[:, :, 0]
    return weighted @ jacobian, (weighted @ measured[:, :, None])[:, :, 0]


def marginal_probabilities(ratio: Floats) -> tuple[Floats, Floats]:
    """Probabilities (n, m) that target i generated detection j, and (m,) that no target generated detection j.

    ratio: (n, m), the likelihood of the pair over that of a missed target and a false detection; 0 outside the gate.
    Each target generates at most one detection and each detection has at most one target. Williams and Lau,
    "Approximate evaluation of marginal association probabilities with belief propagation" (2014).
    """
    (n, m), (row, column) = ratio.shape, np.nonzero(ratio)
    pair = ratio[row, column]
    weighted = pair  # few pairs are inside the gate: sums over the pairs of each target, of each detection
    for _ in range(_ITERATIONS if min(n, m) > 1 else 1):
        to_detection = pair / (1.0 + (np.bincount(row, weighted, n)[row] - weighted))
        weighted = pair / (1.0 + (np.bincount(column, to_detection, m)[column] - to_detection))
    to_detection = pair / (1.0 + (np.bincount(row, weighted, n)[row] - weighted))
    probability = np.zeros((n, m))
    probability[row, column] = weighted / (1.0 + np.bincount(row, weighted, n)[row])
    return probability, np.asarray(1.0 / (1.0 + np.bincount(column, to_detection, m)))
