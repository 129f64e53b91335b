"""One frame of one camera: predict, associate, update, discover, confirm, lose. A pure function of state and frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hub.tracking.association.assignment import (
    alikeness,
    ambiguity,
    assign,
    colour_std,
    costs,
    either,
    overlaps,
    rows_used,
    strangers,
)
from hub.tracking.association.initiation import Found, Scale, features_of, hypothesis
from hub.tracking.association.reidentification import recall, remember
from hub.tracking.camera_frame import Frame, TrackingCamera
from hub.tracking.filter import kalman
from hub.tracking.filter.kalman import LOG_SIZE, POSITION
from hub.tracking.filter.manoeuvre import Turned, jumped, jumpy, weighed
from hub.tracking.filter.measurement import FOOT, HEAD, POINT, Expected, doubt, expect, measured
from hub.tracking.filter.target_models import BODIES
from hub.tracking.filter.target_states import State, Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats, Ints

_WINDOW_NS = 250_000_000
"""Features so much older than a frame do not found a target with it."""
_CROWD = 0.08
"""Noise that is added to the points of silhouettes that touch [sizes]."""
_LEAST_TRUST = 0.1
"""Share of its weight that a detection keeps which is as well another target's."""
_MOST_FOUNDED = 4
_MOST_TENTATIVE = 64
_FASTEST, _SLOWEST = 0.35, 0.04
"""Weights with which the share of hits is renewed: first and later."""
_CONFIRM_HITS, _CONFIRM_S, _CONFIRM_SUPPORT = 8, 0.3, 0.5
_TENTATIVE_SUPPORT, _TENTATIVE_CHANCES, _TENTATIVE_S = 0.35, 8, 0.5
_CONFIRMED_SUPPORT, _UNSEEN_S = 0.15, 0.5
_COLOUR_RENEWAL = 0.02
_SAME = 0.3
"""Shares of the size: a hypothesis so near a target is that target; two targets half as near are one."""
_BODY, _BESIDE_S = 0.18, 1.0
"""Share of the height that bodies which touch are apart at the least; how long two may seem nearer [s]."""
_FLOOR_REACH, _FLOOR_SURE, _FLOOR_MEMORY = 0.25, 200.0, 5000.0
_GROWTH = 1e-4
_AT_ONCE_NS = 500_000_000
_RESTLESS = np.array([body.restlessness for body in BODIES])
_UPRIGHT = np.array([body.upright for body in BODIES])
_TYPICAL = np.array([body.size_m for body in BODIES])


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """What tracking is told of the world. up: (3,), None = not known. coast_s: how long a target lives unseen.

    remember_s: how long a lost one may come back under its old name; at most ``most_gone`` of them.
    """

    up: Floats | None = None
    scale: Scale = field(default_factory=Scale)
    coast_s: float = 2.5
    remember_s: float = 120.0
    most_gone: int = 200


def step(state: State, frame: Frame, cameras: dict[str, TrackingCamera], world: World) -> State:
    """The state after one frame; frames must come in the order of their keys."""
    state = state.with_camera(frame.camera.name)
    elapsed = 0.0 if state.time_ns is None else (frame.reference_ns - state.time_ns) / NANOSECONDS
    state = replace(state, targets=moved(state.targets, elapsed, world))
    value, noise = measured(frame, np.arange(len(frame)))
    state, free = _matched(state, frame, value, noise, world)
    pool = {name: features for name, features in state.pool.items() if name in cameras}
    fresh = {name: time for name, time in state.fresh.items() if name in cameras}
    pool[frame.camera.name] = features_of(frame, value, noise, free)
    fresh[frame.camera.name] = frame.reference_ns
    state = replace(state, time_ns=frame.reference_ns, fresh=fresh, pool=pool)
    state = _discovered(state, frame, cameras, world)
    state = replace(_with_floor(state, world), targets=_beside(state.targets, elapsed, world))
    return _sorted_out(state, world)


def moved(targets: Targets, elapsed: float, world: World) -> Targets:
    """The targets ``elapsed`` seconds on."""
    if not len(targets) or elapsed == 0.0:
        return targets
    size = np.exp(targets.mean[:, LOG_SIZE])
    metre = np.where(_UPRIGHT[targets.kind], size / _TYPICAL[targets.kind], world.scale.metre)
    restless = _RESTLESS[targets.kind] * metre**2
    mean, covariance = kalman.predict(targets.mean, targets.covariance, elapsed, restless, _GROWTH)
    return replace(targets, mean=mean, covariance=covariance)


