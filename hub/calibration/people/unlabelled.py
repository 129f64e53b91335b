"""Calibration from unlabelled people: boxes, or heads and feet, of several at once.

Each camera finds the ground by the sizes of upright people; cameras are registered on it by where people stand; with
these poses people are followed through all cameras, and their heads and feet are adjusted as labelled points.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.initialisation import Reconstruction, triangulate_and_adjust
from hub.bundle.model_comparison import LENS, refuted_lenses
from hub.bundle.preprocessing import PreparedSession, prepare
from hub.bundle.problem import CameraState, FreeParameters
from hub.calibration.final_adjustment import final_adjustment
from hub.calibration.pairs.pair_network import Progress
from hub.calibration.people.ground_plane import Bodies, GroundPlane, estimate_ground_plane
from hub.calibration.people.registration import GroundPoints, Registration, lag_grid, register, rotation
from hub.calibration.result import assemble_calibration
from hub.calibration.solvers import solve_network
from hub.clocks.clock_graph import ClockGraph, TimeMapEstimate
from hub.clocks.external_prior import ExternalClockPrior
from hub.tracking.calibration.people import END_STD, MIN_INTERVAL_NS, TOUCHING_DISTANCE
from hub.tracking.offline import FollowedTrack, follow
from protocols.core.clocks import NANOSECONDS, CameraTime, TimeMap
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig

STATURE_M = 1.7  # of adults, mean: only tells the tracker how fast people are; the published scale does not rest on it
_BOX_STD = 0.03  # of the image height of a body: a detector's box
_FAR = 25.0  # heights of the camera: beyond, an error of a box's end is a person's height on the ground
_COMMON_S, _COMMON_SHARE = 20.0, 0.5  # that two recordings have in common at the lags that are tried, at least
_KNOWN_LAG_S = 1.0  # about a lag that other pairs give
_ONE_COLUMN_PX = 0.5  # the middles of a box's top and bottom, while a body is seen along the vertical
_ROWS_OF_PERSON = 12  # in all cameras: fewer are too short a path to be worth two points
_INITIAL_RMS_PX, _INITIAL_LAG_STD_S = 5.0, 0.1  # of the registration, for the tracker
_MAX_LEAN_DEG, _MIN_WIDTH = 1.5, 0.1
"""Between the verticals of the pictures and of the plane in which heads and feet move: 0.2 to 0.7 degrees in ten rigs,
also on a slope of 10 % and with a step of 0.6 m; 2.5 with lenses 22 % off. And the width over the length of where
people walk, below which it tells no plane."""
_ITERATIONS = 0
"""Of association over the whole recording: seven took more CPU than all else. Positions of a crowd, four halls and a
room differed by 0.1 cm (one by 0.7, which was worse with seven), lags by 0.3 ms."""
_WANTED_INTERVAL_NS = NANOSECONDS // 2  # at which the tracker's paths are asked for; only their detections are used


@dataclass(frozen=True, slots=True, eq=False)
class FollowedPeople:
    """observations: heads and feet of whoever is followed in two cameras or more, as labelled points. initial: the
    cameras among which they are, in metres for people of `STATURE_M`. planes: the ground in each. refused: the others,
    with reasons."""

    observations: Observations
    initial: dict[str, CameraCalibration]
    planes: dict[str, GroundPlane]
    refused: dict[str, str]


def follow_people(
    rig: Rig,
    messages: Sequence[pb.Observation],
    progress: Progress | None = None,
    *,
    priors: Mapping[str, ExternalClockPrior] | None = None,
    seed: int = 0,
) -> FollowedPeople:
    """Who is who among unlabelled people of all cameras, by where they stand.

    messages, priors, seed: see `calibrate_people`. Raises Refused, with reasons by camera.
    """
    report = progress or (lambda text, share: None)
    rng = np.random.default_rng(seed)
    messages = _thinned(messages)
    refused: dict[str, str] = {}
    planes: dict[str, GroundPlane] = {}
    points: dict[str, GroundPoints] = {}
    for name, camera in rig.cameras.items():
        mine = [message for message in messages if message.camera == name]
        if not camera.is_measured or camera.intrinsics is None:
            refused[name] = "no intrinsics: people of unknown size tell no focal length; run `syncline intrinsics`"
        elif (plane := estimate_ground_plane(_bodies(mine, camera.intrinsics))) is None:
            count = len(_bodies(mine, camera.intrinsics).top)
            refused[name] = (
                f"the sizes of the people in it ({count} with head and foot) determine no ground plane: it needs "
                "upright people, 40 times or more, all over its picture"
            )
        else:
            planes[name], points[name] = plane, _ground_points(mine, camera.intrinsics, plane)
    placed = _placed(rig, points, priors or {}, rng, report)
    for name in planes.keys() - placed.keys():
        refused[name] = "its people do not meet the other cameras' on the ground in one way only"
    if len(placed) < 2:
        reason = "no two cameras see the same people on one ground" + "".join(f"; {n}: {r}" for n, r in refused.items())
        raise Refused(reason, {name: refused.get(name, reason) for name in rig.cameras})
    report("following people", 0.5)
    initial = {name: _initial(name, rig, planes[name], found) for name, found in placed.items()}
    return FollowedPeople(_labelled(rig, messages, initial, planes), initial, planes, refused)


def calibrate_people(
    rig: Rig,
    messages: Sequence[pb.Observation],
    progress: Progress | None = None,
    *,
    priors: Mapping[str, ExternalClockPrior] | None = None,
    seed: int = 0,
) -> tuple[Calibration, Observations]:
    """Timing and poses from unlabelled people, and their heads and feet as labelled points.

    messages: of all cameras, each detection with its head and foot [px]; of a box the middles of its top and bottom.
    A scale bar ("head", "foot", length) of the rig is the people's mean height [rig units]. priors: of clocks; lags
    that contradict them are not tried. seed: of the hypotheses. Raises Refused, with reasons by camera.
    """
    report = progress or (lambda text, share: None)
    followed = follow_people(rig, messages, progress, priors=priors, seed=seed)
    observations, initial = followed.observations, followed.initial
    planes, refused = followed.planes, followed.refused
    bars = [bar for bar in rig.scale_bars if bar[:2] == ("head", "foot")]
    rig = replace(rig, metadata=rig.metadata | {"target": "person"})
    prepared = prepare(rig, observations)
    prepared = replace(prepared, refused=prepared.refused | refused)
    poses = {name: camera.pose for name, camera in initial.items()}
    clocks = _time_maps(prepared, initial)

    def place(graph: ClockGraph) -> tuple[Reconstruction, dict[str, str]]:
        states = {
            name: CameraState(prepared.cameras[name].intrinsics, poses[name], one.rate, one.offset, one.centre)
            for name, one in graph.clocks.items()
        }
        names, free = list(states), FreeParameters(clock=not prepared.shared_clock)
        start = triangulate_and_adjust(
            prepared.cameras, states, prepared.rows, prepared.labels, (names[0], names[1]), free
        )
        return final_adjustment(start, report, shared_errors=True), {}

    try:
        solution = solve_network(prepared, [], report, place, clocks=clocks)
    except np.linalg.LinAlgError as error:
        reason = f"the people's paths do not determine the poses ({error}): film longer, or more people at once"
        raise Refused(reason, refused | dict.fromkeys(initial, reason)) from error
    report("covariances", 0.95)
    solved = set(solution.reconstruction.labels)
    people = sorted(label.rpartition("-")[0] for label in solved if label.endswith("-head"))
    both = [(f"{one}-head", f"{one}-foot") for one in people if f"{one}-foot" in solved]
    others = tuple(bar for bar in rig.scale_bars if bar not in bars)
    rig = replace(rig, scale_bars=others + tuple((*ends, length) for *_, length in bars for ends in both))
    if bars and not both:  # of silhouettes the heads alone: the camera's heights in people's are all that is known
        a, b = solution.reconstruction.names[:2]
        apart = float(np.linalg.norm(initial[a].pose.position - initial[b].pose.position))
        rig = replace(rig, distances=(*rig.distances, (a, b, apart * bars[0][2] / STATURE_M)))
    found = assemble_calibration(rig, solution)
    _check_upright(found, planes)
    return replace(found, warnings=(*found.warnings, *_contradictions(solution.reconstruction))), observations


def _contradictions(reconstruction: Reconstruction) -> tuple[str, ...]:
    """A warning where the people refute a focal length: it is wrong, or boxes of one camera are of another length."""
    refuted = refuted_lenses(reconstruction.problem, reconstruction.state, LENS[:1])
    if not refuted:
        return ()
    worst = refuted[0]
    name, change, std = reconstruction.names[worst.camera], worst.change[0], np.sqrt(worst.covariance[0, 0])
    return (
        f"{name}: its people would fit the others' with a focal length {100 * change:+.1f} % ± {100 * std:.1f} % "
        "longer: its lens or another camera's is wrong, or its boxes are longer or shorter than the others', or it "
        "looks steeply down; positions may be off by more than their stds",
    )


def _check_upright(found: Calibration, planes: Mapping[str, GroundPlane]) -> None:
    """Raise Refused where the vertical of each picture is not that of the plane in which each head, or foot, moves."""
    levels = []
    for table in found.trajectories:
        known = np.isfinite(table.position).all(axis=1)
        path, std = table.position[known], table.std[known]
        if len(path):  # of children, too; an end that one camera sees flies off under a large std
            levels.append((path - np.median(path, axis=0)) / np.maximum(std, np.median(std))[:, None])
    spread, axes = np.linalg.svd(np.concatenate(levels), full_matrices=False)[1:]
    if spread[1] < _MIN_WIDTH * spread[0]:  # all on one line: no plane
        return
    ups = np.array([camera.pose.rotation.T @ planes[name].up for name, camera in found.cameras.items()])
    up = ups.sum(axis=0) / np.linalg.norm(ups.sum(axis=0))
    lean = float(np.rad2deg(np.arccos(min(abs(axes[2] @ up), 1.0))))
    if lean > _MAX_LEAN_DEG:
        reason = (
            f"people would lean by {lean:.1f}° against the ground on which they walk: a lens is wrong, or the ground "
            "is not level, or a clock that is said to be shared is not"
        )
        raise Refused(reason, dict.fromkeys(found.cameras, reason))


def _thinned(messages: Sequence[pb.Observation]) -> list[pb.Observation]:
    """Frames of each camera that are at least `MIN_INTERVAL_NS` apart, in the order of their times."""
    kept, last = list[pb.Observation](), dict[str, int]()
    for one in sorted(messages, key=lambda one: one.device_time_ns):
        if one.camera not in last or one.device_time_ns - last[one.camera] >= MIN_INTERVAL_NS:
            kept.append(one)
            last[one.camera] = one.device_time_ns
    return kept


def _bodies(messages: Sequence[pb.Observation], lens: Intrinsics) -> Bodies:
    """Everybody whose head and foot are seen."""
    ends = np.array([[*d.head, *d.foot] for one in messages for d in one.detections if d.head and d.foot])
    return _normalised(ends.reshape(-1, 4), lens)


def _normalised(ends: Floats, lens: Intrinsics) -> Bodies:
    """Bodies of heads and feet (n, 4) [px]."""
    middle = 0.5 * (ends[:, :2] + ends[:, 2:])
    parts = [middle, ends[:, :2], ends[:, 2:]]
    centre, head, foot = lens.unproject(np.concatenate(parts)).reshape(3, -1, 2)
    good = np.isfinite(np.column_stack([centre, head, foot])).all(axis=1) & (foot[:, 1] > head[:, 1])
    return Bodies(centre[good], head[good, 1], foot[good, 1])


def _ground_points(messages: Sequence[pb.Observation], lens: Intrinsics, plane: GroundPlane) -> GroundPoints:
    times, places = [], []
    for message in messages:
        where, below = plane.places(_bodies([message], lens))
        near = np.linalg.norm(where, axis=1) < _FAR * plane.height
        times.append(message.device_time_ns / NANOSECONDS)
        places.append(where[below & near])
    return GroundPoints(np.array(times), places)


def _placed(
    rig: Rig,
    points: Mapping[str, GroundPoints],
    priors: Mapping[str, ExternalClockPrior],
    rng: np.random.Generator,
    report: Progress,
) -> dict[str, Registration]:
    """The largest group of registered cameras: each one's place in the axes of the first, and its lag."""
    pairs = list(itertools.combinations(sorted(points, key=lambda name: -sum(map(len, points[name].places))), 2))
    edges: dict[tuple[str, str], Registration] = {}
    for done, (a, b) in enumerate(pairs):
        report(f"people of {a} and {b}", 0.4 * done / len(pairs))
        known = _grow(a, edges).get(b)
        if rig.shared_clock:
            lags = np.zeros(1)
        elif known is not None:
            lags = lag_grid(points[a], points[b], 0.0)
            lags = lags[np.abs(lags - known.lag) <= _KNOWN_LAG_S]
        else:
            shorter = min(float(np.ptp(points[name].time)) for name in (a, b))
            lags = lag_grid(points[a], points[b], min(_COMMON_S, _COMMON_SHARE * shorter))
            if a in priors and b in priors:
                expected = priors[b].unix_minus_camera - priors[a].unix_minus_camera
                reach = priors[a].error_bound + priors[b].error_bound + _KNOWN_LAG_S
                lags = lags[np.abs(lags - expected) <= reach]
        found = register(points[a], points[b], lags, rng) if len(lags) else None
        if found is not None and found.accepted:
            if rig.shared_clock and found.lag != 0.0:
                reason = (
                    f"people of {a} and {b} meet best when {b}'s times are shifted by {found.lag:+.1f} s: they share "
                    'no clock; leave clock = "shared" out'
                )
                raise Refused(reason, dict.fromkeys(rig.cameras, reason))
            edges[a, b] = found
    return max((_grow(name, edges) for name in rig.cameras), key=len)


