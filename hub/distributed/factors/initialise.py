"""Initial relative pose of two cameras by RANSAC from a few shared observations (distributed pose paper, step 2)."""

from __future__ import annotations

import cv2
import numpy as np

from hub.distributed.factors.two_view_model import LinearisedObservations, RelativeTransform, linearise_observations
from hub.two_view.relative_pose import decompose_essential
from protocols.geometry import so3
from protocols.geometry.pose import fit_similarity
from protocols.geometry.types import Bools, Floats

MIN_SIZED_OBSERVATIONS = 12
"""Shared observations with sizes needed for an initialisation."""
MIN_BEARINGS = 24  # five determine a relative pose; RANSAC wants a margin
CHI2_GATE = 21.1
"""Chi2 of one observation (3 dof with sizes) above which it is an outlier."""
CHI2_GATE_BEARINGS = 15.1  # quantile 1e-4 of one degree of freedom
_RANSAC_TRIALS = 60  # finds five inliers of 60 % with 99 %
_MAX_ITERATIONS = 12  # a bound: it stops where the cost hardly decreases
_MIN_INLIER_SHARE = 0.6
"""Share of inliers below which an initialisation fails."""
_MIN_EIGENVALUE = 1e-9  # keeps the normal matrix invertible


def chi2_gates(weights: Floats) -> Floats:
    """Chi2 gate (n,) of observations with weights (n, 4): 3 dof with two sizes, 1 without."""
    sizes = (weights[:, 1] > 0).astype(float) + (weights[:, 3] > 0)
    return np.where(
        sizes >= 2, CHI2_GATE, np.where(sizes >= 1, 0.5 * (CHI2_GATE + CHI2_GATE_BEARINGS), CHI2_GATE_BEARINGS)
    )


def estimate_relative_pose(
    rows: Floats, weights: Floats, rng: np.random.Generator
) -> tuple[RelativeTransform, Bools] | None:
    """The relative pose (two-view maximum likelihood) and inliers (n,); None if too few observations agree.

    With sizes: RANSAC over triples of points X = [x; y; 1] / size, Procrustes (eqs. 16 to 19). With bearings only:
    five-point RANSAC with cheirality; the baseline is 1.
    """
    sized = (weights[:, 1] > 0) & (weights[:, 3] > 0)
    if sized.sum() >= MIN_SIZED_OBSERVATIONS and sized.mean() > 0.5:
        starts = _ransac_points(rows[sized], weights[sized], rng)
    elif len(rows) >= MIN_BEARINGS:
        starts = _ransac_bearings(rows, weights, int(rng.integers(2**31)))
    else:
        return None
    best: tuple[float, RelativeTransform, Bools] | None = None
    bearings = not sized.any()
    for start in starts:
        pose = refine(start, rows, weights, bearings)
        terms = linearise_observations(pose, rows, weights)
        gate = chi2_gates(weights)
        inlier = terms.in_front & (terms.chi2 < gate)
        score = float(np.where(inlier, terms.chi2, gate).sum())
        if best is None or score < best[0]:
            best = (score, pose, np.asarray(inlier))
    if best is None or best[2].mean() < _MIN_INLIER_SHARE:
        return None
    return best[1], best[2]


def refine(pose: RelativeTransform, rows: Floats, weights: Floats, bearings: bool) -> RelativeTransform:
    """Two-view Levenberg-Marquardt with a robust cost beyond the gate and the points eliminated."""
    gate = chi2_gates(weights)
    damping = 1e-3
    cost, terms = _robust_cost(pose, rows, weights, gate)
    for _ in range(_MAX_ITERATIONS):
        hessian, gradient = robust_sums(terms, gate)
        trial = _with_unit_baseline(pose.retract(levenberg_marquardt_step(hessian, gradient, damping)), bearings)
        trial_cost, trial_terms = _robust_cost(trial, rows, weights, gate)
        if trial_cost < cost:
            gain = cost - trial_cost
            pose, cost, terms = trial, trial_cost, trial_terms
            damping = max(damping * 0.1, 1e-9)
            if gain < 1e-6 * max(cost, 1.0):
                break
        else:
            damping = max(damping * 10.0, 1e-6)
    return pose


def _with_unit_baseline(pose: RelativeTransform, bearings: bool) -> RelativeTransform:
    """The pose; with bearings only, its baseline is normalised to 1."""
    if not bearings:
        return pose
    return RelativeTransform(pose.rotation, pose.centre / max(float(np.linalg.norm(pose.centre)), 1e-12))


def robust_weight(terms: LinearisedObservations, gate: Floats) -> Floats:
    """Weights (n,): 1 up to the gate, then decreasing with the square of chi2; 0 behind a camera."""
    return np.where(terms.in_front, np.minimum(1.0, gate / np.maximum(terms.chi2, 1e-12)) ** 2, 0.0)


def robust_cost(terms: LinearisedObservations, gate: Floats) -> float:
    """Half the robust chi2 of all observations, corresponding to the weights `robust_weight`."""
    far = 2.0 * gate - gate * gate / np.maximum(terms.chi2, gate)
    return 0.5 * float(np.where(terms.in_front, np.where(terms.chi2 < gate, terms.chi2, far), 2.0 * gate).sum())


