"""What is expected of the path where little is seen of it: that its third differences stay as large as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.poses.linear import third_difference_band, third_difference_gradient, third_differences
from hub.poses.problem import Problem, State, Trajectory
from hub.splines import SUPPORT
from protocols.geometry.types import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrior:
    """Weights (m,) of the squared third differences, one array a label.

    sizes: by label, what keeps the prior from making the path smaller; () = nothing does.
    """

    weights: tuple[Floats, ...]
    sizes: tuple[Size | None, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Size:
    """How large a path was when the strength of its prior was told.

    both: (m,) knot intervals that two cameras see. held: (size,) control points of these. scatter: of those.
    """

    both: Bools
    held: Bools
    scatter: float


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
        sizes.append(None if first else _size(path, both))
    return MotionPrior(tuple(weights), tuple(sizes))


def _size(path: Trajectory, both: Bools) -> Size | None:
    """The size that the prior's strength follows; None for a path of which two cameras see hardly anything.

    A smaller path has smaller third differences, so that a prior of fixed strength prefers it, and a rig whose baseline
    is held gives way by turning its cameras: with two of them by half a std. So where two cameras see the path its cost
    is sum w d² S0 / S, with S the scatter of its control points, S0 that when w was told: the same for any size.
    """
    if both.sum() < 4:
        return None
    held = np.zeros(path.basis.size, dtype=np.bool_)
    held[(path.basis.interval_starts()[both, None] + np.arange(SUPPORT)).ravel()] = True
    scatter = float((_about(path.control[held]) ** 2).sum())
    return Size(both, held, scatter) if scatter > 0.0 else None


def _about(control: Floats) -> Floats:
    return np.asarray(control - control.mean(axis=0))


def motion_terms(path: Trajectory, weight: Floats, size: Size | None) -> tuple[Floats, Floats, float]:
    """Band, gradient (3 n,) and value of the prior's cost at a path."""
    differences = third_differences(path.basis, path.control)
    if size is None:
        pulls = weight[:, None] * differences
        gradient = third_difference_gradient(path.basis, pulls)
        return third_difference_band(path.basis, weight), gradient, float((pulls * differences).sum())
    about = _about(path.control[size.held])
    scatter = max(float((about**2).sum()), 1e-12 * size.scatter)
    weight = np.where(size.both, size.scatter / scatter, 1.0) * weight
    pulls = weight[:, None] * differences
    gradient = third_difference_gradient(path.basis, pulls)
    level = float((pulls[size.both] * differences[size.both]).sum())
    gradient.reshape(-1, 3)[size.held] -= level / scatter * about
    return third_difference_band(path.basis, weight), gradient, float((pulls * differences).sum())