def _grow(first: str, edges: Mapping[tuple[str, str], Registration]) -> dict[str, Registration]:
    """All cameras that are connected with one, over the pairs with most meetings first."""
    placed = {first: Registration(0.0, np.zeros(2), 0.0, 0)}
    both = {**edges, **{(b, a): one.inverse() for (a, b), one in edges.items()}}
    while more := [pair for pair in both if pair[0] in placed and pair[1] not in placed]:
        a, b = max(more, key=lambda pair: both[pair].meetings)
        placed[b] = both[a, b].after(placed[a])
    return placed


def _initial(name: str, rig: Rig, plane: GroundPlane, found: Registration) -> CameraCalibration:
    """A registered camera, in metres for people of `STATURE_M`; the ground is z = 0."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(found.angle)
    pose = Pose((turn @ plane.local_from_camera).T, STATURE_M * np.append(found.shift, plane.height))
    lens = rig.cameras[name].intrinsics
    assert lens is not None
    std = 0.0 if rig.shared_clock else _INITIAL_LAG_STD_S
    return CameraCalibration(name, lens, pose, TimeMap(1.0, found.lag), std, np.zeros(3), _INITIAL_RMS_PX)


def _labelled(
    rig: Rig, messages: Sequence[pb.Observation], initial: dict[str, CameraCalibration], planes: dict[str, GroundPlane]
) -> Observations:
    """Heads and feet of everybody who is followed in two cameras or more, as ``person1-head``, ``person1-foot``, …

    planes: become those of people who differ in height.
    """
    up = np.array([0.0, 0.0, 1.0])
    start = Calibration(initial, next(iter(initial)), "metric", "m", "", "")
    seen = [one for one in messages if one.camera in initial]
    lags = {name: round(camera.time_map.time_offset * NANOSECONDS) for name, camera in initial.items()}
    times = [one.device_time_ns + lags[one.camera] for one in seen]
    wanted = range(min(times), max(times) + 1, _WANTED_INTERVAL_NS)
    followed = follow(seen, start, wanted, up=up, iterations=_ITERATIONS)
    by_key = {(one.camera, one.sequence): one for one in seen}
    of_boxes = _cameras_of_boxes(seen)
    hidden = _touching([one for one in seen if one.camera not in of_boxes], initial, followed.tracks, up)
    bodies: dict[str, list[tuple[int, int, pb.Detection, Bodies]]] = {name: [] for name in initial}
    for track in followed.tracks:
        if len({name for name, _, _ in track.detections}) < 2 or len(track.detections) < _ROWS_OF_PERSON:
            continue
        for name, sequence, index in track.detections:
            one = by_key[name, sequence].detections[index]
            if one.head and one.foot:
                body = _normalised(np.array([[*one.head, *one.foot]]), initial[name].intrinsics)
                bodies[name] += [(track.id, sequence, one, body)] if len(body.top) else []
    names, labels, frames, moments, pixels, stds = [], [], [], [], [], []
    for name, found in bodies.items():
        planes[name] = _of_people([(person, body) for person, _, _, body in found]) or planes[name]
        for person, sequence, one, body in found:
            message, lens = by_key[name, sequence], initial[name].intrinsics
            ends, shares = np.array([one.head, one.foot]), [END_STD["head"]]
            if name in of_boxes:
                ends = lens.project_normalised(body.ends(planes[name].up)[:, 0])
                shares = [_BOX_STD, _BOX_STD]
            elif person in hidden.get((name, sequence), ()):
                continue
            for end, pixel, share in zip(("head", "foot"), ends, shares, strict=False):
                names.append(name)
                labels.append(f"person{person}-{end}")
                frames.append(message.frame)
                moments.append(message.device_time_ns / NANOSECONDS)
                pixels.append(pixel)
                stds.append(share * float(np.linalg.norm(ends[1] - ends[0])))
    if not labels:
        raise Refused(
            "nobody can be followed from one camera to another", dict.fromkeys(rig.cameras, "nobody to follow")
        )
    return gather_tracks(
        names,
        labels,
        np.array(frames, dtype=np.int64),
        np.array(moments),
        np.array(pixels),
        np.full(len(names), np.nan),
        stds=np.array(stds),
        order=rig.cameras,
    )


def _cameras_of_boxes(messages: Sequence[pb.Observation]) -> set[str]:
    """The cameras whose people are boxes: head and foot in one column, which single silhouettes have by chance."""
    columns: dict[str, list[float]] = {}
    for message in messages:
        bodies = [abs(one.head[0] - one.foot[0]) for one in message.detections if one.head and one.foot]
        columns.setdefault(message.camera, []).extend(bodies)
    return {name for name, one in columns.items() if one and float(np.median(one)) < _ONE_COLUMN_PX}


def _of_people(bodies: Sequence[tuple[int, Bodies]]) -> GroundPlane | None:
    """The ground plane by bodies of one camera, each of a person with a number; None where they do not determine it."""
    if not bodies:
        return None
    centre, top, bottom = (
        np.concatenate([getattr(body, part) for _, body in bodies]) for part in ("centre", "top", "bottom")
    )
    person = np.unique([number for number, _ in bodies], return_inverse=True)[1]
    return estimate_ground_plane(Bodies(centre, top, bottom), person)


def _touching(
    messages: Sequence[pb.Observation],
    initial: Mapping[str, CameraCalibration],
    tracks: Sequence[FollowedTrack],
    up: Floats,
) -> dict[tuple[str, int], set[int]]:
    """By camera and frame, who is so near somebody else in the picture that silhouettes may be confused.

    Whether that one was detected or not: of two who touch there may be one silhouette, with the other one's head.
    """
    out: dict[tuple[str, int], set[int]] = {}
    for message in messages:
        camera = initial[message.camera]
        moment = float(camera.time_map.reference_from_camera(CameraTime(message.device_time_ns / NANOSECONDS)))
        here = [track for track in tracks if track.times[0] - 1.0 <= moment <= track.times[-1] + 1.0]
        if len(here) < 2:
            continue
        foot = np.array([[np.interp(moment, one.times, axis) for axis in one.position.T] for one in here])
        both = [camera.pose.camera_from_world(at) for at in (foot, foot + STATURE_M * up)]
        front = np.minimum(both[0][:, 2], both[1][:, 2]) > 0.0
        low, high = (at[:, :2] / np.where(front, at[:, 2], np.nan)[:, None] for at in both)
        middle, size = 0.5 * (low + high), np.linalg.norm(high - low, axis=1)
        apart = np.linalg.norm(middle[:, None] - middle[None], axis=2) + np.diag(np.full(len(here), np.inf))
        touching = (apart < TOUCHING_DISTANCE * np.fmax(size[:, None], size[None])).any(axis=1)
        out[message.camera, message.sequence] = {here[i].id for i in np.flatnonzero(touching).tolist()}
    return out


def _time_maps(prepared: PreparedSession, initial: Mapping[str, CameraCalibration]) -> dict[str, TimeMapEstimate]:
    """The registered lags as maps between times from the session's origins."""
    out: dict[str, TimeMapEstimate] = {}
    base = 0.0
    for name, camera in prepared.cameras.items():
        if name not in initial:
            continue
        lag = initial[name].time_map.time_offset + prepared.time_origins[name]
        base = base if out else lag
        ends = [time for track in camera.tracks.values() for time in (track.time[0], track.time[-1])]
        middle = 0.5 * (min(ends) + max(ends))  # about which offset and rate are uncorrelated
        out[name] = TimeMapEstimate(1.0, middle + lag - base, middle)
    return out
