"""Initiation, confirmation and deletion of tracks by their probability of existence. Pure functions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.association.initiation import TrackCandidate, UnassociatedDetection, best_candidate, candidate_on
from hub.tracking.association.reidentification import reidentify, store_lost_tracks
from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import LOG_SIZE, POSITION
from hub.tracking.filter.target_models import UPRIGHT
from hub.tracking.filter.target_states import MultiTargetState, Targets
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats

_INITIATION_WINDOW_NS = 250_000_000
"""Detections older than the frame by more than this are not used for track initiation with it."""
_MAX_ANCHORS = 4  # each costs a fit: bounds a frame full of clutter
_ARRIVALS = 0.1
"""People expected to appear in a frame."""
_MAX_TENTATIVE = 64  # bounds the cost of a frame of clutter
MAX_EXISTENCE = 0.99
"""Certainty is limited, so that a target that has left is given up: after two looks that miss it at 0.85."""
_CONFIRMED, _DELETED = 0.9, 0.02
"""Existence probabilities."""
_MIN_HITS = 2  # two: one may be clutter
_ALONE_S = 1.0
"""Age from which on a person on the floor whom one camera alone sees is confirmed: a part of the background that was
taken for somebody is learned by then."""
_UNSEEN_S = 0.5  # without a detection: five frames at 10 fps, and at least one and a half of slower cameras
_SAME_TARGET_RADIUS = 0.3
"""As a fraction of the size: a candidate nearer than this to a target is that target; two targets within half of it
are duplicates."""
_NEIGHBOUR, _BODY_WIDTH = 0.4, 0.18
"""As fractions of the height: two tracks nearer than the first may be one person, and nearer than the second are."""
_PART_RADIUS, _PART_HEIGHT = 0.25, 0.8
"""As fractions of a person's height: nearer and smaller is a box of a part of this person. Hand in hand is 0.3."""
_TWICE = 0.02
"""Probability that one person is detected twice in a frame."""
_MAX_OVERLAP, _MIN_OVERLAP = 3.0, -6.0
"""Log likelihood ratio from which on two tracks are one person (20 to 1), and its limit below."""
_FLOOR_GATE = 0.25
"""Of a foot's height above the floor, as a fraction of the size."""


def with_floor_of(state: MultiTargetState, parameters: TrackerParameters) -> MultiTargetState:
    """The state with a floor of the given vertical and scale; a new one where these have changed."""
    up, floor = parameters.up, state.floor
    if up is None:
        return state if floor is None else replace(state, floor=None)
    if floor is None or floor.units_per_m != parameters.scale.units_per_m or not np.array_equal(floor.up, up):
        return replace(state, floor=Floor.unknown(up, parameters.scale.units_per_m))
    return state


def initiate_tracks(
    state: MultiTargetState, frame: FrameDetections, cameras: dict[str, TrackingCamera], parameters: TrackerParameters
) -> MultiTargetState:
    """New tracks from unassociated detections: of this frame alone where the floor is known, else of two cameras."""
    name = frame.camera.name
    own = state.unassociated.get(name, ())
    upright = [one for one in own if UPRIGHT[one.kind]]
    state = _with_views(state, upright, name, cameras, parameters)
    if state.floor is not None and state.floor.known and upright:
        clutter = state.statistics[name].clutter
        # More than false detections would explain (3 sigma, Poisson) are people: a hall may be full at the first frame.
        arrivals = max(_ARRIVALS, len(upright) - clutter - 3.0 * np.sqrt(clutter))
        born = [candidate_on(state.floor, one, parameters.scale, arrivals / clutter) for one in upright]
        likely = [one for one in born if one is not None and one.existence >= _DELETED]
        state = _with_candidates(state, likely, parameters)
        # A child is too far from a person's typical height for one camera alone.
        explained = {id(one.detections[0]) for one in likely}
        own = tuple(one for one in own if id(one) not in explained)
        state = replace(state, unassociated={**state.unassociated, name: own})
    live = [other for other, time in state.last_frame_ns.items() if frame.reference_ns - time <= _INITIATION_WINDOW_NS]
    unassociated = {other: state.unassociated.get(other, ()) for other in live}
    recent_cameras = {other: cameras[other] for other in live if other in cameras}
    if not own or not any(unassociated[other] for other in live if other != name):
        return state
    every = [
        best_candidate(anchor, unassociated, recent_cameras, parameters.up, parameters.scale)
        for anchor in own[:_MAX_ANCHORS]
    ]
    candidates = [candidate for candidate in every if candidate is not None]
    candidates.sort(key=lambda one: (-one.existence, -len(one.detections), one.chi2_per_dof))
    return _with_candidates(state, candidates, parameters)


def _with_views(
    state: MultiTargetState,
    upright: list[UnassociatedDetection],
    name: str,
    cameras: dict[str, TrackingCamera],
    parameters: TrackerParameters,
) -> MultiTargetState:
    """Until the floor is known: its height from people whose distance follows from their typical height."""
    floor = state.floor
    if floor is None or floor.known or not parameters.scale.metric or not upright:
        return state
    camera = cameras[name].pose.position @ floor.up
    views = np.array([(state.cameras.index(name), camera, one.heights_below(floor.up)) for one in upright])
    views = views[np.isfinite(views).all(axis=1)]
    return replace(state, floor=floor.with_views(views, min(len(cameras), 2))) if len(views) else state


