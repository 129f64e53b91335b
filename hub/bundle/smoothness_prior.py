"""Smoothness prior of trajectories: squared third differences of the spline's control points.

Where a path is hardly observed its third differences are expected to be as large as where it is well observed. Their
variance is estimated by the evidence (MacKay 1992): their squares over the number that observations determine. Over the
number of all it decreases from round to round, since the prior shrinks those that it determines itself: of heads seen
within 1.5 px at 10 frames a second it went to 0, and clocks followed by 300 ppm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.bordered_system import (
    BAND,
    THIRD_DIFFERENCE,
    third_difference_band,
    third_difference_gradient,
    third_differences,
)
from hub.bundle.problem import AdjustmentState, Problem, Trajectory
from hub.trajectory.splines import SUPPORT
from protocols.geometry.types import Bools, Floats, Ints

_MIN_SCATTER_SHARE = 1e-3 / 3.0
"""Smallest share of a path's scatter in any direction: a planar path has none across its plane."""
_MIN_DETERMINED = 1e-3  # a bound: of a path of which observations say nothing the share is 0


@dataclass(frozen=True, slots=True, eq=False)
class SmoothnessPrior:
    """Weights (m,) of the squared third differences, one array a label.

    scatters: by label, the scatter by which the prior is normalised so that it neither shrinks nor flattens the path;
    () = no normalisation.
    """

    weights: tuple[Floats, ...]
    scatters: tuple[PathScatter | None, ...] = ()

    def of(self, label: int) -> tuple[Floats, PathScatter | None]:
        """Weights and scatter of one label."""
        return self.weights[label], self.scatters[label] if self.scatters else None


@dataclass(frozen=True, slots=True, eq=False)
class PathScatter:
    """Extent of a path in all directions, by which the strength of its prior is normalised.

    seen: (m,) knot intervals that two cameras see. held: (m,) those that are `_held`. control_mask: (size,) their
    control points.
    floor: added to the diagonal of their scatter matrix S. scale: of the metric ``scale * S⁻¹``, in which the prior has
    the strength that was estimated.
    """

    seen: Bools
    held: Bools
    control_mask: Bools
    floor: float
    scale: float


def estimate_smoothness(problem: Problem, state: AdjustmentState, weak: bool = False) -> SmoothnessPrior:
    """Strength of the smoothness prior from the third differences of the path where at least two cameras see it.

    weak: a thousandth of the strength, which only bridges gaps, for a path that is not yet reliable.
    """
    weights: list[Floats] = []
    scatters: list[PathScatter | None] = []
    for label, path in enumerate(state.trajectories):
        size = path.basis.size
        count = len(path.basis.interval_starts())
        differences = third_differences(path.basis, path.control)
        seen = np.zeros((len(state.cameras), size), dtype=np.bool_)
        for rows in problem.of_label(label):
            index, _, inside = path.basis.locate(state.cameras[rows.camera].reference_time(rows.time[rows.use]))[:3]
            seen[rows.camera, index[inside]] = True
        starts = path.basis.interval_starts()
        seen_by_two = seen.sum(axis=0)[starts] >= 2
        held = _held(seen_by_two, starts)
        chosen = differences[held] if held.sum() >= 4 else differences
        variance = float(np.mean(chosen**2)) / path.determined if len(chosen) else 1.0
        scale = float(np.median(np.ptp(path.control, axis=0))) or 1.0
        variance = max(variance, (1e-6 * scale) ** 2)
        weights.append(np.full(count, (1e-3 if weak else 1.0) / variance))
        scatters.append(None if weak else _path_scatter(path, seen_by_two, held))
    return SmoothnessPrior(tuple(weights), tuple(scatters))


def determined_shares(state: AdjustmentState, prior: SmoothnessPrior, blocks: Floats) -> tuple[float, ...]:
    """By label, the share of a path's third differences that its observations determine (MacKay's gamma).

    blocks: of the covariance of all control points under the prior, as of `inverse_blocks`.
    """
    shares, first = list[float](), 0
    for label, path in enumerate(state.trajectories):
        weight, scatter = prior.of(label)
        starts = path.basis.interval_starts()
        block, inside = np.divmod(3 * (first + starts), BAND)
        entries = inside[:, None] + np.arange(BAND)
        covariance = blocks[block[:, None, None], entries[:, :, None], entries[:, None, :]]
        covariance = covariance.reshape(-1, SUPPORT, 3, SUPPORT, 3)
        spread = np.einsum("a,naibj,b->nij", THIRD_DIFFERENCE, covariance, THIRD_DIFFERENCE)
        if scatter is None:
            metric = np.asarray(np.eye(3))
            held = np.ones(len(starts), dtype=np.bool_)
        else:
            inverse = np.linalg.inv(_scatter(path.control[scatter.control_mask], scatter.floor))
            metric = np.asarray(scatter.scale * inverse)
            held = scatter.held
        left = weight * np.einsum("ij,nji->n", metric, spread) / 3.0  # 1 where the prior alone says anything
        shares.append(float(np.clip(1.0 - left[held].mean(), _MIN_DETERMINED, 1.0)) if held.any() else 1.0)
        first += path.basis.size
    return tuple(shares)


