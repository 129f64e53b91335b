"""Outlier test of control points: a camera moved since it was surveyed, or a wrong entry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import chdtri, fdtri

from hub.bundle.datum.gauge import (
    CONTRADICTION_SIGMA,
    control_point_residuals,
    control_points_of,
    fit_to_control_points,
    is_overdetermined,
)
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

ControlItem = str | tuple[str, str, float]
"""A camera (its position and attitude), or a distance between two cameras."""
_MIN_REDUNDANCY = 2
"""Redundancy beyond the seven gauge freedoms that the remaining control points need for a meaningful test."""
_GAUGE_FREEDOM = 7  # three of shift, three of rotation, one of scale
_FALSE_ALARM_PROBABILITY = 1e-4
"""Probability that a control point of a correct survey is rejected."""
_MIN_SCATTER_RATIO = 3.0
"""Factor by which the scatter of the second-best outlier set must be larger."""
_MAX_OUTLIERS = 2
"""Most control points rejected together; with more outliers among few points they cannot be identified."""
_REFUTED_PROBABILITY = 1e-3
"""Probability that a reference of a correct survey is refuted: what its own error leaves of five stds is about four."""
_DOUBTED_PROBABILITY = 1e-2
"""Probability that one is named and kept. An error of five stds, its own or those of its prediction by the network and
the other references, is named in 0.52 to 0.86 of surveys with 4 to 12 references, in 0.31 to 0.72 by the limit above
(noncentral chi-squared distribution)."""
_ALIKE_SHARE = 0.8
"""Share of the largest chi-squared from which another camera's error explains the contradiction alike."""
_ALIKE_FACTOR = 100.0
"""Likelihood ratio of two explanations up to which they are alike. Of 8-sigma errors on four cameras the share alone
named a wrong camera in one case of six, at a ratio of 80."""
_EXHAUSTIVE_LIMIT = 10
"""Control points up to which all pairs are tried; with more, the search is greedy: the worst, then the next worst."""


def reject_outliers(rig: Rig, names: list[str], poses: list[Pose]) -> tuple[Rig, tuple[str, ...]]:
    """The rig without the outliers that `find_outliers` finds, and a description of each."""
    found = find_outliers(rig, names, poses)
    return (_without(rig, tuple(found)), tuple(found.values())) if found else (rig, ())


def find_outliers(rig: Rig, names: list[str], poses: list[Pose]) -> dict[ControlItem, str]:
    """Control points of the rig that are inconsistent with all the others, with a description of each.

    names, poses: the solved cameras, in any world and unit. An outlier that cannot be identified uniquely is kept, for
    the caller to refuse or report.
    """
    control = control_points_of(rig, names)
    if not control.fixes_scale:
        return {}
    _, residual = fit_to_control_points(rig, names, poses)
    if float(np.abs(residual).max(initial=0.0)) <= CONTRADICTION_SIGMA:
        return {}
    control_items, first = list(_control_items(rig, names)), list[ControlItem]()
    for count in range(1, _MAX_OUTLIERS + 1):
        fixed = first if len(control_items) > _EXHAUSTIVE_LIMIT else []
        sets = [
            (*fixed, *more) for more in combinations([i for i in control_items if i not in fixed], count - len(fixed))
        ]
        tried = []
        for left_out in sets:
            remaining = _without(rig, left_out)
            if _is_redundant(remaining, names):
                world, residual = fit_to_control_points(remaining, names, poses)
                redundancy = max(len(residual) - _GAUGE_FREEDOM, 1)
                tried.append((max(float(np.sqrt((residual**2).sum() / redundancy)), 1.0), left_out, world, redundancy))
        if not tried:
            return {}
        tried.sort(key=lambda item: item[0])
        scatter, left_out, world, redundancy = tried[0]
        outliers = all(
            _is_outlier(rig, names, poses, item, world, scatter, redundancy, len(control_items)) for item in left_out
        )
        if outliers and len(tried) > 1 and tried[1][0] > _MIN_SCATTER_RATIO * scatter:
            return {item: _describe(rig, names, poses, item, world) for item in left_out}
        first = list(left_out)
    return {}


