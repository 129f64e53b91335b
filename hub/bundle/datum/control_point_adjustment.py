"""Adjustment with control points: redundant surveyed positions and attitudes, with stds or exact."""

from __future__ import annotations

import numpy as np

from hub.bundle.adjustment import apply_step
from hub.bundle.bordered_system import eliminate
from hub.bundle.covariance import constrained_step, gauge_constraints
from hub.bundle.datum.gauge import ControlPointTerms, control_point_terms, exact_constraints, with_exact_poses
from hub.bundle.gls import solve_gls
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import AdjustmentState, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from hub.trajectory.banded import cho_solve_banded
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

_MAX_ITERATIONS = 8  # of Gauss-Newton, which begins at the observations' optimum
_RELATIVE_TOLERANCE = 1e-9  # relative decrease of the cost at convergence


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
