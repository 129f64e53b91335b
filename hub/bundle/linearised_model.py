"""The adjustment's model about an adjusted state, linearised: what freeing a few parameters more would gain.

The gain is that of one Gauss-Newton step from the solution in which they are fixed, with the paths and all other
parameters free to follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hub.bundle.adjustment import apply_step, gauge, minimise
from hub.bundle.block_matrix import ParameterCovariance
from hub.bundle.bordered_system import BorderedSystem, Elimination, border_block, eliminate
from hub.bundle.covariance import constrained_step
from hub.bundle.noise.correlated_noise import lens_tolerance
from hub.bundle.noise.noise_scale import correlation_inflation
from hub.bundle.normal_equations import assemble, build_system, weigh_residuals
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, ClockStep, Column, Problem
from hub.bundle.residuals import StackedTrajectories, evaluate_labels, jacobians
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.trajectory.splines import cho_solve_banded
from protocols.geometry.types import Floats, Ints

_STEP_SHARES = (1.0, 0.5)
"""Of a Gauss-Newton step, at which a refuted lens is tried."""
_MIN_TO_HOLD_A_PATH = 4  # cameras: three others determine a path without the one
_ROUNDING = 1e-10
"""Share of a step's information that is none, once paths and cameras have taken theirs: it was ±4e-16 of 1e25 / s²."""
_STEPS_ALONE, _FIRST_DAMPING, _TOLERANCE = 12, 1e-3, 1e-5
"""Steps of Levenberg and Marquardt, first damping and relative gain of the last one, with a refuted lens free."""