def _held(seen: Bools, starts: Ints) -> Bools:
    """The intervals (m,) of ``seen``, by two cameras, whose neighbours on both sides are seen too.

    Where a path ends, hardly any row holds the last control point. As a part of the scatter it lowered its own cost as
    it flew off; its third difference was then the path's strength, and the clocks followed the ends by 1000 ppm.
    """
    held, joined = seen.copy(), np.diff(starts) == 1
    held[1:] &= seen[:-1] & joined
    held[:-1] &= seen[1:] & joined
    held[:1] = held[-1:] = False
    return held


def _path_scatter(path: Trajectory, seen: Bools, held: Bools) -> PathScatter | None:
    """The scatter that normalises the prior's strength; None for a path of which two cameras see hardly anything.

    A smaller or flatter path has smaller third differences: a prior of fixed strength prefers both, and cameras follow
    by turning and, where lenses are free, by zooming (with noise correlated over seconds by metres). So where two
    cameras see the path its third differences d are measured in the metric of the scatter S of its control points:
    sum w dᵀ S⁻¹ d is invariant under affine maps of the path.
    """
    if held.sum() < 4:
        return None
    control_mask = np.zeros(path.basis.size, dtype=np.bool_)
    control_mask[(path.basis.interval_starts()[held, None] + np.arange(SUPPORT)).ravel()] = True
    floor = _MIN_SCATTER_SHARE * float(np.trace(_scatter(path.control[control_mask], 0.0)))
    if not floor > 0.0:
        return None
    differences = third_differences(path.basis, path.control)[held]
    inverse = np.linalg.inv(_scatter(path.control[control_mask], floor))
    plain, metric = float((differences**2).sum()), float(((differences @ inverse) * differences).sum())
    return PathScatter(seen, held, control_mask, floor, plain / metric) if metric > 0.0 else None


def _centred(control: Floats) -> Floats:
    return np.asarray(control - control.mean(axis=0))


def _scatter(control: Floats, floor: float) -> Floats:
    centred = _centred(control)
    return np.asarray(centred.T @ centred / len(centred) + floor * np.eye(3))


def smoothness_cost(path: Trajectory, weight: Floats, scatter: PathScatter | None) -> float:
    """Value of the prior's cost at a path."""
    differences = third_differences(path.basis, path.control)
    return float((_half_gradient(path, differences, weight, scatter)[0] * differences).sum())


def smoothness_terms(path: Trajectory, weight: Floats, scatter: PathScatter | None) -> tuple[Floats, Floats, float]:
    """Band, gradient (3 n,) and value of the prior's cost at a path."""
    differences = third_differences(path.basis, path.control)
    half_gradients, inverse = _half_gradient(path, differences, weight, scatter)
    gradient, value = third_difference_gradient(path.basis, half_gradients), float((half_gradients * differences).sum())
    if scatter is None:
        return third_difference_band(path.basis, weight, np.eye(3)), gradient, value
    control = path.control[scatter.control_mask]
    inside, outside = np.where(scatter.seen, weight, 0.0), np.where(scatter.seen, 0.0, weight)
    moment = (inside[:, None] * differences).T @ differences
    gradient.reshape(-1, 3)[scatter.control_mask] -= (
        scatter.scale / len(control) * _centred(control) @ inverse @ moment @ inverse
    )
    band = third_difference_band(path.basis, inside, np.asarray(scatter.scale * inverse))
    if outside.any():
        band += third_difference_band(path.basis, outside, np.eye(3))
    return band, gradient, value


def deformation_terms(path: Trajectory, weight: Floats, scatter: PathScatter) -> tuple[Floats, Floats]:
    """What `smoothness_terms` holds against projective maps of a path, by its fixed metric alone.

    (3 n, 12) and (12, 12): border and corner, in the normal equations, of the twelve coefficients of a map, in units of
    the path's extent, 0 with std 1. Of a mapped path, the third differences are expected to be mapped too.
    """
    spread = _scatter(path.control[scatter.control_mask], scatter.floor)
    extent, metric = np.sqrt(np.trace(spread)), scatter.scale * np.linalg.inv(spread)
    place = (path.control - path.control[scatter.control_mask].mean(axis=0)) / extent
    maps = [extent * np.outer(one, axis) for one in place.T for axis in np.eye(3)]
    maps += [extent * one[:, None] * place for one in place.T]
    moved = np.stack([third_differences(path.basis, one) for one in maps])
    pull = np.where(scatter.seen, weight, 0.0)[:, None] * (moved @ metric)
    border = np.stack([third_difference_gradient(path.basis, one) for one in pull], axis=1)
    return border, np.eye(len(maps)) + np.einsum("kmi,lmi->kl", pull, moved)


def _half_gradient(
    path: Trajectory, differences: Floats, weight: Floats, scatter: PathScatter | None
) -> tuple[Floats, Floats]:
    """Half the gradient of the cost by the third differences (m, 3) at fixed metric, and the inverse scatter (3, 3)."""
    if scatter is None:
        return weight[:, None] * differences, np.eye(3)
    inverse: Floats = np.asarray(
        np.linalg.inv(_scatter(path.control[scatter.control_mask], scatter.floor)), dtype=np.float64
    )
    half_gradients = np.where(scatter.seen[:, None], differences @ (scatter.scale * inverse), differences)
    return weight[:, None] * half_gradients, inverse