def _control_items(rig: Rig, names: list[str]) -> Iterator[ControlItem]:
    for name in names:
        if rig.cameras[name].position is not None or rig.cameras[name].rotation is not None:
            yield name
    yield from (distance for distance in rig.distances if distance[0] in names and distance[1] in names)


def _without(rig: Rig, control_items: tuple[ControlItem, ...]) -> Rig:
    cleared = {
        name: replace(rig.cameras[name], position=None, rotation=None)
        for name in control_items
        if isinstance(name, str)
    }
    return replace(
        rig, cameras=rig.cameras | cleared, distances=tuple(d for d in rig.distances if d not in control_items)
    )


def _is_redundant(rig: Rig, names: list[str]) -> bool:
    control = control_points_of(rig, names)
    count = 3 * len(control.positions) + 3 * len(control.rotations) + len(control.distances)
    fixes_pose = bool(control.rotations and control.positions) or len(control.positions) >= 3
    if not fixes_pose:  # distances alone determine only the scale
        return control.fixes_scale and not control.positions and not control.rotations and len(control.distances) >= 3
    return control.fixes_scale and count >= _GAUGE_FREEDOM + _MIN_REDUNDANCY


def _is_outlier(
    rig: Rig,
    names: list[str],
    poses: list[Pose],
    item: ControlItem,
    world: Similarity,
    scatter: float,
    redundancy: int,
    count: int,
) -> bool:
    """F-test: whether a control point deviates from the fit to the others by more than their scatter explains.

    Where stds are given and consistent with the scatter, the denominator has (nearly) infinite degrees of freedom.
    """
    others = {n: c if n == item else replace(c, position=None, rotation=None) for n, c in rig.cameras.items()}
    only = replace(rig, up=None, cameras=others, distances=() if isinstance(item, str) else (item,))
    residual_vector = control_point_residuals(only, names, poses)(world)
    has_stds = all(c.position_std is not None or c.position is None for c in rig.cameras.values()) and scatter < 2.0
    limit = float(fdtri(len(residual_vector), 1e6 if has_stds else redundancy, 1.0 - _FALSE_ALARM_PROBABILITY / count))
    return bool((residual_vector**2).mean() > max(limit, CONTRADICTION_SIGMA**2 / len(residual_vector)) * scatter**2)


def _describe(rig: Rig, names: list[str], poses: list[Pose], item: ControlItem, world: Similarity) -> str:
    if not isinstance(item, str):
        a, b, length = item
        far = world.scale * float(np.linalg.norm(poses[names.index(a)].position - poses[names.index(b)].position))
        return (
            f"the distance {a}–{b} was rejected as an outlier: {length:g} given, {far:.4g} by the other control points"
        )
    camera, pose = rig.cameras[item], world.pose(poses[names.index(item)])
    errors = []
    if camera.position is not None:
        errors.append(f"{float(np.linalg.norm(pose.position - camera.position)):.3g} {rig.units} off")
    if camera.rotation is not None:
        errors.append(f"rotated by {np.degrees(so3.angle_between(pose.rotation, camera.rotation)):.2g}°")
    return (
        f"the control point of {item} was rejected as an outlier: {' and '.join(errors)} "
        "relative to the others; was the camera moved?"
    )


