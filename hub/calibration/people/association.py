"""Association of people across cameras by their keypoints, with clocks and poses unknown or given.

Tracklets of two cameras are tried as one person with the pair solver (lag and two-view geometry from all joints), best
coarse scan first. The geometry of the first that it accepts scores every other pair of tracklets by the epipolar
distances of their joints. Tracklets of all cameras are then merged greedily by the sum of these log-likelihood ratios,
never two of one camera at one time.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.preprocessing import PreparedSession, nominal_intrinsics, prepare
from hub.calibration.pairs.pair_network import Progress, solve_one_pair
from hub.calibration.people.tracklets import Tracklet, find_tracklets, people_of
from hub.sync.track_cache import TrackCache, ranking_score
from hub.trajectory.image_tracks import smooth_only
from hub.two_view.relative_pose import relative_pose_between, sampson
from protocols.core.clocks import CameraTime
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration, FixedCalibration
from protocols.session.observations import Observations, Track
from protocols.session.rig import Rig

_LONGEST, _MIN_ANCHOR_S = 5, 3.0  # tracklets of a camera that are tried with the pair solver; s
_TRIALS = 4  # pairs of tracklets of two cameras that are solved
_ENOUGH_PAIRS = 2  # of a camera with connected ones: the second checks the first
_ALL_PAIRS = 4  # cameras up to which all pairs are solved
_BRIDGED_S = 0.2  # between two rows of a tracklet, in which a joint moves on a line
_CORRELATION_S = 0.3  # keypoint errors of a stride or a turn of the head: one independent sample
# The alternative to one person is another one somewhere near: joints then miss the epipolar line by a share of a body.
_OTHER_SHARE = 0.15  # of the image's height: std of that miss
_MIN_NOISE_PX = 2.0  # keypoints are no more exact, however well the few rows of a fit agree
_FLOOR = -3.0  # log-likelihood ratio of one joint: wrong keypoints
_PAUSE_S, _TAIL = 1.0, 5  # s that a person may be lost or confused in one camera; frames that give the velocity
_STEP_STD, _DRIFT_STD = 0.03, 0.3  # of a person's size, and per second of the pause
_MAX_CONTINUITY = 3.0  # log-likelihood ratio: people who meet may also turn back
_MIN_SCORE = 4.0  # log-likelihood ratio from which two tracklets are one person: odds of 50
_CONSISTENT = 0.95  # share of the seconds of one person in two cameras with one name: the given names are kept


@dataclass(frozen=True, slots=True, eq=False)
class _Geometry:
    """Two cameras a, b: t_a = rate * t_b + offset [s] on their own clocks, ``s_bᵀ matrix s_a = 0`` of normalised
    points, with noise [px]."""

    matrix: Floats
    rate: float
    offset: float
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A tracklet in normalised coordinates (n, joints, 2)."""

    tracklet: Tracklet
    points: Floats
    focal: float
    height: int


def associate_people(
    rig: Rig, observations: Observations, progress: Progress | None = None, known: FixedCalibration | None = None
) -> tuple[Rig, Observations, str]:
    """Observations in which one person has one name in all cameras, the rig with its scale bars by these names, and a
    sentence for the user, "" where nothing was associated.

    Names that already agree are kept. known: given poses; clocks are still estimated.
    """
    people, joints = people_of(observations)
    if not people:
        return rig, observations, ""
    report = progress or (lambda text, share: None)
    views = _views(rig, observations, people, joints, {} if known is None else known.cameras)
    geometries = _solve_geometries(rig, views, joints, known, report)
    return _renamed(rig, observations, views, geometries, people, joints)


def associate_with_calibration(
    rig: Rig, known: Mapping[str, CameraCalibration], observations: Observations
) -> tuple[Observations, str]:
    """`associate_people` with poses, lenses and clocks given."""
    people, joints = people_of(observations)
    if not people:
        return observations, ""
    views = _views(rig, observations, people, joints, known)
    geometries = {}
    for a, b in itertools.combinations((name for name in views if name in known), 2):
        one, other = known[a], known[b]
        if np.linalg.norm(one.pose.position - other.pose.position) == 0.0:
            continue
        rate = other.time_map.clock_rate / one.time_map.clock_rate
        offset = float(one.time_map.camera_from_reference(other.time_map.reference_from_camera(CameraTime(0.0))))
        shared = rig.shared_clock
        noise = max(one.rms_px, other.rms_px, _MIN_NOISE_PX)
        matrix = relative_pose_between(one.pose, other.pose).matrix
        geometries[a, b] = _Geometry(matrix, 1.0 if shared else rate, 0.0 if shared else offset, noise)
    _, renamed, note = _renamed(rig, observations, views, geometries, people, joints)
    return renamed, note


