"""References beyond the gauge as measurements: positions and attitudes with their stds, in the adjustment."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded

from hub.bundle.adjustment import moved
from hub.bundle.bordered_system import eliminate
from hub.bundle.covariance import held_rows
from hub.bundle.gls import fit
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import Problem, State
from hub.datum.gauge import ReferenceTerms, reference_terms
from hub.trajectory.smoothness_prior import MotionPrior
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

_STEPS = 8
_DONE = 1e-9  # gain as a share of the cost


def adjust_to_references(rig: Rig, names: list[str], problem: Problem, state: State, prior: MotionPrior) -> State:
    """The state in the rig's world that fits both what was seen and the references, each by its std.

    state: the optimum of what was seen, moved into the rig's world. Gauss-Newton with step halving; the gauge
    directions that the references leave open stay where they are. Where errors last, rows go by `State.coloured`.
    """
    if state.coloured is not None:
        try:
            return fit(problem, state, prior, state.coloured, lambda at: _terms(rig, names, at)).state
        except np.linalg.LinAlgError:
            return state
    terms = _terms(rig, names, state)
    system, seen = build_system(problem, state, prior, robust=False)
    columns = problem.free_columns()
    for _ in range(_STEPS):
        parts = eliminate(system)
        path = np.asarray(cho_solve_banded((parts.factor, False), system.gradient_path, check_finite=False))
        right = -(system.gradient_cameras - system.border.T @ path + terms.gradient[columns])
        step = _step(parts.reduced, terms, columns, right, state)
        shrink, better = 1.0, False
        while shrink > 1e-3 and not better:
            trial = moved(problem, state, shrink * (-path - parts.carried @ step), shrink * step)
            trial_terms = _terms(rig, names, trial)
            trial_system, trial_seen = build_system(problem, trial, prior, robust=False)
            better = trial_seen + trial_terms.cost < seen + terms.cost
            shrink *= 0.5
        if not better:
            break
        gain = seen + terms.cost - trial_seen - trial_terms.cost
        state, terms, system, seen = trial, trial_terms, trial_system, trial_seen
        if gain < _DONE * (seen + terms.cost):
            break
    return state


def _terms(rig: Rig, names: list[str], state: State) -> ReferenceTerms:
    return reference_terms(rig, names, [camera.pose for camera in state.cameras])


def _step(
    reduced: Floats,
    terms: ReferenceTerms,
    columns: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    right: Floats,
    state: State,
) -> Floats:
    matrix = reduced + terms.information[np.ix_(columns, columns)]
    held = held_rows([camera.pose for camera in state.cameras], terms.information)[:, columns]
    if not len(held):
        return np.asarray(np.linalg.solve(matrix, right))
    tangent = np.linalg.svd(held)[2][len(held) :].T
    return np.asarray(tangent @ np.linalg.solve(tangent.T @ matrix @ tangent, tangent.T @ right))