def reject_refuted(rig: Rig, names: list[str], poses: list[Pose], network: Floats) -> tuple[Rig, tuple[str, ...]]:
    """The rig without references (positions and attitudes of a camera) that the network refutes, and their names.

    poses: of the solved cameras in any world and unit. network: (6 n, 6 n) covariance of their poses there, by
    the observations alone. Data snooping (Baarda): the error of one camera's reference is freed at a time; its
    chi-squared has the stds of the references and of the network in it. Where the errors of two cameras explain the
    contradiction alike, neither is rejected, and both are named. References without std are named and kept.
    """
    control = control_points_of(rig, names)
    if not control.fixes_scale or not is_overdetermined(replace(rig, distances=()), names, poses):
        return rig, ()
    found, _ = fit_to_control_points(rig, names, poses)
    published = [found.pose(pose) for pose in poses]
    residual, jacobian, design, variance, owner = [], [], [], [], []
    floor = 1e-6 * max(float(np.linalg.norm(np.ptp([pose.position for pose in published], axis=0))), 1e-9)
    for i, name in enumerate(names):
        camera, base = rig.cameras[name], 6 * i
        for known, std, first in ((camera.position, camera.position_std, 3), (camera.rotation, camera.rotation_std, 0)):
            if known is None:
                continue
            block, freedom = np.zeros((3, len(network))), np.zeros((3, 7))
            if first:
                block[:, base + 3 : base + 6] = found.scale * found.rotation
                place = published[i].position
                freedom = np.column_stack([np.eye(3), -so3.hat(place), place])
                off = place - known
            else:
                block[:, base : base + 3] = np.eye(3)
                freedom[:, 3:6] = -published[i].rotation
                off = so3.log(published[i].rotation @ known.T)
            residual.append(off)
            jacobian.append(block)
            design.append(freedom)
            variance.append(np.maximum(np.zeros(3) if std is None else std, floor if first else 1e-6) ** 2)
            owner += [i] * 3
    rows = np.concatenate(jacobian)
    weight = np.linalg.inv(rows @ network @ rows.T + np.diag(np.concatenate(variance)))
    offs, freedoms, cameras = np.concatenate(residual), np.concatenate(design), np.array(owner)
    warnings: list[str] = []
    rejected: list[str] = []
    while True:
        reduced = weight - weight @ freedoms @ np.linalg.pinv(freedoms.T @ weight @ freedoms) @ freedoms.T @ weight
        pull = reduced @ offs
        tests = {}
        for i in np.unique(cameras):
            mine = np.flatnonzero(cameras == i)
            own = reduced[np.ix_(mine, mine)]
            inner = np.linalg.pinv(own, rcond=1e-9)
            dimensions = int(np.linalg.matrix_rank(own, tol=1e-9 * float(np.abs(reduced).max())))
            if dimensions:
                tests[int(i)] = float(pull[mine] @ inner @ pull[mine]), dimensions, inner @ pull[mine]
        limits = {i: float(chdtri(one[1], _DOUBTED_PROBABILITY / len(tests))) for i, one in tests.items()}
        over = sorted((i for i in tests if tests[i][0] > limits[i]), key=lambda i: -tests[i][0])
        if not over:
            break
        worst = over[0]
        decided = min(_ALIKE_SHARE * tests[worst][0], tests[worst][0] - 2.0 * np.log(_ALIKE_FACTOR))
        alike = [names[i] for i in over if tests[i][0] > decided]
        if len(alike) > 1:
            warnings.append(
                f"the reference of one of {', '.join(alike)} is wrong, and which one cannot be decided "
                f"(chi-squared {tests[worst][0]:.0f}, limit {limits[worst]:.0f}): the result follows it"
            )
            break
        given = rig.cameras[names[worst]]
        doubted = tests[worst][0] < float(chdtri(tests[worst][1], _REFUTED_PROBABILITY / len(tests)))
        keep = doubted or (given.position_std is None and given.rotation_std is None)
        amount = float(np.linalg.norm(tests[worst][2][:3]))
        unit = rig.units if given.position is not None else "rad"
        fate = "kept" if keep else "rejected as an outlier"
        warnings.append(
            f"the control point of {names[worst]} was {fate}: the observations and the other references put it "
            f"{amount:.3g} {unit} off (chi-squared {tests[worst][0]:.0f}, limit {limits[worst]:.0f})"
        )
        rejected += [] if keep else [names[worst]]
        if doubted:
            break
        freedoms = np.concatenate([freedoms, np.eye(len(cameras))[:, cameras == worst]], axis=1)
    return _without(rig, tuple(rejected)) if rejected else rig, tuple(warnings)
