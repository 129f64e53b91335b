"""The adjustment's cost at a state, and its normal equations over all paths and free camera parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.bordered_system import BorderedSystem, PathBlocks
from hub.bundle.problem import (
    ASPECT,
    CAMERA_PARAMETERS,
    CENTRE,
    FOCAL,
    K1,
    K2,
    K3,
    P1,
    RATE,
    READOUT,
    LensPrior,
    Problem,
    Rows,
    State,
)
from hub.bundle.residuals import Look, Stacked, derivatives, look_together
from hub.trajectory.smoothness_prior import MotionPrior, motion_cost, motion_terms
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

WIDTH = 4.0
"""Cauchy width in sigma of the 2-D residual: nearly efficient for Gaussian noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """The rows at a state by camera, what each weighs, and the cost of all and of the priors."""

    cameras: tuple[int, ...]
    looks: tuple[Look, ...]
    weights: tuple[Floats, ...]
    cost: float


def weighed(problem: Problem, state: State, prior: MotionPrior, robust: bool) -> Weighed:
    """Residuals and the cost: what of `assemble` is cheap."""
    cost = sum(
        motion_cost(path, prior.weights[label], prior.sizes[label] if prior.sizes else None)
        for label, path in enumerate(state.trajectories)
    )
    cost += sum((value / std) ** 2 for _, value, std in camera_priors(problem, state))
    # A point behind the camera or off the path costs what a gross outlier does, and pulls nothing.
    gross = WIDTH**2 * np.log1p((100.0 / WIDTH) ** 2) if robust else 100.0**2
    by_camera: dict[int, list[Rows]] = {}
    for rows in problem.rows:
        by_camera.setdefault(rows.camera, []).append(rows)
    paths = Stacked.of(state.trajectories)
    looks, weights = [], []
    for camera, parts in by_camera.items():
        seen = look_together(parts, state.cameras[camera], paths)
        over = 1.0 / state.sigma[camera] ** 2
        squared = (seen.residual[0] ** 2 + seen.residual[1] ** 2) * over
        if robust:
            ratio = squared / WIDTH**2
            weights.append(np.where(seen.valid, over / (1.0 + ratio), 0.0))
            losses = WIDTH**2 * np.log1p(ratio)
        else:
            weights.append(np.where(seen.valid, over, 0.0))
            losses = squared
        cost += float(np.where(seen.valid, losses, gross).sum())
        looks.append(seen)
    return Weighed(tuple(by_camera), tuple(looks), tuple(weights), float(cost))


def build_system(problem: Problem, state: State, prior: MotionPrior, robust: bool) -> tuple[BorderedSystem, float]:
    """Normal equations over all labels' control points and the free camera parameters, and the cost."""
    seen = weighed(problem, state, prior, robust)
    return assemble(problem, state, prior, seen), seen.cost


def assemble(problem: Problem, state: State, prior: MotionPrior, seen: Weighed) -> BorderedSystem:
    """The normal equations at a state whose rows are ``seen``."""
    sizes = [3 * path.basis.size for path in state.trajectories]
    bases = np.r_[0, np.cumsum(sizes)].astype(int)
    columns = problem.free_columns()
    system = BorderedSystem(
        np.zeros((12, bases[-1])),
        np.zeros((bases[-1], len(columns)), order="F"),  # as LAPACK wants it
        np.zeros((len(columns), len(columns))),
        np.zeros(bases[-1]),
        np.zeros(len(columns)),
    )
    blocks = PathBlocks(bases[-1] // 3)
    for which, one, weight in zip(seen.cameras, seen.looks, seen.weights, strict=True):
        mine = np.flatnonzero(columns // CAMERA_PARAMETERS == which)
        by = derivatives(one, state.cameras[which], (columns[mine] % CAMERA_PARAMETERS).tolist())
        terms = np.concatenate([by, one.residual[:, None]], axis=1)
        weighted = terms * weight
        spread, own = blocks.add_rows(one.index, one.weights, terms, weighted)
        system.gradient_path += spread[:, -1]
        if len(mine):
            system.border[:, mine[0] : mine[-1] + 1] = spread[:, :-1]
            system.corner[np.ix_(mine, mine)] = own[:-1, :-1]
            system.gradient_cameras[mine] = own[:-1, -1]
    system.band += blocks.band()
    for label, path in enumerate(state.trajectories):
        part = slice(bases[label], bases[label + 1])
        band, gradient, _ = motion_terms(path, prior.weights[label], prior.sizes[label] if prior.sizes else None)
        system.band[:, part] += band
        system.gradient_path[part] += gradient
    place = {int(column): i for i, column in enumerate(columns)}
    for column, value, std in camera_priors(problem, state):
        if column in place:
            system.corner[place[column], place[column]] += 1.0 / std**2
            system.gradient_cameras[place[column]] += value / std**2
    return system


def camera_priors(problem: Problem, state: State) -> list[tuple[int, float, float]]:
    """Column, difference and std of every prior on rates, readouts and lenses."""
    freedom, out = problem.freedom, list[tuple[int, float, float]]()
    for camera, (now, nominal) in enumerate(zip(state.cameras, problem.nominal, strict=True)):
        base = camera * CAMERA_PARAMETERS
        terms = [(RATE, now.rate - 1.0, freedom.rate_std)]
        if freedom.readout:
            terms.append((READOUT, now.readout, freedom.readout_std))
        guess = problem.lens_prior(camera)
        if guess is not None:
            terms.append((FOCAL, float(np.log(now.intrinsics.focal / guess.focal)), guess.focal_std))
            off = now.intrinsics.matrix[:2, 2] - guess.centre
            terms += [(CENTRE, float(off[0]), guess.centre_std), (CENTRE + 1, float(off[1]), guess.centre_std)]
            terms.append((K1, float(now.intrinsics.distortions[0] - guess.k1), guess.k1_std))
            terms.append((K2, float(now.intrinsics.distortions[1] - guess.k2), guess.k2_std))
            terms += _finer_priors(now.intrinsics, nominal, guess)
        elif freedom.lens:
            terms.append((FOCAL, float(np.log(now.intrinsics.focal / nominal.focal)), freedom.focal_std))
            terms.append((K1, float(now.intrinsics.distortions[0] - nominal.distortions[0]), freedom.k1_std))
        out += [(base + column, value, std) for column, value, std in terms]
    return out


def _finer_priors(now: Intrinsics, nominal: Intrinsics, guess: LensPrior) -> list[tuple[int, float, float]]:
    """Column, difference and std of what a lens has beside focal length, centre, k1 and k2."""
    third = 2 if now.fisheye else 4
    aspect = np.log(now.matrix[1, 1] / now.matrix[0, 0] / nominal.matrix[1, 1] * nominal.matrix[0, 0])
    terms = [
        (K3, float(now.distortions[third] - nominal.distortions[third]), guess.k3_std),
        (ASPECT, float(aspect), guess.aspect_std),
    ]
    if not now.fisheye:
        off = now.distortions[2:4] - nominal.distortions[2:4]
        terms += [(P1, float(off[0]), guess.tangential_std), (P1 + 1, float(off[1]), guess.tangential_std)]
    return terms