def _matched(state: State, frame: Frame, value: Floats, noise: Floats, world: World) -> tuple[State, Ints]:
    """Targets updated by the frame's detections, and the detections that fit none of them."""
    targets, variance, free = state.targets, state.colour_variance, np.arange(len(frame))
    if not len(targets):
        return state, free
    expected = expect(frame.camera, targets.mean, targets.kind, world.up)
    crowded, hidden = overlaps(frame.camera, expected, targets)
    if crowded.any():
        expected = expected.blurred(np.where(hidden, 2.0, 1.0) * crowded * _CROWD)
    seen = frame.camera.sees(expected.value[:, POINT], expected.depth)
    row, column = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    if len(frame):
        names = tuple(label_of(int(k), int(n)) if n else "" for k, n in zip(targets.kind, targets.number, strict=True))
        found = costs(frame, value, noise, targets, expected, names, colour_std(variance))
        turned = None
        if jumpy(targets).any():
            turned = jumped(targets, frame.reference_ns, world.scale.metre)
            loose = replace(targets, covariance=turned.covariance)
            found = either(found, costs(frame, value, noise, loose, expected, names, colour_std(variance)), turned.odds)
        # What is confirmed chooses first: a wrong pairing must not take a detection from it.
        for group in (targets.confirmed, ~targets.confirmed):
            total = np.where(group[:, None], found.total, np.inf)
            total[:, column] = np.inf
            some, those = assign(total)
            row, column = np.concatenate([row, some]), np.concatenate([column, those])
        known = np.where(targets.confirmed[:, None], found.total, np.inf)
        known[row, column] = found.total[row, column]
        doubtful = ambiguity(known, row, column, strangers(targets.kind[row]))
        left = np.ones(len(frame), dtype=np.bool_)
        left[column] = False
        free = np.flatnonzero(left)
        sure = targets.confirmed[row]
        told, known_as = frame.colour[column[sure]], targets.colour[row[sure]]
        variance = alikeness(variance, told, known_as, doubtful[sure])
        camera = state.cameras.index(frame.camera.name)
        targets = _updated(
            targets, turned, frame, value, noise, expected, found.distance, row, column, doubtful, camera
        )
    hit = np.zeros(len(targets), dtype=np.bool_)
    hit[row] = True
    return replace(state, targets=_counted(targets, hit, seen & ~hidden), colour_variance=variance), free


def _updated(
    targets: Targets,
    turned: Turned | None,
    frame: Frame,
    value: Floats,
    noise: Floats,
    expected: Expected,
    distance: Floats,
    row: Ints,
    column: Ints,
    doubtful: Floats,
    camera: int,
) -> Targets:
    if not len(row):
        return targets
    order = np.argsort(row, kind="stable")
    row, column, doubtful = row[order], column[order], doubtful[order]
    some = expected.kept(row)
    used = rows_used(value[column], some, distance[row, column], targets.covariance[row])
    off = np.where(used, value[column] - some.value, 0.0)
    total = np.where(np.isfinite(noise[column]), noise[column], 0.0) + some.body_noise
    for part, rows in ((1, HEAD), (2, FOOT)):
        total[:, rows, rows] *= doubt(distance[row, column, part])[:, None, None]
    # What may be another's moves nobody: where two cross, cameras that tell them apart lead.
    total /= np.maximum(1.0 - 2.0 * doubtful, _LEAST_TRUST)[:, None, None] ** 2
    mean, covariance = targets.mean[row], targets.covariance[row]
    if turned is None:
        mean, covariance = kalman.update(mean, covariance, off, some.slope, total, used)
    else:
        loose, odds = turned.covariance[row], turned.odds[row]
        mean, covariance = weighed(mean, covariance, loose, odds, off, some.slope, total, used)
    means, covariances = targets.mean.copy(), targets.covariance.copy()
    means[row], covariances[row] = mean, covariance
    colour, count = targets.colour.copy(), targets.colour_count.copy()
    told = np.isfinite(frame.colour[column]).all(axis=1)
    mine, shown = row[told], frame.colour[column[told]]
    weight = np.maximum(1.0 / (count[mine] + 1.0), _COLOUR_RENEWAL)[:, None]
    old = np.where(count[mine, None] > 0, colour[mine], shown)
    colour[mine] = old + weight * (shown - old)
    count[mine] += 1.0
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