def _views(
    rig: Rig,
    observations: Observations,
    people: list[str],
    joints: list[str],
    known: Mapping[str, CameraCalibration],
) -> dict[str, list[_View]]:
    out = {}
    for name, camera in rig.cameras.items():
        lens = known[name].intrinsics if name in known else camera.intrinsics or nominal_intrinsics(camera)
        found = find_tracklets(observations, name, people, joints)
        out[name] = [
            _View(one, lens.unproject(one.pixels.reshape(-1, 2)).reshape(one.pixels.shape), lens.focal, lens.height)
            for one in found
        ]
    return out


def _solve_geometries(
    rig: Rig,
    views: dict[str, list[_View]],
    joints: list[str],
    known: FixedCalibration | None,
    report: Progress,
) -> dict[tuple[str, str], _Geometry]:
    """The geometry of pairs of cameras by one person whom both saw."""
    anchors = {name: _anchors(mine) for name, mine in views.items()}
    tracks = {
        (name, track.label): track
        for name, mine in anchors.items()
        for number, view in enumerate(mine)
        for track in _tracks(view.tracklet, [f"{number}.{joint}" for joint in joints])
        if track is not None
    }
    prepared = prepare(rig, Observations(tracks))
    names, cache = prepared.names, TrackCache()
    ranked: dict[tuple[str, str], list[tuple[float, int, int]]] = {}
    for a, b in itertools.combinations(names, 2):
        trials = [
            (_promise(prepared, (a, b), (i, j), cache), i, j)
            for i, j in itertools.product(range(len(anchors[a])), range(len(anchors[b])))
        ]
        ranked[a, b] = sorted(trials, reverse=True)[:_TRIALS]
    geometries: dict[tuple[str, str], _Geometry] = {}
    solved: Counter[str] = Counter()
    order = sorted((pair for pair in ranked if ranked[pair]), key=lambda pair: -ranked[pair][0][0])
    for number, (a, b) in enumerate(order):
        if len(names) > _ALL_PAIRS and min(solved[a], solved[b]) >= _ENOUGH_PAIRS:
            continue
        report(f"people of {a} and {b}", 0.04 * number / len(order))
        for _, i, j in ranked[a, b]:
            geometry = _solve(_of_one_person(prepared, (a, b), (i, j)), (a, b), known)
            if geometry is not None:
                geometries[a, b] = geometry
                solved.update((a, b))
                break
    return geometries


def _anchors(views: list[_View]) -> list[_View]:
    """The longest tracklets of a camera."""
    lasting = [one for one in views if np.ptp(one.tracklet.time) >= _MIN_ANCHOR_S]
    return sorted(lasting, key=lambda one: -float(np.ptp(one.tracklet.time)))[:_LONGEST]


def _tracks(tracklet: Tracklet, labels: list[str]) -> list[Track | None]:
    """Rows of a tracklet by joint, under the given labels; None where a joint was never seen."""
    out: list[Track | None] = []
    stated = bool(np.isfinite(tracklet.std).any())
    for joint, label in enumerate(labels):
        rows = np.isfinite(tracklet.pixels[:, joint]).all(axis=1)
        std = tracklet.std[rows, joint] if stated else None
        pixels, size = tracklet.pixels[rows, joint], np.full(int(rows.sum()), np.nan)
        row = Track(tracklet.camera, label, tracklet.frame[rows], tracklet.time[rows], pixels, size, std)
        out.append(row if rows.any() else None)
    return out


def _of_one_person(prepared: PreparedSession, pair: tuple[str, str], numbers: tuple[int, int]) -> PreparedSession:
    """The session in which two cameras saw only one tracklet each, under the joints' names."""
    changed = {}
    for name, number in zip(pair, numbers, strict=True):
        camera, prefix = prepared.camera(name), f"{number}."
        tracks = {label.removeprefix(prefix): t for label, t in camera.tracks.items() if label.startswith(prefix)}
        changed[name] = replace(camera, tracks=tracks)
    cameras, uncalibrated = (
        {name: changed.get(name, camera) for name, camera in group.items()}
        for group in (prepared.cameras, prepared.uncalibrated)
    )
    return replace(prepared, cameras=cameras, uncalibrated=uncalibrated)


