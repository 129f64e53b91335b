"""Observability test for rolling-shutter readouts: the adjustment frees them only where it passes.

A slightly wrong lens has nearly the same effect as a rolling shutter, and its errors are correlated from frame to
frame. So the gain of freeing the readouts is computed with noise scaled to the effective sample size (`noise_scale`).
On recordings whose lenses err by a pixel no gain remains, while readouts freed by plain least squares come out at -40
and +35 ms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle.adjustment import gauge_tangent
from hub.bundle.bordered_system import cho_solve_path, eliminate
from hub.bundle.noise_scale import correlation_inflation
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, READOUT, AdjustmentState, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from protocols.geometry.types import Bools, Floats
from protocols.session.rig import MAX_READOUT_S


def with_free_readouts(problem: Problem) -> Problem:
    """The problem with all readouts free that were not given."""
    return replace(problem, free_parameters=replace(problem.free_parameters, readout=True))


def are_readouts_observable(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> bool:
    """Whether free readouts lower the Bayesian information criterion, predicted by one step from the solution.

    state: adjusted with fixed readouts.
    """
    freed_problem = with_free_readouts(problem)
    columns = freed_problem.free_columns()
    readout_columns = columns % CAMERA_PARAMETERS == READOUT
    if not readout_columns.any():
        return False
    rows = sum(int(part.use.sum()) for part in problem.rows)
    bic_penalty = float(np.count_nonzero(readout_columns) * np.log(max(rows, 2)))
    # Scaling by the effective sample size only lowers the gain, and usually there is none: test the cheap bound first.
    if _cost_reduction(freed_problem, state, prior, readout_columns) < bic_penalty:
        return False
    inflation = np.array([correlation_inflation(problem, state, camera) for camera in range(len(state.cameras))])
    return (
        _cost_reduction(freed_problem, replace(state, sigma=state.sigma * np.sqrt(inflation)), prior, readout_columns)
        > bic_penalty
    )


def are_readouts_plausible(state: AdjustmentState) -> bool:
    """Whether all readouts are within the range of real cameras."""
    return all(abs(camera.readout) < MAX_READOUT_S for camera in state.cameras)


def _cost_reduction(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, readout_columns: Bools) -> float:
    """Predicted decrease of the cost in one step when the columns ``readout_columns`` (p,) are freed too."""
    system, _ = build_system(problem, state, prior, robust=False)
    parts = eliminate(system)
    gradient = system.gradient_cameras - system.border.T @ cho_solve_path(parts, system.gradient_path)
    tangent = gauge_tangent(problem, state)
    directions: Floats = np.eye(len(gradient)) if tangent is None else tangent
    # The gauge fixes poses only, so directions without readouts are those with zero readout components.
    projected = directions - np.eye(len(gradient))[:, readout_columns] @ directions[readout_columns]
    basis = np.linalg.svd(projected, full_matrices=False)
    readout_free = basis[0][:, basis[1] > 1e-9]
    return _predicted_reduction(parts.reduced, gradient, directions) - _predicted_reduction(
        parts.reduced, gradient, readout_free
    )


def _predicted_reduction(normal: Floats, gradient: Floats, directions: Floats) -> float:
    projected_gradient = directions.T @ gradient
    return float(projected_gradient @ np.linalg.solve(directions.T @ normal @ directions, projected_gradient))
