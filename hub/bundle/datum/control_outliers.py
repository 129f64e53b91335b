"""Outlier test of control points: a camera moved since it was surveyed, or a wrong entry.

And the adjustment with control points: redundant surveyed positions and attitudes, with stds or exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import chdtri, fdtri

from hub.bundle.adjustment import apply_step
from hub.bundle.bordered_system import eliminate
from hub.bundle.covariance import constrained_step, gauge_constraints
from hub.bundle.datum.gauge import (
    CONTRADICTION_SIGMA,
    ControlPointTerms,
    control_point_residuals,
    control_point_terms,
    control_points_of,
    exact_constraints,
    fit_to_control_points,
    is_overdetermined,
    with_exact_poses,
)
from hub.bundle.gls import solve_gls
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import AdjustmentState, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from hub.trajectory.splines import cho_solve_banded
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

_MAX_ITERATIONS = 8  # of Gauss-Newton, which begins at the observations' optimum
_RELATIVE_TOLERANCE = 1e-9  # relative decrease of the cost at convergence


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


def adjust_to_control_points(
    rig: Rig, names: list[str], problem: Problem, state: AdjustmentState, prior: SmoothnessPrior
) -> AdjustmentState:
    """The state in the rig's world that fits observations and control points.

    Control points with a std are observations of that weight; those without are constraints and hold exactly. state:
    the optimum of the observations alone, transformed into the rig's world. Gauss-Newton with step halving; gauge
    directions that the control points leave free are fixed. With `AdjustmentState.correlated_noise`, generalised least
    squares.
    """

    def terms(at: AdjustmentState) -> ControlPointTerms:
        return control_point_terms(rig, names, [camera.pose for camera in at.cameras], exact=False)

    def constraints(at: AdjustmentState) -> tuple[Floats, Floats]:
        return control_constraints(rig, names, [camera.pose for camera in at.cameras])

    if state.correlated_noise is not None:
        try:
            found = solve_gls(problem, state, prior, state.correlated_noise, terms, constraints).state
            return with_exact_poses(rig, names, found)
        except np.linalg.LinAlgError:
            pass  # the noise model does not suit these rows: independent noise does
    columns = problem.free_columns
    system, seen = build_system(problem, state, prior, robust=False)
    now = terms(state)
    for _ in range(_MAX_ITERATIONS):
        parts = eliminate(system)
        path = cho_solve_banded(parts.factor, system.gradient_path)
        gradient = system.gradient_cameras - system.border.transposed_times(path) + now.gradient[columns]
        rows, values = constraints(state)
        normal = parts.reduced + now.information.restricted(columns)
        step, _ = constrained_step(normal, -gradient, rows[:, columns], values)
        # A state off the constraints has to move onto them, whatever that costs.
        must = bool(np.abs(values).max(initial=0.0) > 1e-9 * _size(state))
        shrink, better = 1.0, False
        while shrink > 1e-3 and not better:
            trial = apply_step(problem, state, shrink * (-path - parts.a_inv_b @ step), shrink * step)
            trial_terms = terms(trial)
            trial_system, trial_seen = build_system(problem, trial, prior, robust=False)
            better = must or trial_seen + trial_terms.cost < seen + now.cost
            shrink *= 0.5
        if not better:
            break
        gain = seen + now.cost - trial_seen - trial_terms.cost
        state, now, system, seen = trial, trial_terms, trial_system, trial_seen
        if not must and gain < _RELATIVE_TOLERANCE * (seen + now.cost):
            break
    return with_exact_poses(rig, names, state)


def control_constraints(rig: Rig, names: list[str], poses: list[Pose]) -> tuple[Floats, Floats]:
    """Constraints of the step, rows (q, 18 n) and values (q,): exact control points, and what no control point fixes.

    rows @ step = -values.
    """
    rows, values = exact_constraints(rig, names, poses)
    gauge = gauge_constraints(poses, control_point_terms(rig, names, poses).information)
    return np.concatenate([rows, gauge]), np.concatenate([values, np.zeros(len(gauge))])


def _size(state: AdjustmentState) -> float:
    centres = np.array([camera.pose.position for camera in state.cameras])
    return max(float(np.linalg.norm(np.ptp(centres, axis=0))), 1e-9)