def _counted(targets: Targets, hit: Bools, due: Bools) -> Targets:
    """Support renewed where a target was seen, or should have been."""
    asked = hit | due
    weight = np.clip(1.0 / (targets.chances + 2.0), _SLOWEST, _FASTEST)
    support = np.where(asked, targets.support + weight * (hit - targets.support), targets.support)
    return replace(targets, support=support, chances=targets.chances + asked)


def _discovered(state: State, frame: Frame, cameras: dict[str, TrackingCamera], world: World) -> State:
    """Founds what the frame's unexplained features and other cameras' tell together."""
    name = frame.camera.name
    live = [other for other, time in state.fresh.items() if frame.reference_ns - time <= _WINDOW_NS]
    pool = {other: state.pool.get(other, ()) for other in live}
    fresh = {other: cameras[other] for other in live if other in cameras}
    if not pool.get(name) or not any(pool[other] for other in live if other != name):
        return state
    # Each anchor is asked once, so that a frame full of what fits nothing costs no more than a few fits.
    every = [hypothesis(anchor, pool, fresh, world.up, world.scale) for anchor in pool[name][:_MOST_FOUNDED]]
    good = [one for one in every if one is not None]
    good.sort(key=lambda one: (-len(one.features) / one.chances, -len(one.features), one.misfit))
    used: set[int] = set()
    for one in good:
        if any(id(feature) in used for feature in one.features) or not _is_new(state, one, world):
            continue
        if int((~state.targets.confirmed).sum()) >= _MOST_TENTATIVE:
            break
        used |= set(map(id, one.features))
        state = _founded(state, one)
    pool = {other: tuple(f for f in features if id(f) not in used) for other, features in pool.items()}
    return replace(state, pool={**state.pool, **pool})


def _is_new(state: State, found: Found, world: World) -> bool:
    """Whether a hypothesis is no known target, and stands where others stand."""
    size = float(np.exp(found.mean[LOG_SIZE]))
    up = world.up if _UPRIGHT[found.features[0].kind] else None
    if len(state.targets):
        off = np.linalg.norm(state.targets.mean[:, POSITION] - found.mean[POSITION], axis=1)
        spread = np.sqrt(np.trace(found.covariance[POSITION, POSITION]))
        reach = _SAME * size if up is not None else 3.0 * spread
        if (off[state.targets.kind == found.features[0].kind] < reach).any():
            return False
    if up is not None and state.floor_weight >= _FLOOR_SURE:
        foot = float(found.mean[POSITION] @ up) - 0.5 * size
        return abs(foot - state.floor) < _FLOOR_REACH * size
    return True


def _founded(state: State, found: Found) -> State:
    seen_by = np.full((1, len(state.cameras)), -(2**62), dtype=np.int64)
    for feature in found.features:
        seen_by[0, state.cameras.index(feature.camera.name)] = feature.reference_ns
    colours = np.array([f.colour for f in found.features if np.isfinite(f.colour).all()]).reshape(-1, 3)
    now = found.features[0].reference_ns
    count = len(found.features)
    one = Targets(
        identity=np.array([state.next_identity]),
        number=np.array([0]),
        kind=np.array([found.features[0].kind]),
        mean=found.mean[None],
        covariance=found.covariance[None],
        colour=(colours.mean(axis=0) if len(colours) else np.full(3, np.nan))[None],
        colour_count=np.array([float(len(colours))]),
        born_ns=np.array([now]),
        seen_ns=np.array([now]),
        hits=np.array([count]),
        chances=np.array([found.chances]),
        support=np.array([count / found.chances]),
        seen_by=seen_by,
        beside_s=np.zeros(1),
    )
    return replace(state, targets=state.targets.joined(one), next_identity=state.next_identity + 1)


def _with_floor(state: State, world: World) -> State:
    """The floor as the feet of confirmed upright targets tell it."""
    targets = state.targets
    stands = targets.confirmed & _UPRIGHT[targets.kind] & (targets.seen_ns == state.time_ns)
    if world.up is None or not stands.any():
        return state
    feet = targets.mean[stands, POSITION] @ world.up - 0.5 * np.exp(targets.mean[stands, LOG_SIZE])
    weight = state.floor_weight + len(feet)
    floor = state.floor + float((feet - state.floor).sum()) / weight
    return replace(state, floor=floor, floor_weight=min(weight, _FLOOR_MEMORY))


