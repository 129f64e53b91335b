"""Tracker recursion for one frame: predict, associate, update, initiate, confirm, delete. Pure functions."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from hub.tracking.association.assignment import (
    assign,
    association_scores,
    combine_hypotheses,
    gated_rows,
    matched_noise,
    matching_colour_std,
    occlusions,
    update_colour_variance,
)
from hub.tracking.association.encounters import resolve_encounters
from hub.tracking.association.initiation import unassociated_detections
from hub.tracking.association.scan import AMBIGUOUS, associate_jointly, marginal_probabilities
from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter import kalman
from hub.tracking.filter.detection_model import (
    CORRELATION_S,
    detection_probability,
    false_detections,
    independent_fraction,
    posterior_existence,
    updated_statistics,
    visible_fraction,
    with_frame_noise,
)
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import VELOCITY
from hub.tracking.filter.measurement import NOISE_ENTRIES, PredictedMeasurement, measurements_of, predict_measurement
from hub.tracking.filter.prediction import (
    ManoeuvreHypothesis,
    can_manoeuvre,
    gpb1_update,
    manoeuvre_hypothesis,
    on_floor,
    predict_targets,
    units_of,
    within_reach,
)
from hub.tracking.filter.target_models import KIND_INDEX, TARGET_MODELS, UPRIGHT
from hub.tracking.filter.target_states import DetectionStatistics, MultiTargetState, Scan, ScanFrame, Targets
from hub.tracking.parameters import TrackerParameters, track_label
from hub.tracking.track_management import MAX_EXISTENCE, initiate_tracks, manage_tracks, with_floor_of, with_overlap
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats, Ints

PERSON_INDEX = KIND_INDEX["person"]
_CERTAIN = 0.95
"""Existence and association probability above which a pair teaches the camera's statistics."""
_BIRTH_SPREAD_M, _BIRTH_EXISTENCE = 5.0, 0.1
"""Std of a new target's position, and its probability, before anything is measured of it."""
_MANOEUVRING = 0.8
"""Probability of detecting a target that may manoeuvre inside its gate."""
_MIN_COLOUR_GAIN = 0.02  # a mean over 50 detections: colours change with place and light


def process_frame(
    state: MultiTargetState, frame: FrameDetections, cameras: dict[str, TrackingCamera], parameters: TrackerParameters
) -> MultiTargetState:
    """The state after one frame; frames must be processed in the order of their keys."""
    name, frame = frame.camera.name, frame.slanted(parameters.up)
    state = state.with_camera(name)
    if state.scan is None or any(one.frame.camera.name == name for one in state.scan.frames):
        state = concluded(state, parameters)
        state = replace(state, scan=Scan(state.targets, state.time_ns))
    elapsed = 0.0 if state.time_ns is None else (frame.reference_ns - state.time_ns) / NANOSECONDS
    state = with_floor_of(state, parameters)
    targets = predict_targets(state.targets, elapsed, parameters)
    state = replace(
        state,
        targets=on_floor(targets, state.floor, elapsed),
        statistics={other: one for other, one in state.statistics.items() if other in cameras},
        last_frame_ns={other: time for other, time in state.last_frame_ns.items() if other in cameras},
    )
    statistics = state.statistics.get(name, DetectionStatistics())
    if name in state.last_frame_ns:
        interval = (frame.reference_ns - state.last_frame_ns[name]) / NANOSECONDS
        statistics = replace(statistics, interval_s=interval if interval > 0.0 else statistics.interval_s)
    value, noise = measurements_of(frame, np.arange(len(frame)))
    noise[frame.kind == PERSON_INDEX] *= statistics.noise
    state, free = _associate_and_update(state, frame, value, noise, statistics, elapsed, parameters)
    unassociated = {other: detections for other, detections in state.unassociated.items() if other in cameras}
    unassociated[name] = unassociated_detections(frame, value, noise, free)
    state = replace(
        state,
        time_ns=frame.reference_ns,
        last_frame_ns={**state.last_frame_ns, name: frame.reference_ns},
        unassociated=unassociated,
    )
    return manage_tracks(initiate_tracks(state, frame, cameras, parameters), elapsed, parameters)