def _with_candidates(
    state: MultiTargetState, candidates: list[TrackCandidate], parameters: TrackerParameters
) -> MultiTargetState:
    """The state with those candidates that share no detection and are not known yet."""
    used: set[int] = set()
    for candidate in candidates:
        if any(id(detection) in used for detection in candidate.detections):
            continue
        if not _is_new(state, candidate, parameters):
            continue
        if int((~state.targets.confirmed).sum()) >= _MAX_TENTATIVE:
            break
        used |= set(map(id, candidate.detections))
        state = _with_candidate(state, candidate)
    unassociated = {
        other: tuple(f for f in detections if id(f) not in used) for other, detections in state.unassociated.items()
    }
    return replace(state, unassociated=unassociated)


def _is_new(state: MultiTargetState, candidate: TrackCandidate, parameters: TrackerParameters) -> bool:
    """Whether a candidate is no known target, and stands on the floor on which others stand."""
    size = float(np.exp(candidate.mean[LOG_SIZE]))
    up = parameters.up if UPRIGHT[candidate.detections[0].kind] else None
    if len(state.targets):
        distance = np.linalg.norm(state.targets.mean[:, POSITION] - candidate.mean[POSITION], axis=1)
        spread = np.sqrt(np.trace(candidate.covariance[POSITION, POSITION]))
        radius = 0.5 * _SAME_TARGET_RADIUS * size if up is not None else 3.0 * spread
        if up is not None:
            # A second box of somebody, of the legs or without them, is no child at the same place.
            tall = np.exp(state.targets.mean[:, LOG_SIZE])
            offset = state.targets.mean[:, POSITION] - candidate.mean[POSITION]
            beside = np.linalg.norm(offset - (offset @ up)[:, None] * up, axis=1)
            part = (beside < _PART_RADIUS * tall) & (size < _PART_HEIGHT * tall)
            distance = np.where(part, 0.0, distance)
        if (distance[state.targets.kind == candidate.detections[0].kind] < radius).any():
            return False
    if up is not None and state.floor is not None and state.floor.known:
        return not _off(state.floor, candidate.mean[None])[0]
    return True


def _off(floor: Floor, mean: Floats) -> Bools:
    """Which states (n, 7) have their foot off the floor."""
    innovation, _, _ = floor.constraint(mean)
    return ~(np.abs(innovation) < _FLOOR_GATE * np.exp(mean[:, LOG_SIZE]))


def _with_candidate(state: MultiTargetState, candidate: TrackCandidate) -> MultiTargetState:
    seen_by = np.full((1, len(state.cameras)), -(2**62), dtype=np.int64)
    for detection in candidate.detections:
        seen_by[0, state.cameras.index(detection.camera.name)] = detection.reference_ns
    colours = np.array([f.colour for f in candidate.detections if np.isfinite(f.colour).all()]).reshape(-1, 3)
    now = candidate.detections[0].reference_ns
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
        hits=np.array([len(candidate.detections)]),
        existence=np.array([min(candidate.existence, MAX_EXISTENCE)]),
        seen_by=seen_by,
        overlap=np.zeros(1),
    )
    # The scan's frames get the new target's detections, so that these can change hands as well.
    scan = state.scan
    if scan is not None:
        index = {one.camera.name: one.index for one in candidate.detections}
        frames = tuple(
            replace(
                one,
                ids=np.append(one.ids, state.next_initiation_number),
                column=np.append(one.column, index[one.frame.camera.name]),
            )
            if one.frame.camera.name in index
            else one
            for one in scan.frames
        )
        scan = replace(scan, frames=frames)
    return replace(
        state,
        targets=state.targets.concatenate(new),
        next_initiation_number=state.next_initiation_number + 1,
        scan=scan,
    )


def manage_tracks(state: MultiTargetState, elapsed: float, parameters: TrackerParameters) -> MultiTargetState:
    """Confirm tentative tracks and delete improbable, unobserved, off-floor, duplicate or invalid ones."""
    recent_ns = round(max(_UNSEEN_S, 1.5 * state.interval_s) * NANOSECONDS)
    state = _with_feet(state, elapsed, recent_ns)
    targets = state.targets
    if not len(targets):
        return state
    now = state.time_ns
    assert now is not None
    cameras = (targets.seen_by > now - recent_ns).sum(axis=1)
    placed = UPRIGHT[targets.kind] & (state.floor is not None and state.floor.known)
    placed &= now - targets.born_ns >= _ALONE_S * NANOSECONDS
    ready = (targets.existence >= _CONFIRMED) & (targets.hits >= _MIN_HITS) & ((cameras >= 2) | placed)
    state = reidentify(state, ~targets.confirmed & ready, parameters)
    targets = state.targets
    unseen = (now - targets.seen_ns) / NANOSECONDS
    known = targets.confirmed
    size = np.exp(targets.mean[:, LOG_SIZE])
    spread = np.sqrt(np.trace(targets.covariance[:, POSITION, POSITION], axis1=1, axis2=2))
    max_spread = np.where(UPRIGHT[targets.kind], 2.0 * size, 2.5 * parameters.scale.units_per_m)
    drop = targets.existence < _DELETED
    drop |= ~known & (unseen > max(_UNSEEN_S, 1.5 * state.interval_s))
    drop |= known & ((unseen > parameters.coast_s) | ((unseen > recent_ns / NANOSECONDS) & (spread > max_spread)))
    drop |= _off_floor(state, recent_ns)
    drop |= _duplicates(targets, size) | (targets.overlap > _MAX_OVERLAP)
    drop |= ~np.isfinite(targets.mean).all(axis=1)
    if not drop.any():
        return state
    state = store_lost_tracks(
        state, known & drop & np.isfinite(targets.mean).all(axis=1), parameters.remember_s, parameters.max_lost_tracks
    )
    return replace(state, targets=state.targets.select(~drop))


