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

    scales: by label, what keeps the prior from making the path smaller; () = nothing does.
    """

    weights: tuple[Floats, ...]
    scales: tuple[ScalePull, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ScalePull:
    """A pull (size, 3) on the control points, and what it costs at the path for which it was made."""

    pull: Floats
    level: float


def motion_prior(problem: Problem, state: State, first: bool = False) -> MotionPrior:
    """Strength of the motion prior from the third differences where at least two cameras see.

    first: before the path can be trusted, only a whisper that closes holes.
    """
    weights, scales = [], []
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
        scales.append(_scale_pull(path, both, weights[-1], differences))
    return MotionPrior(tuple(weights), () if first else tuple(scales))


def _scale_pull(path: Trajectory, both: Bools, weight: Floats, differences: Floats) -> ScalePull:
    """What takes the prior's say on the path's scale from it.

    A smaller path has smaller third differences, so that a prior of fixed strength prefers it, and a rig whose baseline
    is held gives way by turning its cameras: with two of them by half a std. The strength is the path's own, and would
    follow its size: sum w d² S0 / S, S the scatter of the control points, of which this is the derivative at S = S0.
    both: (m,) knot intervals that two cameras see; elsewhere nothing would hold the path against it.
    """
    held = np.zeros(path.basis.size, dtype=np.bool_)
    held[(path.basis.interval_starts()[both, None] + np.arange(SUPPORT)).ravel()] = True
    pull = np.zeros_like(path.control)
    if both.sum() < 4:
        return ScalePull(pull, 0.0)
    about = path.control[held] - path.control[held].mean(axis=0)
    level, scatter = float((weight[both, None] * differences[both] ** 2).sum()), float((about**2).sum())
    if scatter > 0.0:
        pull[held] = level / scatter * about
    return ScalePull(pull, level)


def motion_terms(path: Trajectory, weight: Floats, scale: ScalePull | None) -> tuple[Floats, Floats, float]:
    """Band, gradient (3 n,) and value of the prior's cost at a path."""
    band = third_difference_band(path.basis, weight)
    differences = third_differences(path.basis, path.control)
    pulls = weight[:, None] * differences
    gradient = third_difference_gradient(path.basis, pulls)
    value = float((pulls * differences).sum())
    if scale is not None:
        gradient -= scale.pull.ravel()
        value += 2.0 * (scale.level - float((path.control * scale.pull).sum()))
    return band, gradient, value
