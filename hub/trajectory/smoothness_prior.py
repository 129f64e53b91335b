"""What is expected of the path where little is seen of it: that its third differences stay as large as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.bordered_system import third_difference_band, third_difference_gradient, third_differences
from hub.bundle.problem import Problem, State, Trajectory
from hub.trajectory.splines import SUPPORT
from protocols.geometry.types import Bools, Floats

_FLATTEST = 1e-3 / 3.0
"""Least share of a path's scatter in any direction: a path in a plane has none across it."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrior:
    """Weights (m,) of the squared third differences, one array a label.

    sizes: by label, what keeps the prior from making the path smaller or flatter; () = nothing does.
    """

    weights: tuple[Floats, ...]
    sizes: tuple[Size | None, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Size:
    """How large a path was, and in which directions, when the strength of its prior was told.

    both: (m,) knot intervals that two cameras see. held: (size,) control points of these. floor: added to the diagonal
    of their scatter. scale: of the metric ``scale * scatter⁻¹``, in which the prior is what it was told to be.
    """

    both: Bools
    held: Bools
    floor: float
    scale: float


def motion_prior(problem: Problem, state: State, first: bool = False) -> MotionPrior:
    """Strength of the motion prior from the third differences where at least two cameras see.

    first: before the path can be trusted, only a whisper that closes holes.
    """
    weights: list[Floats] = []
    sizes: list[Size | None] = []
    for label, path in enumerate(state.trajectories):
        size = path.basis.size
        count = len(path.basis.interval_starts())
        differences = third_differences(path.basis, path.control)
        seen = np.zeros((len(state.cameras), size), dtype=np.bool_)
        for rows in problem.rows:
            if rows.label == label:
                index, _, inside = path.basis.locate(state.cameras[rows.camera].reference_time(rows.time[rows.use]))[:3]
                seen[rows.camera, index[inside]] = True
        both = seen.sum(axis=0)[path.basis.interval_starts()] >= 2
        chosen = differences[both] if both.sum() >= 4 else differences
        variance = float(np.mean(chosen**2)) if len(chosen) else 1.0
        scale = float(np.median(np.ptp(path.control, axis=0))) or 1.0
        variance = max(variance, (1e-6 * scale) ** 2)
        weights.append(np.full(count, (1e-3 if first else 1.0) / variance))
        sizes.append(None if first else _size(path, both, weights[-1]))
    return MotionPrior(tuple(weights), tuple(sizes))


def _size(path: Trajectory, both: Bools, weight: Floats) -> Size | None:
    """The size that the prior's strength follows; None for a path of which two cameras see hardly anything.

    A smaller path has smaller third differences, and so has one that is flatter: a prior of fixed strength prefers
    both, and cameras give way, by turning and, where lenses are free, by zooming (with errors that last for seconds by
    metres). So where two cameras see the path its third differences d count in the metric of the scatter S of its
    control points: sum w dᵀ S⁻¹ d is the same for every affine picture of a path.
    """
    if both.sum() < 4:
        return None
    held = np.zeros(path.basis.size, dtype=np.bool_)
    held[(path.basis.interval_starts()[both, None] + np.arange(SUPPORT)).ravel()] = True
    scatter = _scatter(path.control[held], 0.0)
    floor = _FLATTEST * float(np.trace(scatter))
    if not floor > 0.0:
        return None
    differences = third_differences(path.basis, path.control)[both]
    inverse = np.linalg.inv(_scatter(path.control[held], floor))
    plain = float((weight[both, None] * differences**2).sum())
    metric = float((weight[both, None] * (differences @ inverse) * differences).sum())
    return Size(both, held, floor, plain / metric) if metric > 0.0 else None


def _about(control: Floats) -> Floats:
    return np.asarray(control - control.mean(axis=0))


def _scatter(control: Floats, floor: float) -> Floats:
    about = _about(control)
    return np.asarray(about.T @ about / len(about) + floor * np.eye(3))


def motion_cost(path: Trajectory, weight: Floats, size: Size | None) -> float:
    """Value of the prior's cost at a path."""
    differences = third_differences(path.basis, path.control)
    return float((_pulls(path, differences, weight, size)[0] * differences).sum())


def motion_terms(path: Trajectory, weight: Floats, size: Size | None) -> tuple[Floats, Floats, float]:
    """Band, gradient (3 n,) and value of the prior's cost at a path."""
    differences = third_differences(path.basis, path.control)
    pulls, inverse = _pulls(path, differences, weight, size)
    gradient, value = third_difference_gradient(path.basis, pulls), float((pulls * differences).sum())
    if size is None:
        return third_difference_band(path.basis, weight, np.eye(3)), gradient, value
    held = path.control[size.held]
    inside, outside = np.where(size.both, weight, 0.0), np.where(size.both, 0.0, weight)
    level = (inside[:, None] * differences).T @ differences
    gradient.reshape(-1, 3)[size.held] -= size.scale / len(held) * _about(held) @ inverse @ level @ inverse
    band = third_difference_band(path.basis, inside, np.asarray(size.scale * inverse))
    if outside.any():
        band += third_difference_band(path.basis, outside, np.eye(3))
    return band, gradient, value


def _pulls(path: Trajectory, differences: Floats, weight: Floats, size: Size | None) -> tuple[Floats, Floats]:
    """Half the cost's derivative (m, 3) by the third differences, the metric held; the scatter's inverse (3, 3)."""
    if size is None:
        return weight[:, None] * differences, np.eye(3)
    inverse: Floats = np.asarray(np.linalg.inv(_scatter(path.control[size.held], size.floor)), dtype=np.float64)
    pulls = np.where(size.both[:, None], differences @ (size.scale * inverse), differences)
    return weight[:, None] * pulls, inverse