@lru_cache(maxsize=2)  # a state is published before the next frame
def jointly(state: MultiTargetState, parameters: TrackerParameters) -> MultiTargetState:
    """The state with the frames of its scan associated jointly."""
    scan, now, targets = state.scan, state.time_ns, state.targets
    if scan is None or now is None or not len(targets):
        return state
    if len(scan.frames) < 2 or not any(one.ambiguous for one in scan.frames):
        return state
    elapsed = 0.0 if scan.prior_ns is None else (now - scan.prior_ns) / NANOSECONDS
    known = on_floor(predict_targets(scan.prior, elapsed, parameters), state.floor, elapsed)
    prior = prior_of_births(targets, state.floor, parameters)
    _, old, new = np.intersect1d(known.initiation_number, targets.initiation_number, return_indices=True)
    mean, covariance, existence = prior.mean.copy(), prior.covariance.copy(), prior.existence.copy()
    mean[new], covariance[new], existence[new] = known.mean[old], known.covariance[old], known.existence[old]
    prior = replace(prior, mean=mean, covariance=covariance, existence=existence)
    colour_std = matching_colour_std(state.colour_variance)
    manoeuvre = manoeuvre_hypothesis(prior, elapsed, parameters.scale.units_per_m, parameters.up)
    found = associate_jointly(scan.frames, targets, now, prior, parameters.up, colour_std, manoeuvre=manoeuvre)
    state = replace(state, scan=replace(scan, frames=found.frames))
    targets = replace(found.targets, existence=np.minimum(found.targets.existence, MAX_EXISTENCE))
    return manage_tracks(replace(state, targets=targets), 0.0, parameters)


@lru_cache(maxsize=2)
def concluded(state: MultiTargetState, parameters: TrackerParameters) -> MultiTargetState:
    """The state after its scan: associated jointly, and with people exchanged who were taken for each other before."""
    state = jointly(state, parameters)
    if state.scan is None or state.time_ns is None or state.encounters.time_ns == state.time_ns:
        return state
    encounters, targets = resolve_encounters(
        state.encounters,
        state.scan,
        state.targets,
        state.time_ns,
        state.floor,
        matching_colour_std(state.colour_variance),
        parameters,
    )
    return replace(state, encounters=encounters, targets=targets)


def prior_of_births(targets: Targets, floor: Floor | None, parameters: TrackerParameters) -> Targets:
    """The targets as if nothing had been measured of them: near where they are, on the floor."""
    mean = targets.mean.copy()
    mean[:, VELOCITY] = 0.0
    unit = units_of(targets, parameters.scale.units_per_m)
    speed = np.array([model.speed_std_m_s for model in TARGET_MODELS])[targets.kind] * unit
    spread = np.concatenate(
        [
            np.repeat((_BIRTH_SPREAD_M * unit)[:, None], 3, axis=1),
            np.repeat(speed[:, None], 3, axis=1),
            np.array([model.log_size_std for model in TARGET_MODELS])[targets.kind][:, None],
        ],
        axis=1,
    )
    covariance = spread[:, :, None] ** 2 * np.eye(7)
    births = replace(targets, mean=mean, covariance=covariance, existence=np.full(len(targets), _BIRTH_EXISTENCE))
    return on_floor(births, floor, CORRELATION_S)


