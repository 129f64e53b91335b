"""Whether the path tells the cameras' rolling-shutter readouts: the adjustment frees them only then.

A lens that is a little wrong looks much like a rolling shutter, and its errors last from frame to frame. So the gain
of freeing the readouts is counted with as much noise as residuals that are alike leave of the rows (`poses/sigma.py`);
on recordings whose lenses err by a pixel nothing is left of it, where readouts freed by plain least squares come out at
-40 and +35 ms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle.adjustment import gauge_tangent
from hub.bundle.bordered_system import cho_solve_path, eliminate
from hub.bundle.noise_scale import together
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, READOUT, Problem, State
from hub.trajectory.smoothness_prior import MotionPrior
from protocols.geometry.types import Bools, Floats
from protocols.session.rig import LONGEST_READOUT


def freed(problem: Problem) -> Problem:
    """The problem with the readouts of all cameras free that nobody told."""
    return replace(problem, freedom=replace(problem.freedom, readout=True))


def worth_freeing(problem: Problem, state: State, prior: MotionPrior) -> bool:
    """Whether the readouts are worth their parameters (Bayesian information criterion), by one step from the solution.

    state: adjusted without them.
    """
    trial = freed(problem)
    columns = trial.free_columns()
    mine = columns % CAMERA_PARAMETERS == READOUT
    if not mine.any():
        return False
    rows = sum(int(part.use.sum()) for part in problem.rows)
    asked = float(np.count_nonzero(mine) * np.log(max(rows, 2)))
    # Counting rows that are alike as one makes the gain smaller: most often there is none to begin with.
    if _gain(trial, state, prior, mine) < asked:
        return False
    alike = np.array([together(problem, state, camera) for camera in range(len(state.cameras))])
    return _gain(trial, replace(state, sigma=state.sigma * np.sqrt(alike)), prior, mine) > asked


def plausible(state: State) -> bool:
    """Whether all readouts are such as cameras have."""
    return all(abs(camera.readout) < LONGEST_READOUT for camera in state.cameras)


def _gain(problem: Problem, state: State, prior: MotionPrior, mine: Bools) -> float:
    """By how much the cost falls in one step if the columns ``mine`` (p,) may move too."""
    system, _ = build_system(problem, state, prior, robust=False)
    parts = eliminate(system)
    gradient = system.gradient_cameras - system.border.T @ cho_solve_path(parts, system.gradient_path)
    tangent = gauge_tangent(problem, state)
    directions: Floats = np.eye(len(gradient)) if tangent is None else tangent
    # The gauge holds poses only, so that directions without readouts are those with no share in them.
    rest = directions - np.eye(len(gradient))[:, mine] @ directions[mine]
    basis = np.linalg.svd(rest, full_matrices=False)
    without = basis[0][:, basis[1] > 1e-9]
    return _fall(parts.reduced, gradient, directions) - _fall(parts.reduced, gradient, without)


def _fall(normal: Floats, gradient: Floats, directions: Floats) -> float:
    pull = directions.T @ gradient
    return float(pull @ np.linalg.solve(directions.T @ normal @ directions, pull))
