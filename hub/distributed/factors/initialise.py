"""How an edge begins: the relative pose of two cameras from a handful of shared observations (METHODS C, step 2)."""

from __future__ import annotations

import cv2
import numpy as np

from hub.distributed.factors.linearise import Relative, Terms, linearise
from hub.two_view.relative_pose import decompose
from protocols.geometry import so3
from protocols.geometry.types import Bools, Floats

LEAST = 12
"""Shared observations that an edge needs to begin by itself, with sizes."""
LEAST_BEARINGS = 24
GATE = 21.1
"""Chi2 of one observation (3 dof with sizes), beyond which it is an outlier."""
GATE_BEARINGS = 15.1
_TRIES = 60
_NEWTON = 12
_LEAST_SHARE = 0.6
"""Share of inliers below which an edge doesn't begin."""
_LEAST_EIGENVALUE = 1e-9


def gate_of(weights: Floats) -> Floats:
    """The gate (n,) of observations with weights (n, 4): with two sizes there are 3 dof, with none 1."""
    sizes = (weights[:, 1] > 0).astype(float) + (weights[:, 3] > 0)
    return np.where(sizes >= 2, GATE, np.where(sizes >= 1, 0.5 * (GATE + GATE_BEARINGS), GATE_BEARINGS))


def begin(rows: Floats, weights: Floats, rng: np.random.Generator) -> tuple[Relative, Bools] | None:
    """The relative pose (two-view maximum likelihood) and the inliers (n,); None if too few observations agree.

    With sizes: RANSAC over triples of points X = [x; y; 1] / size, Procrustes (eqs. 16 to 19). With bearings only:
    five-point RANSAC with cheirality; the baseline is 1.
    """
    sized = (weights[:, 1] > 0) & (weights[:, 3] > 0)
    if sized.sum() >= LEAST and sized.mean() > 0.5:
        starts = _by_sizes(rows[sized], weights[sized], rng)
    elif len(rows) >= LEAST_BEARINGS:
        starts = _by_bearings(rows, weights, int(rng.integers(2**31)))
    else:
        return None
    best: tuple[float, Relative, Bools] | None = None
    bearings = not sized.any()
    for start in starts:
        pose = refine(start, rows, weights, bearings)
        terms = linearise(pose, rows, weights)
        gate = gate_of(weights)
        inlier = terms.ahead & (terms.chi2 < gate)
        score = float(np.where(inlier, terms.chi2, gate).sum())
        if best is None or score < best[0]:
            best = (score, pose, np.asarray(inlier))
    if best is None or best[2].mean() < _LEAST_SHARE:
        return None
    return best[1], best[2]


def refine(pose: Relative, rows: Floats, weights: Floats, bearings: bool) -> Relative:
    """Two-view Gauss-Newton, robust from the gate on, with the points eliminated."""
    gate = gate_of(weights)
    damping = 1e-3
    cost, terms = _robust_cost(pose, rows, weights, gate)
    for _ in range(_NEWTON):
        hessian, gradient = total(terms, gate)
        trial = _kept(pose.moved(solve_damped(hessian, gradient, damping)), bearings)
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


def _kept(pose: Relative, bearings: bool) -> Relative:
    """With bearings only the baseline stays 1."""
    if not bearings:
        return pose
    return Relative(pose.rotation, pose.centre / max(float(np.linalg.norm(pose.centre)), 1e-12))


def robust_weight(terms: Terms, gate: Floats) -> Floats:
    """1 up to the gate, then falling with the square of chi2 (n,): far outliers pull nothing; 0 behind a camera."""
    return np.where(terms.ahead, np.minimum(1.0, gate / np.maximum(terms.chi2, 1e-12)) ** 2, 0.0)


def loss(terms: Terms, gate: Floats) -> float:
    """Half the robust chi2 of all observations, whose weight `robust_weight` is."""
    far = 2.0 * gate - gate * gate / np.maximum(terms.chi2, gate)
    return 0.5 * float(np.where(terms.ahead, np.where(terms.chi2 < gate, terms.chi2, far), 2.0 * gate).sum())


