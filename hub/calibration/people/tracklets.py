"""Tracklets of people in one camera: their keypoints linked from frame to frame, ended where two could be confused.

The numbers that a pose network or its tracker gives people are not used: many number them anew in every frame, and all
exchange them where people cross. Links follow a constant velocity; a frame in which another link is nearly as good ends
both tracklets, so that each is of one person.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from protocols.geometry.types import Floats, Ints
from protocols.session.observations import Observations, Track

_MIN_JOINTS = 3  # that people have in common: fewer are no body
# Costs are median distances of joints over the person's size in the image. Keypoints jitter by 0.01 of it, and a
# walker moves by 0.15 of it in a sixth of a second, of which a constant velocity leaves less than half.
_MAX_COST = 0.3
_CONFUSED_RATIO, _CONFUSED_MARGIN = 2.0, 0.03  # another link that costs less than this ratio plus margin
_MAX_PAUSE_S = 0.35  # after which the velocity says nothing
_MAX_MISSED_FRAMES = 3  # of slow cameras, whose pauses may then be longer
_MIN_FRAMES = 5  # that give a velocity at a tracklet's ends (_TAIL of association.py)
_VELOCITY_GAIN = 0.5  # of a frame: less lags behind turns, more follows the keypoints' jitter


@dataclass(frozen=True, slots=True, eq=False)
class Tracklet:
    """One person in one camera. frame, time: (n,). pixels: (n, joints, 2), NaN where not seen. std: (n, joints) [px],
    NaN where the detector states none. names: (n,) the numbers that the camera's own tracker gave the person."""

    camera: str
    frame: Ints
    time: Floats
    pixels: Floats
    std: Floats
    names: list[str]


@dataclass(slots=True, eq=False)
class _Open:
    """A tracklet that goes on. last, size [px], velocity [px/s]: of the person in the last frame."""

    last: Floats
    size: float
    time: float
    velocity: Floats = field(default_factory=lambda: np.zeros(2))


def people_of(observations: Observations) -> tuple[list[str], list[str]]:
    """Names of people and of the joints that they have in common, by labels such as ``p0.left_knee``; both empty where
    labels are not of several people."""
    joints: dict[str, list[str]] = {}
    for label in observations.labels:
        person, dot, joint = label.rpartition(".")
        if dot and person and not joint.isdigit():  # 3.0 is the corner of a tag
            joints.setdefault(person, []).append(joint)
    if len(joints) < 2:
        return [], []
    counts = dict.fromkeys(joint for names in joints.values() for joint in names)
    common = [joint for joint in counts if sum(joint in names for names in joints.values()) >= 2]
    if len(common) < _MIN_JOINTS:
        return [], []
    return [person for person, names in joints.items() if set(names) & set(common)], common


def find_tracklets(observations: Observations, camera: str, people: list[str], joints: list[str]) -> list[Tracklet]:
    """The tracklets of one camera, in the order in which they begin."""
    tracks = observations.by_label(camera)
    mine = [[tracks.get(f"{person}.{joint}") for joint in joints] for person in people]
    times = np.unique(np.concatenate([np.zeros(0), *(t.time for body in mine for t in body if t is not None)]))
    if len(times) < _MIN_FRAMES:
        return []
    bodies = [_body(body, times) for body in mine]  # per person: pixels, std, frame
    pixels, std = np.stack([one[0] for one in bodies]), np.stack([one[1] for one in bodies])
    frame = np.max([one[2] for one in bodies], axis=0)
    seen = np.isfinite(pixels[..., 0]).sum(axis=2) >= min(_MIN_JOINTS, len(joints))  # (people, times)
    pause = max(_MAX_PAUSE_S, (_MAX_MISSED_FRAMES + 0.5) * float(np.median(np.diff(times))))
    done: list[list[tuple[int, int]]] = []
    going: list[tuple[_Open, list[tuple[int, int]]]] = []
    for k, time in enumerate(times.tolist()):
        still = [pair for pair in going if time - pair[0].time <= pause]
        done += [rows for one, rows in going if time - one.time > pause]
        here = np.flatnonzero(seen[:, k])
        links, ended = _links([one for one, _ in still], pixels[here, k], time)
        done += [still[i][1] for i in ended]
        kept = [pair for i, pair in enumerate(still) if i not in ended]
        for j, person in enumerate(here.tolist()):
            if j in links:
                one, rows = still[links[j]]
                _advance(one, pixels[person, k], time)
                rows.append((person, k))
            else:
                one = _Open(pixels[person, k], _size(pixels[person, k]), time)
                kept.append((one, [(person, k)]))
        going = kept
    done += [rows for _, rows in going]
    out = []
    for rows in sorted((rows for rows in done if len(rows) >= _MIN_FRAMES), key=lambda rows: rows[0][1]):
        who, when = np.array(rows).T
        names = [people[person] for person in who.tolist()]
        out.append(Tracklet(camera, frame[when], times[when], pixels[who, when], std[who, when], names))
    return out


