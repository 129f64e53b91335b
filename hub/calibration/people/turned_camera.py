"""Whether a calibration's poses are those of the recording: people of each camera stand where the others see them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hub.calibration.people.feet import (
    FRAMES,
    GROUND_STEP,
    GROUND_STEPS,
    MIN_LOOKED_AT,
    WITHIN,
    at_same_time,
    on_ground,
    seen_feet,
)
from hub.tracking.filter.target_models import PERSON
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.rig import METRES_PER_UNIT

_PEOPLE = 200  # of one camera that are looked at: three parameters of a turn are then known to 0.15°
_BIN, _BINS = np.radians(1.5), 18  # of turns about the vertical, and up and down, that are tried: to 27°
_ROLLS: Floats = np.radians(4.5 * np.arange(-4.0, 5.0))  # about the optical axis, within half of which most meet
_LEVELS = 3  # from 3 m, level ground 0.1 m off is places 0.3 m off: the best of a coarse step may be a turned camera's
_MOST_MORE = 40  # heights of the ground between two estimates: from cameras at 14 m they are up to 30
_STARTS = 3  # turns with the most meetings that are refined
_ROUNDS, _GATE, _NARROWER = 12, 0.12, 0.6
"""Of a fit of nearest people; the first one's largest angle [rad], and the next one's over it, down to `WITHIN`/2."""
_TURN_ROUNDS = 4  # in which the camera stays where it is
_NOISE, _MOVE_M = 0.01, 0.3  # of a direction to feet [rad], and std of a move, without which few people leave it free
_MIN_ANGLE, _MIN_LOSS = np.radians(0.8), 0.1
"""Median angle by which people are off, and share of the agreement with other cameras that is lost. Of 20 simulated
rooms with poses of 0.2° and 2 cm noise, 0.6° and 0.03 at most; of the crowd with such, 0.4° and 0.2."""
_MIN_GAIN = 0.02  # of agreement, from which on the ground is looked for again; with right poses 0.01
_AGREES = 0.85
"""Agreement of a camera with all others, over that of the best one, up to which another pose is looked for: one that
was turned by 3° has 0.5 to 0.83, right ones 0.95 and more in rooms, 0.74 and more in the crowd."""
_MIN_OF_REST, _MIN_AGREEMENT = 0.6, 0.25
"""Agreement with the others at the new pose, over theirs among each other, and at all: what is wrong is the pose. With
a clock that is 2 s off it is at most 0.3 and 0.18, with a turned camera 0.9 and 0.36 at least."""
_MUCH_LESS = 0.85  # of the best gain: with as much by moving another camera, which of the two it is remains unknown


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What cameras see of people at some of each one's frames, with poses and level ground as they are supposed.

    rays: of each ordered pair, the first one's to feet (f, n, 3) and at its f times the second one's (f, m, 3), in
    camera axes, NaN where there are fewer. within: distance at which two cameras' people are none of one [units].
    """

    cameras: Mapping[str, CameraCalibration]
    rays: Mapping[tuple[str, str], tuple[Floats, Floats]]
    up: Floats
    ground: float
    within: float

    def places(self, name: str, rays: Floats) -> Floats:
        """Where on the ground one camera's rays end; NaN for those that never do."""
        return on_ground(self.cameras[name].pose, rays, self.up, self.ground)

    def moved(self, name: str, pose: Pose) -> _Scene:
        """With another pose of one camera."""
        return replace(self, cameras={**self.cameras, name: replace(self.cameras[name], pose=pose)})

    def agreements(self) -> dict[tuple[str, str], tuple[float, int]]:
        """By pair, people of one whom the other should see, and how many of them are where it does: 1 - (d / within)²
        each."""
        out = {}
        for a, b in combinations(self.cameras, 2):
            here, there = (self.places(name, rays) for name, rays in zip((a, b), self.rays[a, b], strict=True))
            camera, flat = self.cameras[b], here.reshape(-1, 3)
            pixel = camera.intrinsics.project(camera.pose.camera_from_world(flat))
            size = [camera.intrinsics.width, camera.intrinsics.height]
            looked = ((pixel > 0.0) & (pixel < size)).sum(axis=1).reshape(here.shape[:2]) == 2
            looked &= np.asarray(np.isfinite(there[:, :, 0]).any(axis=1))[:, None]
            off = here[:, :, None] - there[:, None]
            squared = np.einsum("fnmi,fnmi->fnm", off, off) / self.within**2
            met = np.maximum(0.0, 1.0 - np.fmin.reduce(squared, axis=2, initial=1.0))
            out[a, b] = float(met[looked].sum()), int(looked.sum())
        return out

    def agreement(self, name: str = "", *, without: str = "") -> float:
        """Mean of all pairs, those of one camera, or those without it; -1 where few should be seen by two."""
        return _mean(self.agreements(), name, without)

    def levelled(self, grounds: Floats) -> _Scene:
        """On the ground where most agree: an eighth of a step near one of the best of these."""
        steps = (grounds[1] - grounds[0]) * np.array([0.5, 0.25, 0.125])
        levels = sorted((replace(self, ground=float(one)) for one in grounds), key=_Scene.agreement)
        found = levels[-_LEVELS:]
        for number, best in enumerate(found):
            for step in steps:
                near = (replace(best, ground=best.ground + side * float(step)) for side in (-1.0, 1.0))
                best = max((best, *near), key=_Scene.agreement)
            found[number] = best
        return max(found, key=_Scene.agreement)

    def bearings(self, name: str) -> tuple[Floats, Floats]:
        """One camera's rays (f, n, 3), and at these times the places (f, m, 3) of all whom others see."""
        pairs = [pair for pair in self.rays if pair[0] == name]
        return self.rays[pairs[0]][0], np.concatenate(
            [self.places(other, self.rays[name, other][1]) for _, other in pairs], axis=1
        )

    def off(self, name: str, pose: Pose) -> tuple[float, float]:
        """How far people of one camera are from where they would be with another pose: medians [rad], [units]."""
        rays, given = self.bearings(name)[0].reshape(-1, 3), self.cameras[name].pose
        ends = given.camera_from_world(on_ground(pose, rays, self.up, self.ground))
        ends, rays = ends[np.isfinite(ends[:, 0])], rays[np.isfinite(ends[:, 0])]
        away = np.linalg.norm(ends, axis=1)
        angle = _apart(rays, ends / away[:, None])
        return (float(np.median(angle)), float(np.median(angle * away))) if len(away) else (0.0, 0.0)