def _with_feet(state: MultiTargetState, elapsed: float, recent_ns: int) -> MultiTargetState:
    """The floor, learned from the feet of confirmed upright targets that two cameras see."""
    targets, floor, now = state.targets, state.floor, state.time_ns
    if floor is None or now is None or elapsed <= 0.0:
        return state
    standing = targets.confirmed & UPRIGHT[targets.kind] & (targets.seen_ns == now)
    standing &= (targets.seen_by > now - recent_ns).sum(axis=1) >= 2
    if not standing.any():
        return state
    mean = targets.mean[standing]
    feet = mean[:, POSITION] - 0.5 * np.exp(mean[:, LOG_SIZE, None]) * floor.up
    return replace(state, floor=floor.with_feet(feet))


def _off_floor(state: MultiTargetState, recent_ns: int) -> Bools:
    """Upright targets off the floor that fewer than three cameras see: false matches of two different people."""
    targets, now, floor = state.targets, state.time_ns, state.floor
    if floor is None or now is None or not floor.known:
        return np.zeros(len(targets), dtype=np.bool_)
    few = (targets.seen_by > now - recent_ns).sum(axis=1) < 3
    return np.asarray(UPRIGHT[targets.kind] & few & _off(floor, targets.mean))


def with_overlap(
    targets: Targets, hit: Bools, probability: Floats, fraction: float, elapsed: float, parameters: TrackerParameters
) -> Targets:
    """Update ``overlap``: whether one camera detects a target and its older neighbour, or only one of them.

    hit, probability: (n,) detections, and their probabilities if both exist. fraction: how much of an independent
    observation the frame is. elapsed: since the frame before, of any camera [s].
    """
    if len(targets) < 2 or parameters.up is None:
        return targets
    offset = targets.mean[:, None, POSITION] - targets.mean[None, :, POSITION]
    offset = offset - (offset @ parameters.up)[..., None] * parameters.up
    distance = np.linalg.norm(offset, axis=2)
    order = np.where(targets.confirmed, 0, 2**40) + targets.initiation_number
    upright = UPRIGHT[targets.kind]
    older = upright[:, None] & upright[None, :] & (order[None, :] < order[:, None])
    distance = np.where(older, distance, np.inf)
    other = distance.argmin(axis=1)
    apart = distance[np.arange(len(targets)), other] / np.exp(targets.mean[:, LOG_SIZE])
    near = apart < _NEIGHBOUR
    p, q = probability, probability[other]
    single = np.maximum(p, q)
    # Likelihood ratios of one person against two, for none, one and both of the tracks detected.
    both = np.log(_TWICE / (p * q))
    one = np.log(single / (p * (1.0 - q) + q * (1.0 - p)))
    none = np.log((1.0 - single) / ((1.0 - p) * (1.0 - q)))
    gain = np.select([hit & hit[other], hit | hit[other]], [both, one], none)
    # Two bodies are not in one place, whatever is detected there: one second of it decides.
    gain = np.where(apart < _BODY_WIDTH, _MAX_OVERLAP * elapsed, fraction * gain)
    overlap = np.clip(targets.overlap + gain, _MIN_OVERLAP, None)
    return replace(targets, overlap=np.where(near, overlap, np.minimum(targets.overlap, 0.0)))


def _duplicates(targets: Targets, size: Floats) -> Bools:
    """Which targets are duplicates: at the position of an older target, and tentative or less probable."""
    n = len(targets)
    if n < 2:
        return np.zeros(n, dtype=np.bool_)
    offset = np.linalg.norm(targets.mean[:, None, POSITION] - targets.mean[None, :, POSITION], axis=2)
    near = (offset < 0.5 * _SAME_TARGET_RADIUS * size[:, None]) & (targets.kind[:, None] == targets.kind[None, :])
    near &= UPRIGHT[targets.kind][:, None]  # the size of other kinds may be unknown
    older = (targets.number[None, :] > 0) & (
        (targets.number[:, None] == 0) | (targets.number[None, :] < targets.number[:, None])
    )
    weaker = (targets.existence[:, None] < 0.5) | (targets.number[:, None] == 0)
    return np.asarray((near & older & weaker).any(axis=1))