def robust_sums(terms: LinearisedObservations, gate: Floats) -> tuple[Floats, Floats]:
    """Robust sums of the Hessians (6, 6) and gradients (6,)."""
    weight = robust_weight(terms, gate)
    return np.einsum("n,nij->ij", weight, terms.hessian), weight @ terms.gradient


def levenberg_marquardt_step(hessian: Floats, gradient: Floats, damping: float) -> Floats:
    """Levenberg-Marquardt step (6,)."""
    diagonal = np.maximum(np.diag(hessian), 1e-12 * max(float(np.trace(hessian)), 1e-300))
    return np.asarray(-np.linalg.solve(hessian + np.diag(diagonal * damping + _MIN_EIGENVALUE), gradient))


def _robust_cost(
    pose: RelativeTransform, rows: Floats, weights: Floats, gate: Floats
) -> tuple[float, LinearisedObservations]:
    terms = linearise_observations(pose, rows, weights)
    return 2.0 * robust_cost(terms, gate), terms


def _ransac_points(rows: Floats, weights: Floats, rng: np.random.Generator) -> list[RelativeTransform]:
    """RANSAC over point triples: the best two Procrustes fits, refitted to their inliers."""
    points_k = np.column_stack([rows[:, 0:2], np.ones(len(rows))]) * np.exp(-rows[:, 2])[:, None]
    points_l = np.column_stack([rows[:, 3:5], np.ones(len(rows))]) * np.exp(-rows[:, 5])[:, None]
    # The std of a point is along its ray, from the relative std of the size.
    spread = np.hypot(
        np.linalg.norm(points_k, axis=1) / np.maximum(weights[:, 1], 1e-9),
        np.linalg.norm(points_l, axis=1) / np.maximum(weights[:, 3], 1e-9),
    )
    found: list[tuple[float, RelativeTransform]] = []
    for _ in range(_RANSAC_TRIALS):
        pick = rng.choice(len(rows), 3, replace=False)
        fit = procrustes(points_k[pick], points_l[pick])
        off = np.linalg.norm((points_k - fit.centre) @ fit.rotation.T - points_l, axis=1) / spread
        found.append((float(np.minimum(off, 6.0).sum()), fit))
    found.sort(key=lambda item: item[0])
    out = []
    for _, fit in found[:2]:
        off = np.linalg.norm((points_k - fit.centre) @ fit.rotation.T - points_l, axis=1) / spread
        near = off < max(6.0, float(np.median(off)))
        out.append(procrustes(points_k[near], points_l[near], 1.0 / spread[near] ** 2))
    return out


def resect(
    points_k: Floats, points_world: Floats, spread: Floats, rng: np.random.Generator
) -> RelativeTransform | None:
    """Resection: pose of a camera from its points ``points_k`` (n, 3) and neighbours' ``points_world`` (n, 3), n >= 12.

    For a camera that shares too few observations with any single neighbour. spread: std of the
    point distances (n,). The result's ``centre`` is the camera's position, its ``rotation`` camera from world. None if
    too few observations agree.
    """
    if len(points_k) < MIN_SIZED_OBSERVATIONS:
        return None
    best, best_support = None, 0.0
    for _ in range(_RANSAC_TRIALS):
        pick = rng.choice(len(points_k), 3, replace=False)
        fit = procrustes(points_world[pick], points_k[pick])
        off = np.linalg.norm((points_world - fit.centre) @ fit.rotation.T - points_k, axis=1) / spread
        inlier_support = float(np.maximum(1.0 - (off / 6.0) ** 2, 0.0).sum())
        if inlier_support > best_support:
            best, best_support = off < 6.0, inlier_support
    if best is None or best.mean() < _MIN_INLIER_SHARE:
        return None
    return procrustes(points_world[best], points_k[best], 1.0 / spread[best] ** 2)


def procrustes(points_k: Floats, points_l: Floats, weights: Floats | None = None) -> RelativeTransform:
    """Procrustes: the rigid motion from points in k's axes (n, 3) to l's (distributed pose paper, eqs. 15 to 19)."""
    fit = fit_similarity(points_k, points_l, weights=weights, scale=False)
    return RelativeTransform(fit.rotation, -fit.rotation.T @ fit.shift)


def _ransac_bearings(rows: Floats, weights: Floats, seed: int) -> list[RelativeTransform]:
    a, b = np.ascontiguousarray(rows[:, 0:2]), np.ascontiguousarray(rows[:, 3:5])
    threshold = 2.5 / float(np.median(weights[:, [0, 2]]))
    cv2.setRNGSeed(seed)
    found = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=threshold, maxIters=500)[0]
    if found is None:
        return []
    out = []
    for matrix in np.asarray(found, dtype=np.float64).reshape(-1, 3, 3):
        if np.isfinite(matrix).all():
            pose = decompose_essential(matrix, a, b)  # X_l = rotation X_k + direction
            out.append(RelativeTransform(so3.nearest(pose.rotation), -pose.rotation.T @ pose.direction))
    return out
