"""Cost of the adjustment at a state, and its normal equations over all paths and free camera parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from hub.bundle.block_matrix import BlockSum
from hub.bundle.bordered_system import BAND, BorderedSystem, PathBlocks, PathByCameras, add_rows
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, Column, LensPrior, Problem
from hub.bundle.residuals import ResidualEvaluation, StackedTrajectories, evaluate_labels, jacobians
from hub.bundle.smoothness_prior import SmoothnessPrior, smoothness_cost, smoothness_terms
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Ints

CAUCHY_WIDTH = 4.0
"""Cauchy width in sigma of the 2-D residual: nearly efficient for Gaussian noise."""


@dataclass(frozen=True, slots=True, eq=False)
class WeightedResiduals:
    """Residuals at a state by camera, the weight of each row, and the total cost with the priors."""

    cameras: tuple[int, ...]
    evaluations: tuple[ResidualEvaluation, ...]
    weights: tuple[Floats, ...]
    cost: float


def weigh_residuals(
    problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, robust: bool
) -> WeightedResiduals:
    """Residuals, robust weights and the cost: the cheap part of `assemble`."""
    cost = sum(smoothness_cost(path, *prior.of(label)) for label, path in enumerate(state.trajectories))
    cost += sum((value / std) ** 2 for _, value, std in camera_priors(problem, state))
    # A point behind the camera or off the path costs as much as a gross outlier, and has no gradient.
    gross_error_cost = CAUCHY_WIDTH**2 * np.log1p((100.0 / CAUCHY_WIDTH) ** 2) if robust else 100.0**2
    paths = StackedTrajectories.of(state.by_label)
    evaluations, weights = [], []
    for camera, rows in problem.used.items():
        residuals = evaluate_labels(rows, state.cameras[camera], paths)
        information = residuals.relative_information / state.sigma[camera] ** 2
        squared = np.square(residuals.whitened(residuals.residual)).sum(axis=0) * information
        if robust:
            ratio = squared / CAUCHY_WIDTH**2
            weights.append(np.where(residuals.valid, information / (1.0 + ratio), 0.0))
            losses = CAUCHY_WIDTH**2 * np.log1p(ratio)
        else:
            weights.append(np.where(residuals.valid, information, 0.0))
            losses = squared
        cost += float(np.where(residuals.valid, losses, gross_error_cost).sum())
        evaluations.append(residuals)
    return WeightedResiduals(tuple(problem.used), tuple(evaluations), tuple(weights), float(cost))


def build_system(
    problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, robust: bool
) -> tuple[BorderedSystem, float]:
    """Normal equations over all labels' control points and the free camera parameters, and the cost."""
    residuals = weigh_residuals(problem, state, prior, robust)
    return assemble(problem, state, prior, residuals), residuals.cost