@dataclass(frozen=True, eq=False)
class LinearisedModel:
    """The model in which clocks and lenses are tested, about an adjusted state.

    prior: of the paths. system, parts: its normal equations and their elimination. path: (m,) the path's step with the
    cameras fixed, negative. gradient (p,): of the cameras' parameters, the path eliminated. fixed: (q, p) gauge.
    """

    problem: Problem
    state: AdjustmentState
    prior: SmoothnessPrior
    system: BorderedSystem
    parts: Elimination
    path: Floats
    gradient: Floats
    fixed: Floats

    @classmethod
    def of(cls, problem: Problem, state: AdjustmentState, sigma: Floats) -> LinearisedModel:
        """With lenses and readouts free under priors. sigma: (cameras,) noise of one pixel coordinate at the effective
        sample size."""
        wide = replace(
            problem,
            free_parameters=replace(problem.free_parameters, readout=True),
            lens_tolerances=problem.lens_tolerances or tuple(lens_tolerance(lens) for lens in problem.nominal),
        )
        noisy, prior = replace(state, sigma=sigma), estimate_smoothness(problem, state)
        # Fewer effective rows are no reason to smooth the paths more.
        share = float(np.median(state.sigma / sigma)) ** 2
        return cls.about(wide, noisy, replace(prior, weights=tuple(share * weight for weight in prior.weights)))

    @classmethod
    def in_its_noise(cls, problem: Problem, state: AdjustmentState) -> LinearisedModel:
        """The model in which clocks are tested, in noise scaled to the effective sample size."""
        return cls.of(problem, state, state.sigma * np.sqrt(correlation_inflation(problem, state)))

    @classmethod
    def about(cls, problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> LinearisedModel:
        """The free parameters of the problem."""
        system, _ = build_system(problem, state, prior, robust=False)
        parts = eliminate(system)
        path = cho_solve_banded(parts.factor, system.gradient_path)
        gradient = system.gradient_cameras - system.border.transposed_times(path)
        return cls(problem, state, prior, system, parts, path, gradient, gauge(problem, state))

    @cached_property
    def covariance(self) -> ParameterCovariance:
        """(p, p) of the cameras' parameters."""
        none = np.zeros(len(self.fixed))
        return constrained_step(self.parts.reduced, -self.gradient, self.fixed, none)[1]

    def cost_after(self, free: Ints) -> float:
        """The lowest cost along a step of the paths and the parameters ``free`` (k,), the others held."""
        cameras, fixed = np.zeros(len(self.gradient)), self.fixed[:, free]
        normal = self.parts.reduced.restricted(free)
        cameras[free] = constrained_step(normal, -self.gradient[free], fixed, np.zeros(len(fixed)))[0]
        path = -(self.path + self.parts.a_inv_b @ cameras)
        trials = (apply_step(self.problem, self.state, share * path, share * cameras) for share in _STEP_SHARES)
        return min(weigh_residuals(self.problem, one, self.prior, robust=False).cost for one in trials)

    def gain(self, camera: int, free: Ints) -> float:
        """By how much less the rows cost at the best of a camera's parameters among ``free`` (k,).

        Beside three others or more all else is fixed, as the path is by these; else everything is free.
        """
        lenses = self.problem.lens_tolerances
        if len(lenses) < _MIN_TO_HOLD_A_PATH:
            given = self.problem.lens_priors or (None,) * len(lenses)
            costs = []
            for priors in (given, (*given[:camera], lenses[camera], *given[camera + 1 :])):
                problem = replace(self.problem, lens_tolerances=(), lens_priors=priors)
                state = minimise(problem, self.state, self.prior, False, _STEPS_ALONE, _TOLERANCE, [], False)
                costs.append(weigh_residuals(problem, state, self.prior, robust=False).cost)
            return costs[0] - costs[1]
        own = free[self.problem.free_columns[free] // CAMERA_PARAMETERS == camera]
        problem = replace(self.problem, rows=self.problem.of_camera(camera))
        state, damping, still = self.state, _FIRST_DAMPING, np.zeros_like(self.path)
        residuals = weigh_residuals(problem, state, self.prior, robust=False)
        first, system = residuals.cost, None
        for _ in range(_STEPS_ALONE):
            system = system or assemble(problem, state, self.prior, residuals)
            normal, step = system.corner.restricted(own).dense(), np.zeros(len(self.gradient))
            step[own] = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), system.gradient_cameras[own])
            trial = apply_step(problem, state, still, step)
            there = weigh_residuals(problem, trial, self.prior, robust=False)
            if there.cost < residuals.cost:
                gained = residuals.cost - there.cost
                state, residuals, system, damping = trial, there, None, 0.1 * damping
                if gained < _TOLERANCE * residuals.cost:
                    break
            else:
                damping *= 10.0
        return first - residuals.cost

    def readouts(self) -> dict[int, Ints]:
        """The column (1,) of each camera's readout that was not given."""
        columns = self.problem.free_columns
        free = np.flatnonzero(columns % CAMERA_PARAMETERS == Column.READOUT)
        return {int(columns[k]) // CAMERA_PARAMETERS: np.array([k]) for k in free}

    def best_step(self, camera: int, times: Floats) -> tuple[ClockStep, Floats, Floats]:
        """The best of a camera's steps at camera times (k,); what the paths (m,) and the cameras (p,) do with it."""
        state, system, columns = self.state, self.system, self.problem.free_columns
        seen = evaluate_labels(
            self.problem.used[camera],
            state.cameras[camera],
            StackedTrajectories.of(state.by_label),
        )
        mine = np.flatnonzero(columns // CAMERA_PARAMETERS == camera)
        own = (columns[mine] % CAMERA_PARAMETERS).tolist()
        jacobian = jacobians(seen, state.cameras[camera], [Column.OFFSET, *own])
        weight = np.where(seen.valid, seen.relative_information / state.sigma[camera] ** 2, 0.0)
        after = seen.time >= times[:, None]
        weighted = jacobian[:, 3] * weight
        cross = (weighted[:, None] * jacobian).sum(axis=0)
        border = border_block(seen.index, seen.weights, cross[:3, None] * after, len(system.gradient_path))
        corner = np.zeros((len(columns), len(times)))
        corner[mine] = cross[4:] @ after.T
        solved = cho_solve_banded(self.parts.factor, border)
        coupling = corner - system.border.transposed_times(solved)
        score = after @ (weighted * seen.whitened(seen.residual)).sum(axis=0) - solved.T @ system.gradient_path
        score -= coupling.T @ (self.covariance @ self.gradient)
        known, taken = after @ cross[3], (border * solved).sum(axis=0)
        information = np.maximum(known - taken - (coupling * (self.covariance @ coupling)).sum(axis=0), 1e-9)
        score = np.where(information > _ROUNDING * known, score, 0.0)  # where the path takes all, a step was 1e19 s
        k = int(np.argmax(score**2 / information))
        change, rate = float(score[k] / information[k]), float(state.cameras[camera].rate)
        cameras = -(self.covariance @ (self.gradient - coupling[:, k] * change))
        path = -(self.path + self.parts.a_inv_b @ cameras - solved[:, k] * change)
        statistic = float(score[k] ** 2 / information[k])
        step = ClockStep(camera, float(times[k]), change / rate, float(information[k] ** -0.5) / rate, statistic)
        return step, path, cameras


def evidence_needed(problem: Problem, parameters: int, tried: int = 1) -> float:
    """The chi-squared that a clock's further parameters need: the Bayesian information criterion, for the best of so
    many that are tried in each camera."""
    rows = sum(int(part.use.sum()) for part in problem.rows)
    return float(parameters * np.log(max(rows, 2)) + 2.0 * np.log(tried * len(problem.nominal)))