def _mean(pairs: Mapping[tuple[str, str], tuple[float, int]], name: str = "", without: str = "") -> float:
    chosen = [pairs[pair] for pair in pairs if (not name or name in pair) and without not in pair]
    chosen = [one for one in chosen if one[1] >= MIN_LOOKED_AT]
    return sum(met for met, _ in chosen) / sum(count for _, count in chosen) if chosen else -1.0


def turned_people(
    messages: Sequence[pb.Observation], known: Calibration, up: Floats, usual: tuple[float, float]
) -> tuple[str, ...] | None:
    """A warning where people of one camera stand elsewhere than the others see them, and another pose mends it.

    usual: between where along ``up`` (3,) the ground would be if all were of `PERSON`'s size [its units]. Of
    several such cameras, the one that mends most. Of two cameras either may be it. None: too few people are where two
    cameras look.
    """
    metre = 1.0 / METRES_PER_UNIT[known.units]
    step = GROUND_STEP * PERSON.size_m * metre
    more = int(np.clip(np.nan_to_num((usual[1] - usual[0]) / step), 0, _MOST_MORE))
    grounds: Floats = usual[0] + step * np.arange(-GROUND_STEPS, GROUND_STEPS + 1.0 + more)
    scene = _scene(messages, known, up, WITHIN * PERSON.size_m * metre)
    if len(scene.cameras) < 2:
        return None
    scene = scene.levelled(grounds)
    if scene.agreement() < 0.0:
        return None
    pairs = scene.agreements()
    agreements = {name: _mean(pairs, name) for name in scene.cameras}
    suspects = [name for name, one in agreements.items() if one <= _AGREES * max(agreements.values())]
    found = _mended(scene, suspects if len(agreements) > 2 else agreements, _MOVE_M * metre)
    if found and found[0][0] > _MIN_GAIN:  # the ground is also where a camera that was turned has it
        other = scene.moved(found[0][1], found[0][2]).levelled(grounds)
        scene = replace(scene, ground=other.ground)
        found = _mended(scene, agreements, _MOVE_M * metre)
    if not found:
        return ()
    gain, name, pose = found[0]
    angle, distance = scene.off(name, pose)
    mended = scene.moved(name, pose)
    before, after, rest = scene.agreement(name), mended.agreement(name), mended.agreement(without=name)
    fits = after >= max(_MIN_AGREEMENT, _MIN_OF_REST * rest) and not 0.0 <= rest < _MIN_AGREEMENT
    if not fits or angle < _MIN_ANGLE or after - before < _MIN_LOSS * after:
        return ()
    rivals = [other for more, other, _ in found[1:] if more > _MUCH_LESS * gain]
    off = f"{distance * METRES_PER_UNIT[known.units]:.1f} m ({np.degrees(angle):.1f}°)"
    others = [one for one in scene.cameras if one != name]
    if len(others) == 1 or rivals:
        who, what = f"{name} and {(rivals or others)[0]}: their people are {off} off each other", "one of them"
    else:
        who, what = f"{name}: its people are {off} off those of {', '.join(others)}", "it"
    return (f"{who}: {what} was turned or moved since; calibrate again",)