def _promise(prepared: PreparedSession, pair: tuple[str, str], numbers: tuple[int, int], cache: TrackCache) -> float:
    one = _of_one_person(prepared, pair, numbers)
    a, b = (one.camera(name).tracks for name in pair)
    if prepared.shared_clock:  # no lags to scan: the longest common sight
        return float(sum(min(len(a[joint].time), len(b[joint].time)) for joint in a if joint in b))
    return ranking_score(smooth_only(a), smooth_only(b), cache=cache)


def _solve(prepared: PreparedSession, pair: tuple[str, str], known: FixedCalibration | None) -> _Geometry | None:
    found = solve_one_pair(prepared, pair, known)
    if not found.solved or found.fit is None:
        return None
    fit, (a, b) = found.fit, pair
    # In the session's times: (t - time origin) of each camera.
    offset = fit.offset + prepared.time_origins[a] - fit.rate * prepared.time_origins[b]
    return _Geometry(fit.geometry.matrix, fit.rate, offset, max(fit.residual_px, _MIN_NOISE_PX))


def _score(one: _View, other: _View, geometry: _Geometry) -> tuple[float, float]:
    """Log-likelihood ratio of one person against two, and the seconds [s] in which both were seen."""
    time = geometry.rate * other.tracklet.time + geometry.offset
    index = np.clip(np.searchsorted(one.tracklet.time, time), 1, len(one.tracklet.time) - 1)
    before, after = one.tracklet.time[index - 1], one.tracklet.time[index]
    interval = float(np.median(np.diff(one.tracklet.time)))
    common = (time >= before) & (time <= after) & (after - before <= max(_BRIDGED_S, 1.5 * interval))
    if common.sum() < 2:
        return 0.0, 0.0
    share = ((time - before) / (after - before))[common, None, None]
    index = index[common]
    a = ((1.0 - share) * one.points[index - 1] + share * one.points[index]).reshape(-1, 2)
    b = other.points[common].reshape(-1, 2)
    sigma_a, sigma_b = geometry.noise / one.focal, geometry.noise / other.focal
    distance = sampson(geometry.matrix, a, b, sigma_a, sigma_b).reshape(int(common.sum()), -1)
    spread = _OTHER_SHARE * other.height / geometry.noise
    ratio = np.log(spread) - 0.5 * distance**2 * (1.0 - spread**-2)
    ratio = np.maximum(np.where(np.isfinite(distance), ratio, np.nan), _FLOOR)
    known = np.isfinite(ratio).any(axis=1)
    if not known.any():
        return 0.0, 0.0
    step = float(np.median(np.diff(other.tracklet.time)))
    seconds = float(known.sum()) * step
    return float(np.nanmean(ratio[known], axis=1).mean()) * max(seconds / _CORRELATION_S, 1.0), seconds


def _continuity(tracklets: list[Tracklet]) -> Floats:
    """(n, n) log-likelihood ratios that a tracklet of a camera continues another one rather than any other does.

    Each is small, but several cameras seldom confuse the same people in the same way.
    """
    count = len(tracklets)
    score = np.full((count, count), -np.inf)
    for i, j in itertools.permutations(range(count), 2):
        one, next_ = tracklets[i], tracklets[j]
        pause = float(next_.time[0] - one.time[-1])
        if not 0.0 < pause <= _PAUSE_S:
            continue
        tail, seconds = one.pixels[-_TAIL:], max(float(one.time[-1] - one.time[-_TAIL:][0]), 1e-9)
        steps = next_.pixels[0] - tail[-1], tail[-1] - tail[0]
        if not all(np.isfinite(step).all(axis=1).any() for step in steps):
            continue
        size = float(np.linalg.norm(np.nanmax(tail[-1], axis=0) - np.nanmin(tail[-1], axis=0)))
        step, motion = (np.nanmedian(part, axis=0) for part in steps)
        std = _STEP_STD + _DRIFT_STD * pause
        miss = float(np.linalg.norm(step - motion * pause / seconds)) / max(size, 1.0)
        score[i, j] = max(-2.0 * np.log(std) - 0.5 * (miss / std) ** 2, 0.0)
    out = np.zeros((count, count))
    for i, j in np.argwhere(score > 0.0).tolist():
        others = max(np.delete(score[i], j).max(initial=0.0), np.delete(score[:, j], i).max(initial=0.0))
        out[i, j] = out[j, i] = np.clip(score[i, j] - max(others, 0.0), 0.0, _MAX_CONTINUITY)
    return out


