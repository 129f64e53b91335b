"""Adjustment with control points: redundant surveyed positions and attitudes as measurements with their stds."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded

from hub.bundle.adjustment import apply_step
from hub.bundle.bordered_system import eliminate
from hub.bundle.covariance import gauge_constraints
from hub.bundle.datum.gauge import ControlPointTerms, control_point_terms
from hub.bundle.gls import solve_gls
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import AdjustmentState, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

_MAX_ITERATIONS = 8
_RELATIVE_TOLERANCE = 1e-9  # relative decrease of the cost at convergence


def adjust_to_control_points(
    rig: Rig, names: list[str], problem: Problem, state: AdjustmentState, prior: SmoothnessPrior
) -> AdjustmentState:
    """The state in the rig's world that fits observations and control points, each weighted by its std.

    state: the optimum of the observations alone, transformed into the rig's world. Gauss-Newton with step halving;
    gauge directions that the control points leave free are fixed. With `AdjustmentState.correlated_noise`, generalised
    least squares.
    """
    if state.correlated_noise is not None:
        try:
            return solve_gls(problem, state, prior, state.correlated_noise, lambda at: _terms(rig, names, at)).state
        except np.linalg.LinAlgError:
            return state
    terms = _terms(rig, names, state)
    system, seen = build_system(problem, state, prior, robust=False)
    columns = problem.free_columns()
    for _ in range(_MAX_ITERATIONS):
        parts = eliminate(system)
        path = np.asarray(cho_solve_banded((parts.factor, False), system.gradient_path, check_finite=False))
        rhs = -(system.gradient_cameras - system.border.T @ path + terms.gradient[columns])
        step = _step(parts.reduced, terms, columns, rhs, state)
        shrink, better = 1.0, False
        while shrink > 1e-3 and not better:
            trial = apply_step(problem, state, shrink * (-path - parts.a_inv_b @ step), shrink * step)
            trial_terms = _terms(rig, names, trial)
            trial_system, trial_seen = build_system(problem, trial, prior, robust=False)
            better = trial_seen + trial_terms.cost < seen + terms.cost
            shrink *= 0.5
        if not better:
            break
        gain = seen + terms.cost - trial_seen - trial_terms.cost
        state, terms, system, seen = trial, trial_terms, trial_system, trial_seen
        if gain < _RELATIVE_TOLERANCE * (seen + terms.cost):
            break
    return state


def _terms(rig: Rig, names: list[str], state: AdjustmentState) -> ControlPointTerms:
    return control_point_terms(rig, names, [camera.pose for camera in state.cameras])


def _step(
    reduced: Floats,
    terms: ControlPointTerms,
    columns: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    rhs: Floats,
    state: AdjustmentState,
) -> Floats:
    matrix = reduced + terms.information[np.ix_(columns, columns)]
    constraints = gauge_constraints([camera.pose for camera in state.cameras], terms.information)[:, columns]
    if not len(constraints):
        return np.asarray(np.linalg.solve(matrix, rhs))
    tangent = np.linalg.svd(constraints)[2][len(constraints) :].T
    return np.asarray(tangent @ np.linalg.solve(tangent.T @ matrix @ tangent, tangent.T @ rhs))
