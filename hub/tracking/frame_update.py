"""Tracker recursion for one frame: predict, associate, update, initiate, confirm, delete. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hub.tracking.association.assignment import (
    assign,
    association_costs,
    clutter_cost,
    combine_hypotheses,
    gated_rows,
    matching_colour_std,
    misassociation_probability,
    occlusions,
    update_colour_variance,
)
from hub.tracking.association.initiation import LengthScale, TrackCandidate, best_candidate, unassociated_detections
from hub.tracking.association.reidentification import reidentify, store_lost_tracks
from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter import kalman
from hub.tracking.filter.kalman import LOG_SIZE, POSITION
from hub.tracking.filter.manoeuvre import ManoeuvreHypothesis, can_manoeuvre, gpb1_update, manoeuvre_hypothesis
from hub.tracking.filter.measurement import (
    FOOT,
    HEAD,
    POINT,
    PredictedMeasurement,
    measurements_of,
    predict_measurement,
    student_t_inflation,
)
from hub.tracking.filter.target_models import TARGET_MODELS
from hub.tracking.filter.target_states import MultiTargetState, Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats, Ints

_INITIATION_WINDOW_NS = 250_000_000
"""Detections older than the frame by more than this are not used for track initiation with it."""
_OVERLAP_NOISE = 0.08
"""Std added to the points of touching silhouettes, as a fraction of the size."""
_MIN_WEIGHT = 0.1
"""Fraction of the weight that a detection keeps when it fits another target equally well."""
_MAX_ANCHORS = 4
_MAX_TENTATIVE = 64
_MAX_RATE_GAIN, _MIN_RATE_GAIN = 0.35, 0.04
"""Gains of the running detection rate: at first and later."""
_CONFIRM_HITS, _CONFIRM_S, _CONFIRM_DETECTION_RATE = 8, 0.3, 0.5
_TENTATIVE_DETECTION_RATE, _TENTATIVE_OPPORTUNITIES, _TENTATIVE_S = 0.35, 8, 0.5
_CONFIRMED_DETECTION_RATE, _UNSEEN_S = 0.15, 0.5
_MIN_COLOUR_GAIN = 0.02
_SAME_TARGET_RADIUS = 0.3
"""As a fraction of the size: a candidate nearer than this to a target is that target; two targets within half of it
are duplicates."""
_BODY_WIDTH, _MAX_OVERLAP_S = 0.18, 1.0
"""Smallest distance of two bodies as a fraction of the height, and how long two targets may be nearer [s]."""
_FLOOR_GATE, _MIN_FLOOR_WEIGHT, _MAX_FLOOR_WEIGHT = 0.25, 200.0, 5000.0
_LOG_SIZE_PSD = 1e-4
_RECENT_NS = 500_000_000
_ACCELERATION_PSD = np.array([model.acceleration_psd for model in TARGET_MODELS])
_UPRIGHT = np.array([model.upright for model in TARGET_MODELS])
_TYPICAL_SIZE_M = np.array([model.size_m for model in TARGET_MODELS])


@dataclass(frozen=True, slots=True, eq=False)
class TrackerParameters:
    """Scene knowledge and track-management limits.

    up: (3,) unit vector in world coordinates, None = unknown. scale: of the world. coast_s: how long a target is kept
    without detections. remember_s: how long a lost track may be re-identified; at most ``max_lost_tracks`` are kept.
    """

    up: Floats | None = None
    scale: LengthScale = field(default_factory=LengthScale)
    coast_s: float = 2.5
    remember_s: float = 120.0
    max_lost_tracks: int = 200


def process_frame(
    state: MultiTargetState, frame: FrameDetections, cameras: dict[str, TrackingCamera], parameters: TrackerParameters
) -> MultiTargetState:
    """The state after one frame; frames must be processed in the order of their keys."""
    state = state.with_camera(frame.camera.name)
    elapsed = 0.0 if state.time_ns is None else (frame.reference_ns - state.time_ns) / NANOSECONDS
    state = replace(state, targets=predict_targets(state.targets, elapsed, parameters))
    value, noise = measurements_of(frame, np.arange(len(frame)))
    state, free = _associate_and_update(state, frame, value, noise, parameters)
    unassociated = {name: detections for name, detections in state.unassociated.items() if name in cameras}
    last_frame_ns = {name: time for name, time in state.last_frame_ns.items() if name in cameras}
    unassociated[frame.camera.name] = unassociated_detections(frame, value, noise, free)
    last_frame_ns[frame.camera.name] = frame.reference_ns
    state = replace(state, time_ns=frame.reference_ns, last_frame_ns=last_frame_ns, unassociated=unassociated)
    state = _initiate_tracks(state, frame, cameras, parameters)
    state = replace(_with_floor(state, parameters), targets=_with_overlap_time(state.targets, elapsed, parameters))
    return _manage_tracks(state, parameters)


def predict_targets(targets: Targets, elapsed: float, parameters: TrackerParameters) -> Targets:
    """The targets predicted by ``elapsed`` seconds."""
    if not len(targets) or elapsed == 0.0:
        return targets
    size = np.exp(targets.mean[:, LOG_SIZE])
    units_per_m = np.where(_UPRIGHT[targets.kind], size / _TYPICAL_SIZE_M[targets.kind], parameters.scale.units_per_m)
    acceleration_psd = _ACCELERATION_PSD[targets.kind] * units_per_m**2
    mean, covariance = kalman.predict(targets.mean, targets.covariance, elapsed, acceleration_psd, _LOG_SIZE_PSD)
    return replace(targets, mean=mean, covariance=covariance)


def _associate_and_update(
    state: MultiTargetState, frame: FrameDetections, value: Floats, noise: Floats, parameters: TrackerParameters
) -> tuple[MultiTargetState, Ints]:
    """Targets updated with the frame's detections, and the indices of the unassociated detections."""
    targets, variance, free = state.targets, state.colour_variance, np.arange(len(frame))
    if not len(targets):
        return state, free
    predicted = predict_measurement(frame.camera, targets.mean, targets.kind, parameters.up)
    touching, occluded = occlusions(frame.camera, predicted, targets)
    if touching.any():
        predicted = predicted.with_occlusion_noise(np.where(occluded, 2.0, 1.0) * touching * _OVERLAP_NOISE)
    in_view = frame.camera.sees(predicted.value[:, POINT], predicted.depth)
    row, column = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    if len(frame):
        names = tuple(
            track_label(int(k), int(n)) if n else "" for k, n in zip(targets.kind, targets.number, strict=True)
        )
        costs = association_costs(frame, value, noise, targets, predicted, names, matching_colour_std(variance))
        manoeuvre = None
        if can_manoeuvre(targets).any():
            manoeuvre = manoeuvre_hypothesis(targets, frame.reference_ns, parameters.scale.units_per_m)
            manoeuvring = replace(targets, covariance=manoeuvre.covariance)
            costs = combine_hypotheses(
                costs,
                association_costs(frame, value, noise, manoeuvring, predicted, names, matching_colour_std(variance)),
                manoeuvre.prior_odds,
            )
        # Confirmed targets are assigned first: a false candidate must not take a detection from them.
        for group in (targets.confirmed, ~targets.confirmed):
            total = np.where(group[:, None], costs.total, np.inf)
            total[:, column] = np.inf
            selected, selected_columns = assign(total)
            row, column = np.concatenate([row, selected]), np.concatenate([column, selected_columns])
        known = np.where(targets.confirmed[:, None], costs.total, np.inf)
        known[row, column] = costs.total[row, column]
        mismatch_probability = misassociation_probability(known, row, column, clutter_cost(targets.kind[row]))
        left = np.ones(len(frame), dtype=np.bool_)
        left[column] = False
        free = np.flatnonzero(left)
        confirmed = targets.confirmed[row]
        observed, stored = frame.colour[column[confirmed]], targets.colour[row[confirmed]]
        variance = update_colour_variance(variance, observed, stored, mismatch_probability[confirmed])
        camera = state.cameras.index(frame.camera.name)
        targets = _update_associated(
            targets,
            manoeuvre,
            frame,
            value,
            noise,
            predicted,
            costs.distance,
            row,
            column,
            mismatch_probability,
            camera,
        )
    hit = np.zeros(len(targets), dtype=np.bool_)
    hit[row] = True
    return replace(
        state, targets=_with_detection_rate(targets, hit, in_view & ~occluded), colour_variance=variance
    ), free


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
    mismatch_probability: Floats,
    camera: int,
) -> Targets:
    if not len(row):
        return targets
    order = np.argsort(row, kind="stable")
    row, column, mismatch_probability = row[order], column[order], mismatch_probability[order]
    selected = predicted.select(row)
    used = gated_rows(value[column], selected, distance[row, column], targets.covariance[row])
    innovation = np.where(used, value[column] - selected.value, 0.0)
    total = np.where(np.isfinite(noise[column]), noise[column], 0.0) + selected.model_noise
    for part, rows in ((1, HEAD), (2, FOOT)):
        total[:, rows, rows] *= student_t_inflation(distance[row, column, part])[:, None, None]
    # An ambiguous detection has little weight: where two targets cross, the cameras that resolve them dominate.
    total /= np.maximum(1.0 - 2.0 * mismatch_probability, _MIN_WEIGHT)[:, None, None] ** 2
    mean, covariance = targets.mean[row], targets.covariance[row]
    if manoeuvre is None:
        mean, covariance = kalman.update(mean, covariance, innovation, selected.jacobian, total, used)
    else:
        manoeuvre_covariance, prior_odds = manoeuvre.covariance[row], manoeuvre.prior_odds[row]
        mean, covariance = gpb1_update(
            mean, covariance, manoeuvre_covariance, prior_odds, innovation, selected.jacobian, total, used
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
    return replace(
        targets,
        mean=means,
        covariance=covariances,
        colour=colour,
        colour_count=count,
        seen_ns=seen_ns,
        hits=hits,
        seen_by=seen_by,
    )


def _with_detection_rate(targets: Targets, hit: Bools, expected_in_view: Bools) -> Targets:
    """Update the detection rate where a target was detected, or should have been."""
    expected = hit | expected_in_view
    weight = np.clip(1.0 / (targets.opportunities + 2.0), _MIN_RATE_GAIN, _MAX_RATE_GAIN)
    detection_rate = np.where(
        expected, targets.detection_rate + weight * (hit - targets.detection_rate), targets.detection_rate
    )
    return replace(targets, detection_rate=detection_rate, opportunities=targets.opportunities + expected)


def _initiate_tracks(
    state: MultiTargetState, frame: FrameDetections, cameras: dict[str, TrackingCamera], parameters: TrackerParameters
) -> MultiTargetState:
    """Initiate tracks from unassociated detections of this frame together with those of other cameras."""
    name = frame.camera.name
    live = [other for other, time in state.last_frame_ns.items() if frame.reference_ns - time <= _INITIATION_WINDOW_NS]
    unassociated = {other: state.unassociated.get(other, ()) for other in live}
    recent_cameras = {other: cameras[other] for other in live if other in cameras}
    if not unassociated.get(name) or not any(unassociated[other] for other in live if other != name):
        return state
    # The number of anchors is limited, so that a frame full of clutter costs no more than a few fits.
    every = [
        best_candidate(anchor, unassociated, recent_cameras, parameters.up, parameters.scale)
        for anchor in unassociated[name][:_MAX_ANCHORS]
    ]
    candidates = [candidate for candidate in every if candidate is not None]
    candidates.sort(
        key=lambda candidate: (
            -len(candidate.detections) / candidate.opportunities,
            -len(candidate.detections),
            candidate.chi2_per_dof,
        )
    )
    used: set[int] = set()
    for candidate in candidates:
        if any(id(detection) in used for detection in candidate.detections) or not _is_new(
            state, candidate, parameters
        ):
            continue
        if int((~state.targets.confirmed).sum()) >= _MAX_TENTATIVE:
            break
        used |= set(map(id, candidate.detections))
        state = _with_candidate(state, candidate)
    unassociated = {
        other: tuple(f for f in detections if id(f) not in used) for other, detections in unassociated.items()
    }
    return replace(state, unassociated={**state.unassociated, **unassociated})


def _is_new(state: MultiTargetState, candidate: TrackCandidate, parameters: TrackerParameters) -> bool:
    """Whether a candidate is no known target, and stands on the floor on which others stand."""
    size = float(np.exp(candidate.mean[LOG_SIZE]))
    up = parameters.up if _UPRIGHT[candidate.detections[0].kind] else None
    if len(state.targets):
        distance = np.linalg.norm(state.targets.mean[:, POSITION] - candidate.mean[POSITION], axis=1)
        spread = np.sqrt(np.trace(candidate.covariance[POSITION, POSITION]))
        radius = _SAME_TARGET_RADIUS * size if up is not None else 3.0 * spread
        if (distance[state.targets.kind == candidate.detections[0].kind] < radius).any():
            return False
    if up is not None and state.floor_weight >= _MIN_FLOOR_WEIGHT:
        foot = float(candidate.mean[POSITION] @ up) - 0.5 * size
        return abs(foot - state.floor_height) < _FLOOR_GATE * size
    return True


def _with_candidate(state: MultiTargetState, candidate: TrackCandidate) -> MultiTargetState:
    seen_by = np.full((1, len(state.cameras)), -(2**62), dtype=np.int64)
    for detection in candidate.detections:
        seen_by[0, state.cameras.index(detection.camera.name)] = detection.reference_ns
    colours = np.array([f.colour for f in candidate.detections if np.isfinite(f.colour).all()]).reshape(-1, 3)
    now = candidate.detections[0].reference_ns
    count = len(candidate.detections)
    new = Targets(
        initiation_number=np.array([state.next_initiation_number]),
        number=np.array([0]),
        kind=np.array([candidate.detections[0].kind]),
        mean=candidate.mean[None],
        covariance=candidate.covariance[None],
        colour=(colours.mean(axis=0) if len(colours) else np.full(3, np.nan))[None],
        colour_count=np.array([float(len(colours))]),
        born_ns=np.array([now]),
        seen_ns=np.array([now]),
        hits=np.array([count]),
        opportunities=np.array([candidate.opportunities]),
        detection_rate=np.array([count / candidate.opportunities]),
        seen_by=seen_by,
        overlap_s=np.zeros(1),
    )
    return replace(
        state, targets=state.targets.concatenate(new), next_initiation_number=state.next_initiation_number + 1
    )


def _with_floor(state: MultiTargetState, parameters: TrackerParameters) -> MultiTargetState:
    """Update the floor height from the feet of confirmed upright targets."""
    targets = state.targets
    standing = targets.confirmed & _UPRIGHT[targets.kind] & (targets.seen_ns == state.time_ns)
    if parameters.up is None or not standing.any():
        return state
    feet = targets.mean[standing, POSITION] @ parameters.up - 0.5 * np.exp(targets.mean[standing, LOG_SIZE])
    weight = state.floor_weight + len(feet)
    floor_height = state.floor_height + float((feet - state.floor_height).sum()) / weight
    return replace(state, floor_height=floor_height, floor_weight=min(weight, _MAX_FLOOR_WEIGHT))


def _manage_tracks(state: MultiTargetState, parameters: TrackerParameters) -> MultiTargetState:
    """Confirm tentative tracks and delete weak, unobserved, off-floor, duplicate or invalid ones."""
    targets = state.targets
    if not len(targets):
        return state
    now = state.time_ns
    assert now is not None
    unseen = (now - targets.seen_ns) / NANOSECONDS
    age = (now - targets.born_ns) / NANOSECONDS
    cameras = (targets.seen_by > now - _RECENT_NS).sum(axis=1)
    ready = (targets.hits >= _CONFIRM_HITS) & (age >= _CONFIRM_S) & (targets.detection_rate >= _CONFIRM_DETECTION_RATE)
    state = reidentify(state, ~targets.confirmed & ready & (cameras >= 2), parameters.scale)
    targets = state.targets
    unseen = (now - targets.seen_ns) / NANOSECONDS
    known = targets.confirmed
    size = np.exp(targets.mean[:, LOG_SIZE])
    spread = np.sqrt(np.trace(targets.covariance[:, POSITION, POSITION], axis1=1, axis2=2))
    max_spread = np.where(_UPRIGHT[targets.kind], 2.0 * size, 2.5 * parameters.scale.units_per_m)
    weak = (targets.detection_rate < _TENTATIVE_DETECTION_RATE) & (targets.opportunities >= _TENTATIVE_OPPORTUNITIES)
    drop = ~known & (weak | (unseen > _TENTATIVE_S))
    drop |= known & (unseen > parameters.coast_s)
    drop |= (
        known & (unseen > _UNSEEN_S) & ((targets.detection_rate < _CONFIRMED_DETECTION_RATE) | (spread > max_spread))
    )
    drop |= _off_floor(state, parameters)
    drop |= _duplicates(targets, size) | (targets.overlap_s > _MAX_OVERLAP_S)
    drop |= ~np.isfinite(targets.mean).all(axis=1)
    if not drop.any():
        return state
    state = store_lost_tracks(
        state, known & drop & np.isfinite(targets.mean).all(axis=1), parameters.remember_s, parameters.max_lost_tracks
    )
    return replace(state, targets=state.targets.select(~drop))


def _off_floor(state: MultiTargetState, parameters: TrackerParameters) -> Bools:
    """Upright targets off the floor that fewer than three cameras see: false matches of two different people."""
    targets, now = state.targets, state.time_ns
    if parameters.up is None or now is None or state.floor_weight < _MIN_FLOOR_WEIGHT:
        return np.zeros(len(targets), dtype=np.bool_)
    size = np.exp(targets.mean[:, LOG_SIZE])
    foot = targets.mean[:, POSITION] @ parameters.up - 0.5 * size
    few = (targets.seen_by > now - _RECENT_NS).sum(axis=1) < 3
    return np.asarray(_UPRIGHT[targets.kind] & few & ~(np.abs(foot - state.floor_height) < _FLOOR_GATE * size))


def _with_overlap_time(targets: Targets, elapsed: float, parameters: TrackerParameters) -> Targets:
    """Update ``overlap_s`` by ``elapsed`` [s]: two people cannot share a position for long."""
    if len(targets) < 2 or parameters.up is None:
        return targets
    size = np.exp(targets.mean[:, LOG_SIZE])
    offset = targets.mean[:, None, POSITION] - targets.mean[None, :, POSITION]
    offset = offset - (offset @ parameters.up)[..., None] * parameters.up
    near = np.linalg.norm(offset, axis=2) < _BODY_WIDTH * size[:, None]
    upright = _UPRIGHT[targets.kind] & targets.confirmed
    near &= upright[:, None] & upright[None, :] & (targets.number[None, :] < targets.number[:, None])
    change = np.where(near.any(axis=1), elapsed, -elapsed)
    return replace(targets, overlap_s=np.maximum(targets.overlap_s + change, 0.0))


def _duplicates(targets: Targets, size: Floats) -> Bools:
    """Which targets are duplicates: at the position of an older target, and less often detected."""
    n = len(targets)
    out = np.zeros(n, dtype=np.bool_)
    if n < 2:
        return out
    offset = np.linalg.norm(targets.mean[:, None, POSITION] - targets.mean[None, :, POSITION], axis=2)
    near = (offset < 0.5 * _SAME_TARGET_RADIUS * size[:, None]) & (targets.kind[:, None] == targets.kind[None, :])
    near &= _UPRIGHT[targets.kind][:, None]  # the size of other kinds may be unknown
    older = (targets.number[None, :] > 0) & (
        (targets.number[:, None] == 0) | (targets.number[None, :] < targets.number[:, None])
    )
    weaker = (targets.detection_rate[:, None] < 0.5) | (targets.number[:, None] == 0)
    return np.asarray((near & older & weaker).any(axis=1))


def track_label(kind: int, number: int) -> str:
    """The label under which a confirmed track is published."""
    return f"{TARGET_MODELS[kind].kind}-{number}"


__all__ = ["TrackerParameters", "predict_targets", "process_frame", "track_label"]