def _scene(messages: Sequence[pb.Observation], known: Calibration, up: Floats, within: float) -> _Scene:
    seen = {name: seen_feet(camera, messages) for name, camera in known.cameras.items()}
    seen = {name: one for name, one in seen.items() if len(one[0]) > 1}
    rays = dict[tuple[str, str], tuple[Floats, Floats]]()
    for name, (times, mine) in seen.items():
        usually = np.isfinite(mine[:, :, 0]).sum() / len(times)
        count = int(np.clip(_PEOPLE / max(usually, 1.0), FRAMES // 3, 2 * FRAMES))
        some = np.unique(np.linspace(0, len(times) - 1, count).astype(int))
        for other, (others, theirs) in seen.items():
            at, near = at_same_time(times[some], others)
            rays[name, other] = mine[some], np.where(near[:, None, None], theirs[at], np.nan)
    cameras = {name: known.cameras[name] for name in seen}
    return _Scene(cameras, {pair: one for pair, one in rays.items() if pair[0] != pair[1]}, up, 0.0, within)


def _mended(scene: _Scene, names: Iterable[str], move: float) -> list[tuple[float, str, Pose]]:
    """By how much people agree better with another pose of one of these cameras, and the pose; the best first."""
    given, found = scene.agreement(), list[tuple[float, str, Pose]]()
    for name in names:
        camera = scene.cameras[name]
        poses = (_fitted(scene, name, start, move) for start in [camera.pose, *_turns(scene, name)])
        gains = [(scene.moved(name, pose).agreement() - given, name, pose) for pose in poses if pose is not None]
        found += [max(gains, key=lambda one: one[0])] if gains else []
    return sorted(found, key=lambda one: -one[0])


def _turns(scene: _Scene, name: str) -> list[Pose]:
    """The poses at one place in which most rays of a camera point at people of others, by counts of differences."""
    rays, places = scene.bearings(name)
    pose, found = scene.cameras[name].pose, list[tuple[float, Pose]]()
    axis = pose.rotation[2]
    across = np.cross(axis, scene.up)
    if np.linalg.norm(across) < _NOISE:  # straight down
        across = pose.rotation[0]
    across /= np.linalg.norm(across)
    ahead = np.cross(scene.up, across)
    east, up = _angles(places - pose.position, scene.up, across, ahead)
    edges = _BIN * (np.arange(-_BINS, _BINS + 2) - 0.5)
    for roll in _ROLLS:
        turned = so3.exp(roll * axis)
        mine = _angles(rays @ pose.rotation @ turned.T, scene.up, across, ahead)
        right = (east[:, None, :] - mine[0][:, :, None] + np.pi) % (2.0 * np.pi) - np.pi
        above = up[:, None, :] - mine[1][:, :, None]
        both = np.isfinite(right) & np.isfinite(above)
        counts = np.pad(np.histogram2d(right[both], above[both], bins=[edges, edges])[0], 1)
        counts = np.lib.stride_tricks.sliding_window_view(counts, (3, 3)).sum(axis=(2, 3))
        i, j = np.unravel_index(int(np.argmax(counts)), counts.shape)
        world = so3.exp((i - _BINS) * _BIN * scene.up) @ so3.exp((j - _BINS) * _BIN * across) @ turned
        found.append((float(counts[i, j]), Pose(pose.rotation @ world.T, pose.position)))
    found.sort(key=lambda one: -one[0])
    return [pose for _, pose in found[:_STARTS]]


def _angles(directions: Floats, up: Floats, across: Floats, ahead: Floats) -> tuple[Floats, Floats]:
    """About the vertical and above the horizontal [rad], of directions (…, 3) in the world."""
    level = np.hypot(directions @ across, directions @ ahead)
    return np.arctan2(directions @ ahead, directions @ across), np.arctan2(directions @ up, level)


def _fitted(scene: _Scene, name: str, start: Pose, move: float) -> Pose | None:
    """The pose from which a camera's rays point at the nearest people of others; None where few do. move: std."""
    rays, places = scene.bearings(name)
    seen = np.isfinite(rays[:, :, 0])
    mine, candidates = rays[seen], places[np.nonzero(seen)[0]]
    pose, row, prior = start, np.arange(len(mine)), np.diag([1e-12] * 3 + [(_NOISE / move) ** 2] * 3)
    for number in range(_ROUNDS if candidates.size else 0):
        there = (candidates - pose.position) @ pose.rotation.T
        away = np.linalg.norm(there, axis=2)
        off = _apart(there / away[..., None], mine[:, None])
        off[~np.isfinite(off)] = np.inf
        nearest = off.argmin(axis=1)
        least, limit = off[row, nearest], 0.5 * scene.within / np.nan_to_num(away[row, nearest], nan=np.inf)
        limit = np.maximum(limit, _GATE * _NARROWER**number)
        use: Bools = least < limit
        if use.sum() < MIN_LOOKED_AT // 2:
            return None
        distance = away[row, nearest][use]
        unit = there[row, nearest][use] / distance[:, None]
        across = (unit[:, :, None] * unit[:, None, :] - np.eye(3)) / distance[:, None, None]
        jacobian = np.concatenate([-so3.hat(unit), across @ pose.rotation], axis=2)
        weighted = jacobian * (1.0 - (least[use] / limit[use]) ** 2)[:, None, None]
        normal = np.einsum("kij,kil->jl", weighted, jacobian) + prior
        pull = np.einsum("kij,ki->j", weighted, mine[use] - unit)
        pull[3:] -= prior[3:, 3:] @ (pose.position - start.position)
        free = 3 if number < _TURN_ROUNDS else 6
        change = np.append(np.linalg.solve(normal[:free, :free], pull[:free]), np.zeros(6 - free))
        pose = Pose(so3.exp(change[:3]) @ pose.rotation, pose.position + change[3:])
    return pose


def _apart(a: Floats, b: Floats) -> Floats:
    """Distances between ends of unit vectors: of small angles, these [rad]."""
    off = a - b
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", off, off)))
