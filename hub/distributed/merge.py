"""One calibration from those of a site's hubs, whose groups of cameras overlap: submap joining.

Of each part the world is free by a similarity and the reference clock by an offset and a rate; what ties them are the
cameras at the borders, which two parts have. All similarities are adjusted at once (Gauss–Newton over generalised
Procrustes residuals, Gower 1975), so that circles of groups close, and so are all clocks. Errors of a part's cameras
count as independent of each other: their common part is what its similarity absorbs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from hub.bundle.datum.control_outliers import reject_outliers
from hub.bundle.datum.gauge import fix_gauge
from hub.bundle.datum.held_gauge import camera_markers, fit_robustly
from protocols.core.clocks import TimeMap
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.rig import Rig

_LEAST_SHARED = 3
"""Cameras that two parts must have in common: two centres leave the turn about their line to the cameras' axes."""
_ROUNDS = 6  # of Gauss-Newton, from a start that is right to the noise
_HUBER = 2.0
"""Residuals of so many times the median count less: a camera that one part has where it stood before it was moved."""
_HALF_SPAN_S = 15.0  # about a shared camera's lag time, where two parts' clocks are compared: a rate is time over that


def merge_calibrations(
    parts: Mapping[str, Calibration],
    groups: Mapping[str, Sequence[str]],
    rig: Rig,
    boots: Mapping[str, Mapping[str, str]] | None = None,
    last: Calibration | None = None,
    last_boots: Mapping[str, str] | None = None,
) -> Calibration:
    """The site's calibration from its hubs' ones, each camera's from the hub that has it in its group.

    groups: of cameras by hub; a camera that its own hub could not place comes from a neighbour. rig: control points and
    ``up`` of all cameras, which fix world and scale as for one hub. boots, last_boots: whose clock a map is on.
    last: the site's calibration before, whose clock is kept, its world where the rig fixes none, and its cameras that
    no part has now. Stds: those of a camera in its part, and of its part's similarity and clock, added up.
    Raises Refused where there is no part, and where no two cameras are in one world.
    """
    boots = boots or {}
    order = _connected(parts, set(last.cameras) if last else set())
    if not order:
        raise Refused("no hub has calibrated its cameras yet")
    chosen = [parts[hub] for hub in order]
    worlds, world_covariance = _join_worlds(chosen)
    clocks, clock_covariance = _join_clocks(chosen, [boots.get(hub, {}) for hub in order])
    own = {name: number for number, hub in reversed(list(enumerate(order))) for name in parts[hub].cameras}
    own |= {n: number for number, hub in enumerate(order) for n in groups.get(hub, ()) if n in parts[hub].cameras}
    cameras = {}
    for name in [*(name for name in rig.cameras if name in own), *sorted(set(own) - set(rig.cameras))]:
        number = own[name]
        block = slice(7 * number, 7 * number + 7), slice(2 * number, 2 * number + 2)
        cameras[name] = _in_site(
            chosen[number].cameras[name], worlds[number], world_covariance[block[0], block[0]], clocks[number],
            clock_covariance[block[1], block[1]],
        )  # fmt: skip
    of_part = {name: boots.get(order[number], {}).get(name, "") for name, number in own.items()}
    same_clock = [name for name, boot in of_part.items() if boot == (last_boots or {}).get(name, "")]
    if last is not None and (
        len(own.keys() & last.cameras.keys()) < _LEAST_SHARED or not last.cameras.keys() & same_clock
    ):
        last = None  # nothing ties it to the parts any more
    site = replace(
        chosen[0], cameras=cameras, reference=(last or chosen[0]).reference, solver="hubs", trajectories=(), pairs=(),
        residuals={}, convergence=(), acceptance={}, cpu_seconds=sum(part.cpu_seconds for part in chosen),
    )  # fmt: skip
    site = _on_clock_of(_in_world(site, rig, last), last, same_clock)
    refused = {name: why for part in parts.values() for name, why in part.refused.items() if name not in site.cameras}
    refused |= {
        name: "the hub that has it shares too few placed cameras with the others"
        for hub, part in parts.items()
        for name in part.cameras
        if hub not in order and name not in site.cameras
    }
    return replace(site, refused=refused)