def _body(tracks: list[Track | None], times: Floats) -> tuple[Floats, Floats, Ints]:
    """One person's pixels (times, joints, 2), stds (times, joints) and frames (times,), -1 where nothing was seen."""
    pixels = np.full((len(times), len(tracks), 2), np.nan)
    std, frame = np.full((len(times), len(tracks)), np.nan), np.full(len(times), -1, dtype=np.int64)
    for joint, track in enumerate(tracks):
        if track is not None:
            rows = np.searchsorted(times, track.time)
            pixels[rows, joint], frame[rows] = track.pixels, track.frame
            if track.std is not None:
                std[rows, joint] = track.std
    return pixels, std, frame


def _size(joints: Floats) -> float:
    """Diagonal [px] of a person's joints (n, 2)."""
    return max(float(np.linalg.norm(np.nanmax(joints, axis=0) - np.nanmin(joints, axis=0))), 1.0)


def _links(going: list[_Open], seen: Floats, time: float) -> tuple[dict[int, int], set[int]]:
    """Which tracklet each person of a frame continues, and the tracklets that end because it could be two of them.

    seen: (people, joints, 2).
    """
    from scipy.optimize import linear_sum_assignment  # a quarter of a second to import, which markers do not need

    if not going or not len(seen):
        return {}, set()
    ahead = np.stack([one.last + one.velocity * (time - one.time) for one in going])
    sizes = np.array([one.size for one in going])
    distance = np.linalg.norm(ahead[:, None] - seen[None], axis=3)
    unseen = ~np.isfinite(distance).any(axis=2)
    distance[unseen] = 1e6  # no joint in common
    cost = np.nanmedian(distance, axis=2) / sizes[:, None]
    links, ended = {}, set[int]()
    for i, j in zip(*(part.tolist() for part in linear_sum_assignment(np.minimum(cost, 10.0))), strict=True):
        if cost[i, j] > _MAX_COST:
            continue
        others = np.concatenate([np.delete(cost[i], j), np.delete(cost[:, j], i), [np.inf]])
        if others.min() < _CONFUSED_RATIO * cost[i, j] + _CONFUSED_MARGIN:
            ended.add(i)
        else:
            links[j] = i
    return links, ended


def _advance(one: _Open, joints: Floats, time: float) -> None:
    """Continue a tracklet by a person's joints (n, 2); in place."""
    step = joints - one.last
    moved = np.asarray(np.isfinite(step).all(axis=1))
    if moved.any() and time > one.time:
        velocity = np.median(step[moved], axis=0) / (time - one.time)
        gain = _VELOCITY_GAIN if one.velocity.any() else 1.0
        one.velocity = one.velocity + gain * (velocity - one.velocity)
    known = np.asarray(np.isfinite(joints).all(axis=1))
    one.last = np.where(known[:, None], joints, one.last)
    one.size, one.time = max(_size(joints), 0.8 * one.size), time