def _sorted_out(state: State, world: World) -> State:
    """Confirms, drops and loses targets."""
    targets = state.targets
    if not len(targets):
        return state
    now = state.time_ns
    assert now is not None
    unseen = (now - targets.seen_ns) / NANOSECONDS
    age = (now - targets.born_ns) / NANOSECONDS
    cameras = (targets.seen_by > now - _AT_ONCE_NS).sum(axis=1)
    ready = (targets.hits >= _CONFIRM_HITS) & (age >= _CONFIRM_S) & (targets.support >= _CONFIRM_SUPPORT)
    state = recall(state, ~targets.confirmed & ready & (cameras >= 2), world.scale)
    targets = state.targets
    unseen = (now - targets.seen_ns) / NANOSECONDS
    known = targets.confirmed
    size = np.exp(targets.mean[:, LOG_SIZE])
    spread = np.sqrt(np.trace(targets.covariance[:, POSITION, POSITION], axis1=1, axis2=2))
    broad = np.where(_UPRIGHT[targets.kind], 2.0 * size, 2.5 * world.scale.metre)
    weak = (targets.support < _TENTATIVE_SUPPORT) & (targets.chances >= _TENTATIVE_CHANCES)
    drop = ~known & (weak | (unseen > _TENTATIVE_S))
    drop |= known & (unseen > world.coast_s)
    drop |= known & (unseen > _UNSEEN_S) & ((targets.support < _CONFIRMED_SUPPORT) | (spread > broad))
    drop |= _off_floor(state, world)
    drop |= _doubled(targets, size) | (targets.beside_s > _BESIDE_S)
    drop |= ~np.isfinite(targets.mean).all(axis=1)
    if not drop.any():
        return state
    state = remember(state, known & drop & np.isfinite(targets.mean).all(axis=1), world.remember_s, world.most_gone)
    return replace(state, targets=state.targets.kept(~drop))


def _off_floor(state: State, world: World) -> Bools:
    """Which upright targets stand where no floor is, and no third camera says so: two see one person each."""
    targets, now = state.targets, state.time_ns
    if world.up is None or now is None or state.floor_weight < _FLOOR_SURE:
        return np.zeros(len(targets), dtype=np.bool_)
    size = np.exp(targets.mean[:, LOG_SIZE])
    foot = targets.mean[:, POSITION] @ world.up - 0.5 * size
    few = (targets.seen_by > now - _AT_ONCE_NS).sum(axis=1) < 3
    return np.asarray(_UPRIGHT[targets.kind] & few & ~(np.abs(foot - state.floor) < _FLOOR_REACH * size))


def _beside(targets: Targets, elapsed: float, world: World) -> Targets:
    """``beside_s`` after some time [s]: two cannot stand in each other for long, however often both are seen."""
    if len(targets) < 2 or world.up is None:
        return targets
    size = np.exp(targets.mean[:, LOG_SIZE])
    off = targets.mean[:, None, POSITION] - targets.mean[None, :, POSITION]
    off = off - (off @ world.up)[..., None] * world.up
    near = np.linalg.norm(off, axis=2) < _BODY * size[:, None]
    upright = _UPRIGHT[targets.kind] & targets.confirmed
    near &= upright[:, None] & upright[None, :] & (targets.number[None, :] < targets.number[:, None])
    change = np.where(near.any(axis=1), elapsed, -elapsed)
    return replace(targets, beside_s=np.maximum(targets.beside_s + change, 0.0))


def _doubled(targets: Targets, size: Floats) -> Bools:
    """Which targets are others once more: at the same place, and less seen than those."""
    n = len(targets)
    out = np.zeros(n, dtype=np.bool_)
    if n < 2:
        return out
    off = np.linalg.norm(targets.mean[:, None, POSITION] - targets.mean[None, :, POSITION], axis=2)
    near = (off < 0.5 * _SAME * size[:, None]) & (targets.kind[:, None] == targets.kind[None, :])
    near &= _UPRIGHT[targets.kind][:, None]  # the size of other kinds may not be known
    older = (targets.number[None, :] > 0) & (
        (targets.number[:, None] == 0) | (targets.number[None, :] < targets.number[:, None])
    )
    weaker = (targets.support[:, None] < 0.5) | (targets.number[:, None] == 0)
    return np.asarray((near & older & weaker).any(axis=1))


def label_of(kind: int, number: int) -> str:
    """The name under which a confirmed target is told."""
    return f"{BODIES[kind].kind}-{number}"


__all__ = ["World", "label_of", "moved", "step"]
