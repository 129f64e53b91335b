"""Which of the rig's references the others contradict: a camera bumped since it was surveyed, a slip of the pen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import fdtri

from hub.datum.gauge import FAR, fit_world, reference_residuals, told_of
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.session.rig import Rig

Item = str | tuple[str, str, float]
"""A camera with its position and attitude, or a distance."""
_SPARE = 2
"""Numbers beyond the gauge's seven that the remaining references must tell, so that their agreeing means something."""
_GAUGE_FREEDOM = 7
_BY_CHANCE = 1e-4
"""Chance that one of a right survey's references is set aside."""
_NEXT = 3.0
"""Times that the next best explanation must fit worse."""
_MOST = 2
"""References that are set aside together at the most; more than that among few leaves nobody to tell."""
_FEW = 10
"""References up to which two at a time are tried in all combinations; of more, the worst and then the next worst."""


def trusted(rig: Rig, names: list[str], poses: list[Pose]) -> tuple[Rig, tuple[str, ...]]:
    """The rig without what `contradicted` finds, and what went, in words."""
    found = contradicted(rig, names, poses)
    return (_without(rig, tuple(found)), tuple(found.values())) if found else (rig, ())


def contradicted(rig: Rig, names: list[str], poses: list[Pose]) -> dict[Item, str]:
    """References of the rig that all the others agree against, and how, in words.

    names, poses: the solved cameras, in any world and unit. A reference that cannot be told from the others stays,
    for the caller to refuse or to tell.
    """
    told = told_of(rig, names)
    if not told.metric:
        return {}
    _, residual = fit_world(rig, names, poses)
    if float(np.abs(residual).max(initial=0.0)) <= FAR:
        return {}
    items, first = list(_references(rig, names)), list[Item]()
    for count in range(1, _MOST + 1):
        fixed = first if len(items) > _FEW else []
        sets = [(*fixed, *more) for more in combinations([i for i in items if i not in fixed], count - len(fixed))]
        tried = []
        for left_out in sets:
            rest = _without(rig, left_out)
            if _redundant(rest, names):
                world, left = fit_world(rest, names, poses)
                spare = max(len(left) - _GAUGE_FREEDOM, 1)
                tried.append((max(float(np.sqrt((left**2).sum() / spare)), 1.0), left_out, world, spare))
        if not tried:
            return {}
        tried.sort(key=lambda item: item[0])
        scatter, left_out, world, spare = tried[0]
        outside = all(_outside(rig, names, poses, item, world, scatter, spare, len(items)) for item in left_out)
        if outside and len(tried) > 1 and tried[1][0] > _NEXT * scatter:
            return {item: _words(rig, names, poses, item, world) for item in left_out}
        first = list(left_out)
    return {}


def _references(rig: Rig, names: list[str]) -> Iterator[Item]:
    for name in names:
        if rig.cameras[name].position is not None or rig.cameras[name].rotation is not None:
            yield name
    yield from (distance for distance in rig.distances if distance[0] in names and distance[1] in names)


def _without(rig: Rig, items: tuple[Item, ...]) -> Rig:
    bare = {name: replace(rig.cameras[name], position=None, rotation=None) for name in items if isinstance(name, str)}
    return replace(rig, cameras=rig.cameras | bare, distances=tuple(d for d in rig.distances if d not in items))


def _redundant(rig: Rig, names: list[str]) -> bool:
    told = told_of(rig, names)
    count = 3 * len(told.positions) + 3 * len(told.rotations) + len(told.distances)
    placed = bool(told.rotations and told.positions) or len(told.positions) >= 3
    if not placed:  # distances alone tell nothing but the scale
        return told.metric and not told.positions and not told.rotations and len(told.distances) >= 3
    return told.metric and count >= _GAUGE_FREEDOM + _SPARE


def _outside(
    rig: Rig, names: list[str], poses: list[Pose], item: Item, world: Similarity, scatter: float, spare: int, count: int
) -> bool:
    """Whether a reference lies further from where the others have it than their scatter can explain: an F-test.

    Where stds are told, and hold, they tell the scatter better than a few references do.
    """
    others = {n: c if n == item else replace(c, position=None, rotation=None) for n, c in rig.cameras.items()}
    only = replace(rig, up=None, cameras=others, distances=() if isinstance(item, str) else (item,))
    off = reference_residuals(only, names, poses)(world)
    sure = all(c.position_std is not None or c.position is None for c in rig.cameras.values()) and scatter < 2.0
    limit = float(fdtri(len(off), 1e6 if sure else spare, 1.0 - _BY_CHANCE / count))
    return bool((off**2).mean() > max(limit, FAR**2 / len(off)) * scatter**2)


def _words(rig: Rig, names: list[str], poses: list[Pose], item: Item, world: Similarity) -> str:
    if not isinstance(item, str):
        a, b, length = item
        far = world.scale * float(np.linalg.norm(poses[names.index(a)].position - poses[names.index(b)].position))
        return f"the distance {a}–{b} was set aside: {length:g} given, {far:.4g} by all the other references"
    camera, pose = rig.cameras[item], world.pose(poses[names.index(item)])
    told = []
    if camera.position is not None:
        told.append(f"{float(np.linalg.norm(pose.position - camera.position)):.3g} {rig.units} off")
    if camera.rotation is not None:
        told.append(f"turned by {np.degrees(so3.angle_between(pose.rotation, camera.rotation)):.2g}°")
    return f"the reference of {item} was set aside: {' and '.join(told)} against all the others; was it bumped?"