def _renamed(
    rig: Rig,
    observations: Observations,
    views: dict[str, list[_View]],
    geometries: dict[tuple[str, str], _Geometry],
    people: list[str],
    joints: list[str],
) -> tuple[Rig, Observations, str]:
    nodes = [view for mine in views.values() for view in mine]
    number = {id(view): k for k, view in enumerate(nodes)}
    scores = np.zeros((len(nodes), len(nodes)))
    consistent, total = 0.0, 0.0
    for (a, b), geometry in geometries.items():
        for one, other in itertools.product(views[a], views[b]):
            score, seconds = _score(one, other, geometry)
            i, j = number[id(one)], number[id(other)]
            scores[i, j] = scores[j, i] = score
            if score >= _MIN_SCORE:
                same = len({*one.tracklet.names, *other.tracklet.names}) == 1
                consistent, total = consistent + seconds * same, total + seconds
    for mine in views.values():
        index = [number[id(view)] for view in mine]
        scores[np.ix_(index, index)] += _continuity([view.tracklet for view in mine])
    if consistent >= _CONSISTENT * total:  # also where nothing could be compared
        return _with_bars(rig, people), observations, ""
    groups = _merge(scores, _conflicts(nodes))
    groups = [group for group in groups if len({nodes[k].tracklet.camera for k in group}) > 1]
    named = {k: f"p{name}" for name, group in enumerate(groups) for k in group}
    rows: dict[tuple[str, str], list[Track]] = {}
    for k, view in enumerate(nodes):
        if k in named:
            labels = [f"{named[k]}.{joint}" for joint in joints]
            for track in _tracks(view.tracklet, labels):
                if track is not None:
                    rows.setdefault((track.camera, track.label), []).append(track)
    tracks = {key: _joined(rows[key]) for key in sorted(rows, key=lambda key: (list(views).index(key[0]), key[1]))}
    used = sum(len(track) for track in tracks.values())
    note = (
        f"{len(groups)} people were associated across cameras from {len(nodes)} tracks; "
        f"{100 * (1 - used / max(len(observations), 1)):.0f} % of the keypoints are of nobody whom two cameras saw"
    )
    names = [f"p{name}" for name in range(len(groups))]
    return _with_bars(rig, names), replace(observations, tracks=tracks), note


def _conflicts(nodes: list[_View]) -> Floats:
    """(n, n) whether two tracklets are of one camera at one time."""
    begin, end = (np.array([view.tracklet.time[k] for view in nodes]) for k in (0, -1))
    camera = np.array([view.tracklet.camera for view in nodes])
    overlap = np.minimum(end[:, None], end[None]) > np.maximum(begin[:, None], begin[None])
    return np.asarray((camera[:, None] == camera[None]) & overlap, dtype=np.float64)


def _merge(scores: Floats, conflicts: Floats) -> list[list[int]]:
    """Groups of tracklets of one person each: the best two groups are merged while they are rather one person."""
    groups = [[k] for k in range(len(scores))]
    merit = np.where(conflicts > 0.0, -np.inf, scores)
    np.fill_diagonal(merit, -np.inf)
    while len(groups) > 1:
        i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(merit)), merit.shape))
        if not merit[i, j] >= _MIN_SCORE:
            break
        groups[i] += groups.pop(j)
        merit[i] += merit[j]
        merit[:, i] = merit[i]
        merit[i, i] = -np.inf
        merit = np.delete(np.delete(merit, j, axis=0), j, axis=1)
    return sorted(groups, key=len, reverse=True)


def _joined(tracks: list[Track]) -> Track:
    """The rows of tracklets that follow each other."""
    first, *_ = tracks
    frame, time, pixels, size = (
        np.concatenate([getattr(track, name) for track in tracks]) for name in ("frame", "time", "pixels", "size")
    )
    std = None if first.std is None else np.concatenate([track.std for track in tracks if track.std is not None])
    order = np.argsort(time, kind="stable")
    return Track(first.camera, first.label, frame, time, pixels, size, std).select(np.asarray(order))


def _with_bars(rig: Rig, people: list[str]) -> Rig:
    """The rig with its scale bars between joints as bars of every person."""
    bars = []
    for a, b, length in rig.scale_bars:
        of_people = "." not in a + b
        bars += [(f"{one}.{a}", f"{one}.{b}", length) for one in people] if of_people else [(a, b, length)]
    return replace(rig, scale_bars=tuple(bars))