def total(terms: Terms, gate: Floats) -> tuple[Floats, Floats]:
    """Robust sums of the Hessians (6, 6) and gradients (6,)."""
    weight = robust_weight(terms, gate)
    return np.einsum("n,nij->ij", weight, terms.hessian), weight @ terms.gradient


def solve_damped(hessian: Floats, gradient: Floats, damping: float) -> Floats:
    """Levenberg-Marquardt's step."""
    diagonal = np.maximum(np.diag(hessian), 1e-12 * max(float(np.trace(hessian)), 1e-300))
    return np.asarray(-np.linalg.solve(hessian + np.diag(diagonal * damping + _LEAST_EIGENVALUE), gradient))


def _robust_cost(pose: Relative, rows: Floats, weights: Floats, gate: Floats) -> tuple[float, Terms]:
    terms = linearise(pose, rows, weights)
    return 2.0 * loss(terms, gate), terms


def _by_sizes(rows: Floats, weights: Floats, rng: np.random.Generator) -> list[Relative]:
    """The best two of many Procrustes fits to triples, then to their inliers."""
    points_k = np.column_stack([rows[:, 0:2], np.ones(len(rows))]) * np.exp(-rows[:, 2])[:, None]
    points_l = np.column_stack([rows[:, 3:5], np.ones(len(rows))]) * np.exp(-rows[:, 5])[:, None]
    # A size's relative std is what spreads the points, along their rays.
    spread = np.hypot(
        np.linalg.norm(points_k, axis=1) / np.maximum(weights[:, 1], 1e-9),
        np.linalg.norm(points_l, axis=1) / np.maximum(weights[:, 3], 1e-9),
    )
    found: list[tuple[float, Relative]] = []
    for _ in range(_TRIES):
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


def resect(points_k: Floats, points_world: Floats, spread: Floats, rng: np.random.Generator) -> Relative | None:
    """The pose of a camera that saw ``points_k`` (n, 3) where placed neighbours saw ``points_world`` (n, 3), n >= 12.

    For a camera that shares too little with any one neighbour. spread: std of their distance (n,). The result's
    ``centre`` is the camera's position, its ``rotation`` camera from world. None if too few agree.
    """
    if len(points_k) < LEAST:
        return None
    best, most = None, 0.0
    for _ in range(_TRIES):
        pick = rng.choice(len(points_k), 3, replace=False)
        fit = procrustes(points_world[pick], points_k[pick])
        off = np.linalg.norm((points_world - fit.centre) @ fit.rotation.T - points_k, axis=1) / spread
        agree = float(np.maximum(1.0 - (off / 6.0) ** 2, 0.0).sum())
        if agree > most:
            best, most = off < 6.0, agree
    if best is None or best.mean() < _LEAST_SHARE:
        return None
    return procrustes(points_world[best], points_k[best], 1.0 / spread[best] ** 2)


def procrustes(points_k: Floats, points_l: Floats, weights: Floats | None = None) -> Relative:
    """The rigid motion that takes points in k's axes (n, 3) to l's (eqs. 15 to 19)."""
    w = np.ones(len(points_k)) if weights is None else weights
    w = w / w.sum()
    mean_k, mean_l = w @ points_k, w @ points_l
    u, _, vt = np.linalg.svd((w[:, None] * (points_l - mean_l)).T @ (points_k - mean_k))
    rotation = (u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])) @ vt
    return Relative(rotation, mean_k - rotation.T @ mean_l)


def _by_bearings(rows: Floats, weights: Floats, seed: int) -> list[Relative]:
    a, b = np.ascontiguousarray(rows[:, 0:2]), np.ascontiguousarray(rows[:, 3:5])
    threshold = 2.5 / float(np.median(weights[:, [0, 2]]))
    cv2.setRNGSeed(seed)
    found = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=threshold, maxIters=500)[0]
    if found is None:
        return []
    out = []
    for matrix in np.asarray(found, dtype=np.float64).reshape(-1, 3, 3):
        if np.isfinite(matrix).all():
            pose = decompose(matrix, a, b)  # X_l = rotation X_k + direction
            out.append(Relative(so3.nearest(pose.rotation), -pose.rotation.T @ pose.direction))
    return out