def assemble(
    problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, residuals: WeightedResiduals
) -> BorderedSystem:
    """The normal equations at a state whose rows are ``residuals``."""
    first_rows = np.r_[0, np.cumsum([3 * path.basis.size for path in state.trajectories])].astype(int)
    columns = problem.free_columns
    corner, gradient_cameras = list[tuple[Ints, Floats]](), np.zeros(len(columns))
    band, gradient_path = np.zeros((BAND, first_rows[-1])), np.zeros(first_rows[-1])
    blocks = [PathBlocks(path.basis.size) for path in state.trajectories]
    border: list[list[tuple[int, int, Floats]]] = [[] for _ in blocks]
    starts = np.searchsorted(columns, CAMERA_PARAMETERS * np.arange(len(state.cameras) + 1))
    columns_of = {camera: np.arange(starts[camera], starts[camera + 1]) for camera in residuals.cameras}
    for camera, one, weight in zip(residuals.cameras, residuals.evaluations, residuals.weights, strict=True):
        own, rows = columns_of[camera], problem.used[camera]
        jacobian = jacobians(one, state.cameras[camera], (columns[own] % CAMERA_PARAMETERS).tolist())
        terms = np.concatenate([jacobian, one.whitened(one.residual)[:, None]], axis=1)
        terms *= np.sqrt(weight)
        to = [(int(first_rows[label]) // 3, blocks[label]) for label in rows.labels]
        path_terms, camera_terms = add_rows(to, rows.ends, one.index, one.weights, terms)
        for label, (low, of_label) in zip(rows.labels, path_terms, strict=True):
            gradient_path[3 * low : 3 * low + len(of_label)] += of_label[:, -1]
            border[label].append((camera, low, of_label[:, :-1]))
        corner.append((own, camera_terms[:-1, :-1]))
        gradient_cameras[own] += camera_terms[:-1, -1]
    parts = []
    for label, path in enumerate(state.trajectories):
        rows_of_label = slice(int(first_rows[label]), int(first_rows[label + 1]))
        of_prior, gradient, _ = smoothness_terms(path, *prior.of(label))
        band[:, rows_of_label] = blocks[label].band() + of_prior
        gradient_path[rows_of_label] += gradient
        seeing = {camera: columns_of[camera] for camera, _, _ in border[label]}
        place = dict(zip(seeing, accumulate((len(one) for one in seeing.values()), initial=0), strict=False))
        block = np.zeros((len(gradient), sum(len(one) for one in seeing.values())))
        for camera, low, of_label in border[label]:
            at, column = 3 * low - rows_of_label.start, place[camera]
            block[at : at + len(of_label), column : column + of_label.shape[1]] += of_label
        parts.append((rows_of_label, np.concatenate([np.zeros(0, dtype=np.int64), *seeing.values()]), block))
    priors, gradient = prior_terms(problem, state)
    return BorderedSystem(
        band,
        PathByCameras(tuple(parts), len(columns)),
        priors + BlockSum(np.zeros(len(columns)), tuple(corner)),
        gradient_path,
        gradient_cameras + gradient,
    )


def prior_terms(problem: Problem, state: AdjustmentState) -> tuple[BlockSum, Floats]:
    """Information (p, p) and gradient (p,) of the priors on the free camera parameters."""
    information, gradient = np.zeros((2, len(state.cameras) * CAMERA_PARAMETERS))
    for column, value, std in camera_priors(problem, state):
        information[column] += 1.0 / std**2
        gradient[column] += value / std**2
    columns = problem.free_columns
    return BlockSum(information[columns]), gradient[columns]


def camera_priors(problem: Problem, state: AdjustmentState) -> list[tuple[int, float, float]]:
    """Column, difference and std of every prior on rates, readouts and lenses."""
    free_parameters, out = problem.free_parameters, list[tuple[int, float, float]]()
    reference_rate = state.cameras[problem.clock_reference].rate  # the internal time may run at any rate near 1
    for camera, (current, nominal) in enumerate(zip(state.cameras, problem.nominal, strict=True)):
        base = camera * CAMERA_PARAMETERS
        terms = [(Column.RATE, current.rate - reference_rate, problem.rate_std(camera))]
        if free_parameters.readout:
            # About 0, for global shutters, with the second moment of a uniform distribution.
            terms.append((Column.READOUT, current.readout, problem.longest_readout(camera) / math.sqrt(3.0)))
        lens_prior = problem.lens_prior(camera)
        if lens_prior is not None:
            terms.append(
                (Column.FOCAL, float(np.log(current.intrinsics.focal / lens_prior.focal)), lens_prior.focal_std)
            )
        if lens_prior is not None and not lens_prior.focal_only:
            shift = current.intrinsics.matrix[:2, 2] - lens_prior.centre
            terms += [
                (Column.CENTRE, float(shift[0]), lens_prior.centre_std),
                (Column.CENTRE + 1, float(shift[1]), lens_prior.centre_std),
            ]
            terms.append((Column.K1, float(current.intrinsics.distortions[0] - lens_prior.k1), lens_prior.k1_std))
            terms.append((Column.K2, float(current.intrinsics.distortions[1] - lens_prior.k2), lens_prior.k2_std))
            terms += _further_lens_priors(current.intrinsics, nominal, lens_prior)
        elif lens_prior is None and free_parameters.lens:
            terms.append(
                (Column.FOCAL, float(np.log(current.intrinsics.focal / nominal.focal)), free_parameters.focal_std)
            )
            terms.append(
                (Column.K1, float(current.intrinsics.distortions[0] - nominal.distortions[0]), free_parameters.k1_std)
            )
        out += [(base + column, value, std) for column, value, std in terms]
    return out


def _further_lens_priors(
    current: Intrinsics, nominal: Intrinsics, lens_prior: LensPrior
) -> list[tuple[int, float, float]]:
    """Column, difference and std of the priors on k3, aspect ratio, p1 and p2."""
    third = 2 if current.fisheye else 4
    aspect = np.log(current.matrix[1, 1] / current.matrix[0, 0] / nominal.matrix[1, 1] * nominal.matrix[0, 0])
    terms = [
        (Column.K3, float(current.distortions[third] - nominal.distortions[third]), lens_prior.k3_std),
        (Column.ASPECT, float(aspect), lens_prior.aspect_std),
    ]
    if not current.fisheye:
        shift = current.distortions[2:4] - nominal.distortions[2:4]
        terms += [
            (Column.P1, float(shift[0]), lens_prior.tangential_std),
            (Column.P1 + 1, float(shift[1]), lens_prior.tangential_std),
        ]
    return terms