def _connected(parts: Mapping[str, Calibration], known: set[str]) -> list[str]:
    """Hubs whose parts are in one world, the largest first, each after one that it shares most cameras with.

    known: cameras of the calibration before, in whose world the first one should be.
    """

    def rank(hub: str) -> tuple[bool, int, str]:
        cameras = set(parts[hub].cameras)
        return len(cameras & known) < min(_LEAST_SHARED, len(known)), -len(cameras), hub

    left = sorted((hub for hub in parts if len(parts[hub].cameras) > 1), key=rank)
    order, placed = left[:1], set(parts[left[0]].cameras) if left else set()
    while left := [hub for hub in left if hub not in order]:
        nearest = max(left, key=lambda hub: len(placed & set(parts[hub].cameras)))
        if len(placed & set(parts[nearest].cameras)) < _LEAST_SHARED:
            break
        order.append(nearest)
        placed |= set(parts[nearest].cameras)
    return order


def _join_worlds(parts: Sequence[Calibration]) -> tuple[list[Similarity], Floats]:
    """The similarity from each part's world into the first one's, and their joint covariance (7 n, 7 n).

    Of shift, turn (after the similarity) and logarithm of the scale.
    """
    found = [Similarity(1.0, np.eye(3), np.zeros(3))]
    placed = {name: camera.pose for name, camera in parts[0].cameras.items()}
    for part in parts[1:]:
        shared = [name for name in part.cameras if name in placed]
        one, other = (_markers([poses[name] for name in shared]) for poses in (_poses(part), placed))
        found.append(fit_robustly(one.reshape(-1, 3), other.reshape(-1, 3), np.ones(one.size // 3)))
        placed |= {name: found[-1].pose(pose) for name, pose in _poses(part).items() if name not in placed}
    both = [
        (a, b, shared)
        for a, b in combinations(range(len(parts)), 2)
        if len(shared := [name for name in parts[a].cameras if name in parts[b].cameras]) >= _LEAST_SHARED
    ]
    covariance = np.zeros((7 * len(parts), 7 * len(parts)))
    for _ in range(_ROUNDS if both else 0):
        rows, residuals, stds = [], [], []
        for a, b, shared in both:
            centres = {i: np.array([parts[i].cameras[name].pose.position for name in shared]) for i in (a, b)}
            ends = [found[i].points(places) for i, places in centres.items()]
            row = np.zeros((3 * len(shared), 7 * len(parts)))
            for i, sign, points in ((a, 1.0, ends[0]), (b, -1.0, ends[1])):
                row[:, 7 * i : 7 * i + 7] = sign * _motions(points)
            rows.append(row)
            residuals.append((ends[0] - ends[1]).ravel())
            spread = [found[i].scale * np.array([parts[i].cameras[n].position_std for n in shared]) for i in (a, b)]
            stds.append(np.repeat(np.sqrt(np.mean(spread[0] ** 2 + spread[1] ** 2)), row.shape[0]))
        step, free = _weighted_step(np.concatenate(rows), np.concatenate(residuals), np.concatenate(stds), 7)
        covariance[7:, 7:] = free
        found = [_moved(one, step[7 * i : 7 * i + 7]) for i, one in enumerate(found)]
    return found, covariance


def _join_clocks(
    parts: Sequence[Calibration], boots: Sequence[Mapping[str, str]]
) -> tuple[list[tuple[float, float, float]], Floats]:
    """For each part (rate, offset, centre) with ``t_first = rate (t_part - centre) + offset``, and their covariance.

    Of offset and rate, (2 n, 2 n).
    """
    centres = [float(np.median([_at(one) for one in part.cameras.values()])) for part in parts]
    rows, right, stds = [], [], []
    for a, b in combinations(range(len(parts)), 2):
        for name in parts[a].cameras:
            if name not in parts[b].cameras or boots[a].get(name, "") != boots[b].get(name, ""):
                continue
            one, other = parts[a].cameras[name], parts[b].cameras[name]
            for shift in (-_HALF_SPAN_S, _HALF_SPAN_S):
                time_a = _at(one, shift) - centres[a]
                time_b = one.lag_time + shift
                time_b = other.time_map.clock_rate * time_b + other.time_map.time_offset - centres[b]
                row = np.zeros(2 * len(parts))
                row[2 * a : 2 * a + 2], row[2 * b : 2 * b + 2] = (1.0, time_a), (-1.0, -time_b)
                rows.append(row)
                right.append(time_a - time_b)
                stds.append(np.hypot(one.time_offset_std, other.time_offset_std))
    covariance, found = np.zeros((2 * len(parts),) * 2), np.zeros(2 * len(parts))
    found[0] = centres[0]
    if rows:
        # Offsets about the first part's centre: epochs of clocks differ by years, what is estimated by milliseconds.
        step, covariance[2:, 2:] = _weighted_step(np.array(rows), np.array(right), np.array(stds), 2)
        found = step + np.tile([centres[0], 0.0], len(parts))
    return [(1.0 + found[2 * i + 1], found[2 * i], centre) for i, centre in enumerate(centres)], covariance


def _weighted_step(rows: Floats, residuals: Floats, stds: Floats, held: int) -> tuple[Floats, Floats]:
    """The step that makes ``residuals + rows @ step`` small, its first ``held`` entries 0, and the others' covariance.

    Weighted by stds and robustly (Huber); the variance factor of the residuals counts where it is above 1.
    """
    weight = 1.0 / np.where(stds > 0.0, stds, max(float(stds.max(initial=0.0)), 1e-9))
    design, step = rows[:, held:], np.zeros(rows.shape[1])
    robust, inverse = np.ones(len(weight)), np.zeros((design.shape[1],) * 2)
    for _ in range(4):
        scaled = weight * robust
        size = np.maximum(np.linalg.norm(scaled[:, None] * design, axis=0), 1e-300)
        inverse = np.linalg.pinv(scaled[:, None] * design / size, rcond=1e-10) / size[:, None]
        step[held:] = -inverse @ (scaled * residuals)
        left = np.abs(weight * (residuals + rows @ step))
        limit = _HUBER * 1.4826 * float(np.median(left)) + 1e-12
        robust = np.sqrt(np.minimum(1.0, limit / np.maximum(left, 1e-300)))
    factor = float((left * robust) @ (left * robust)) / max(len(left) - design.shape[1], 1)
    return step, max(factor, 1.0) * inverse @ inverse.T


def _in_site(
    camera: CameraCalibration, world: Similarity, covariance: Floats, clock: tuple[float, float, float], times: Floats
) -> CameraCalibration:
    """A camera of a part in the first part's world and on its clock."""
    rate, offset, centre = clock
    pose, own = world.pose(camera.pose), camera.time_map
    motion = _motions(pose.position[None])
    turned = world.scale**2 * (world.rotation**2 @ camera.position_std**2)
    at = np.array([1.0, _at(camera) - centre])
    time_map = TimeMap(rate * own.clock_rate, rate * (own.time_offset - centre) + offset)
    return replace(
        camera,
        pose=pose,
        time_map=time_map,
        position_std=np.sqrt(turned + np.einsum("ij,jk,ik->i", motion, covariance, motion)),
        time_offset_std=float(np.hypot(camera.time_offset_std, np.sqrt(max(at @ times @ at, 0.0)))),
        lag_std=float(np.hypot(camera.lag_std, np.sqrt(max(at @ times @ at, 0.0)))),
        clock_rate_std=float(np.hypot(camera.clock_rate_std, np.sqrt(max(times[1, 1], 0.0)))),
    )


def _in_world(site: Calibration, rig: Rig, last: Calibration | None) -> Calibration:
    """The site in its control points' world, or in the one before; with the cameras of that which no part has."""
    names = [name for name in site.cameras if name in rig.cameras]
    poses = [site.cameras[name].pose for name in names]
    if len(names) < 2:
        raise Refused("fewer than two cameras are in one world")
    rig, rejected = reject_outliers(rig, names, poses)
    gauge = fix_gauge(rig, names, poses)
    world, kept = gauge.similarity, {}
    if last is not None:
        known = [name for name in site.cameras if name in last.cameras]
        if gauge.scale == "arbitrary":
            one, other = (_markers([of.cameras[name].pose for name in known]).reshape(-1, 3) for of in (site, last))
            world = fit_robustly(one, other, np.ones(len(one)))
        if gauge.scale == last.scale:
            kept = {name: camera for name, camera in last.cameras.items() if name not in site.cameras}
    cameras = {
        name: replace(
            camera,
            pose=world.pose(camera.pose),
            position_std=world.scale * np.sqrt(world.rotation**2 @ camera.position_std**2),
        )
        for name, camera in site.cameras.items()
    }
    warnings = tuple(dict.fromkeys((*site.warnings, *rejected, *gauge.warnings)))
    return replace(site, cameras=cameras | kept, scale=gauge.scale, units=rig.units, warnings=warnings)


def _on_clock_of(site: Calibration, last: Calibration | None, same_clock: Sequence[str]) -> Calibration:
    """The site on its reference camera's clock, or on that of the calibration before, by a camera that kept its own."""
    target, base = TimeMap(1.0, 0.0), site.reference if site.reference in site.cameras else next(iter(site.cameras))
    known = [] if last is None else [name for name in same_clock if name in last.cameras and name in site.cameras]
    if last is not None and known:
        base = site.reference if site.reference in known else min(known, key=lambda n: last.cameras[n].time_offset_std)
        target = last.cameras[base].time_map
    now = site.cameras[base].time_map
    rate = target.clock_rate / now.clock_rate
    cameras = {}
    for name, camera in site.cameras.items():
        old = camera.time_map
        moved = TimeMap(rate * old.clock_rate, rate * (old.time_offset - now.time_offset) + target.time_offset)
        is_kept = last is not None and camera is last.cameras.get(name)
        cameras[name] = camera if is_kept else replace(camera, time_map=moved)
    return replace(site, cameras=cameras, reference=base if last is None else site.reference)


def _poses(part: Calibration) -> dict[str, Pose]:
    return {name: camera.pose for name, camera in part.cameras.items()}


def _markers(poses: Sequence[Pose]) -> Floats:
    """Centres and points on the axes (n, 4, 3), as far off as the centres are from their mean."""
    centres = np.array([pose.position for pose in poses])
    reach = max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()), 1e-12)
    return np.array([camera_markers(pose, reach) for pose in poses])


def _at(camera: CameraCalibration, shift: float = 0.0) -> float:
    """Reference time of its part [s] at a camera's lag time."""
    return camera.time_map.clock_rate * (camera.lag_time + shift) + camera.time_map.time_offset


def _motions(points: Floats) -> Floats:
    """(3 n, 7) of points (n, 3) by a small shift, turn and scaling of their world."""
    turns = -np.array([so3.hat(point) for point in points])
    return np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), turns, points[:, :, None]], axis=2).reshape(-1, 7)


def _moved(world: Similarity, step: Floats) -> Similarity:
    turn, size = so3.exp(step[3:6]), float(np.exp(step[6]))
    return Similarity(size * world.scale, turn @ world.rotation, size * turn @ world.shift + step[:3])