def _associate_and_update(
    state: MultiTargetState,
    frame: FrameDetections,
    value: Floats,
    noise: Floats,
    statistics: DetectionStatistics,
    elapsed: float,
    parameters: TrackerParameters,
) -> tuple[MultiTargetState, Ints]:
    """Targets updated with the frame's detections, and the indices of the unassociated detections."""
    targets, variance, name = state.targets, state.colour_variance, frame.camera.name
    none = np.zeros(0, dtype=np.int64)
    if not len(targets):
        seen = ScanFrame(frame, value, noise[:, *NOISE_ENTRIES], statistics, none, none, True)
        statistics = updated_statistics(
            statistics, *(none.astype(np.bool_),) * 3, float(len(frame)), np.zeros(0), none.astype(np.bool_)
        )
        assert state.scan is not None
        scan = replace(state.scan, frames=(*state.scan.frames, seen))
        return replace(state, statistics={**state.statistics, name: statistics}, scan=scan), np.arange(len(frame))
    predicted = predict_measurement(frame.camera, targets.mean, targets.kind, parameters.up)
    touching, occluded = occlusions(frame.camera, predicted, targets)
    predicted = with_frame_noise(predicted, touching, targets.kind, statistics)
    visible = visible_fraction(frame.camera, predicted)
    probability = detection_probability(statistics, visible, occluded)
    # A target that changes its velocity abruptly leaves its gate for a few frames: that is no evidence against it.
    leaves = can_manoeuvre(targets) & ~UPRIGHT[targets.kind]
    probability = np.where(leaves, np.minimum(probability, _MANOEUVRING), probability)
    row, column, nis, beside, ambiguous = none, none, np.zeros(0), none.astype(np.bool_), False
    detected, clutter = np.zeros(len(targets)), np.ones(len(frame))
    if len(frame):
        names = tuple(
            track_label(int(k), int(n)) if n else "" for k, n in zip(targets.kind, targets.number, strict=True)
        )
        colour_std = matching_colour_std(variance)
        scores = association_scores(frame, value, noise, targets, predicted, names, colour_std)
        manoeuvre = None
        if can_manoeuvre(targets).any():
            unseen = np.maximum((frame.reference_ns - targets.seen_ns) / NANOSECONDS, 0.0)
            manoeuvre = manoeuvre_hypothesis(targets, unseen, parameters.scale.units_per_m, parameters.up)
            manoeuvre = within_reach(targets, unseen, manoeuvre)
            manoeuvring = replace(targets, covariance=manoeuvre.covariance)
            other = association_scores(frame, value, noise, manoeuvring, predicted, names, colour_std)
            scores = combine_hypotheses(scores, other, manoeuvre.prior_odds)
        expected = targets.existence * probability
        clutter_rate = false_detections(statistics, targets.kind)
        log_ratio = scores.log_ratio + np.log(expected / ((1.0 - expected) * clutter_rate))[:, None]
        marginal, clutter = marginal_probabilities(np.exp(np.minimum(log_ratio, 50.0)))
        row, column = assign(log_ratio)
        order = np.argsort(row, kind="stable")
        row, column = row[order], column[order]
        detected = marginal.sum(axis=1)
        sure = marginal[row, column]
        ambiguous = bool(((marginal > 1.0 - AMBIGUOUS) & (marginal < AMBIGUOUS)).any())
        confirmed = targets.confirmed[row]
        observed, stored = frame.colour[column[confirmed]], targets.colour[row[confirmed]]
        variance = update_colour_variance(variance, observed, stored, 1.0 - sure[confirmed])
        camera = state.cameras.index(name)
        targets, nis = _update_associated(
            targets, manoeuvre, frame, value, noise, predicted, scores.distance, row, column, sure, camera
        )
        clear = confirmed & (sure > _CERTAIN) & (targets.kind[row] == PERSON_INDEX)
        nis, beside = nis[clear], touching[row[clear]]
    hit = np.zeros(len(targets), dtype=np.bool_)
    hit[row] = True
    certain = targets.confirmed & (targets.existence > _CERTAIN) & (visible >= 1.0)
    statistics = updated_statistics(statistics, certain, occluded, hit, float(clutter.sum()), nis, beside)
    fraction = independent_fraction(statistics.interval_s)
    existence = posterior_existence(targets.existence, probability, np.minimum(detected, 1.0), fraction)
    targets = with_overlap(targets, hit, probability, fraction, elapsed, parameters)
    free = np.ones(len(frame), dtype=np.bool_)
    free[column] = False
    state = replace(
        state,
        targets=replace(targets, existence=np.minimum(existence, MAX_EXISTENCE)),
        colour_variance=variance,
        statistics={**state.statistics, name: statistics},
    )
    assert state.scan is not None
    ids = targets.initiation_number[row]
    seen = ScanFrame(frame, value, noise[:, *NOISE_ENTRIES], statistics, ids, column, ambiguous)
    state = replace(state, scan=replace(state.scan, frames=(*state.scan.frames, seen)))
    return state, np.flatnonzero(free & (clutter > 0.5))


def _update_associated(
    targets: Targets,
    manoeuvre: ManoeuvreHypothesis | None,
    frame: FrameDetections,
    value: Floats,
    noise: Floats,
    predicted: PredictedMeasurement,
    distance: Floats,
    row: Ints,
    column: Ints,
    sure: Floats,
    camera: int,
) -> tuple[Targets, Floats]:
    """Targets updated with their detections, and the normalised innovations squared per degree of freedom."""
    if not len(row):
        return targets, np.zeros(0)
    selected = predicted.select(row)
    used = gated_rows(value[column], selected, distance[row, column], targets.covariance[row])
    innovation = np.where(used, value[column] - selected.value, 0.0)
    total = matched_noise(noise[column], selected, distance[row, column], sure)
    mean, covariance = targets.mean[row], targets.covariance[row]
    measurement = innovation, selected.jacobian, total, used
    if manoeuvre is None:
        mean, covariance, nis, _ = kalman.update(mean, covariance, *measurement)
    else:
        mean, covariance, nis = gpb1_update(
            mean, covariance, manoeuvre.covariance[row], manoeuvre.prior_odds[row], *measurement
        )
    means, covariances = targets.mean.copy(), targets.covariance.copy()
    means[row], covariances[row] = mean, covariance
    colour, count = targets.colour.copy(), targets.colour_count.copy()
    observed = np.isfinite(frame.colour[column]).all(axis=1)
    updated, new_colour = row[observed], frame.colour[column[observed]]
    weight = np.maximum(1.0 / (count[updated] + 1.0), _MIN_COLOUR_GAIN)[:, None]
    previous = np.where(count[updated, None] > 0, colour[updated], new_colour)
    colour[updated] = previous + weight * (new_colour - previous)
    count[updated] += 1.0
    seen_ns, hits, seen_by = targets.seen_ns.copy(), targets.hits.copy(), targets.seen_by.copy()
    seen_ns[row] = frame.reference_ns
    hits[row] += 1
    seen_by[row, camera] = frame.reference_ns
    targets = replace(
        targets,
        mean=means,
        covariance=covariances,
        colour=colour,
        colour_count=count,
        seen_ns=seen_ns,
        hits=hits,
        seen_by=seen_by,
    )
    return targets, nis / np.maximum(used.sum(axis=1), 1)
