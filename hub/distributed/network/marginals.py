"""Marginal position covariances of the network's cameras, from the factors of all edges."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hub.bundle.block_matrix import BlockSum
from hub.bundle.covariance import gauge_constraints
from hub.bundle.problem import CAMERA_PARAMETERS
from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.network.block_solver import FactorTerm, linearise_term, relative_transform
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats

_MIN_OBSERVATIONS = 50.0
"""Observations from which the residuals determine the variance factor."""
_SINGULAR = 1e-12  # relative eigenvalue, below which a direction is not determined

Edges = Mapping[tuple[str, str], QuadraticFactor]
"""By pair, the camera with the lower number (and name) first, as parametrised in `hub.distributed.factors.factor`."""


def merge_duplicate_factors(
    factors: Mapping[str, Mapping[str, QuadraticFactor]],
) -> dict[tuple[str, str], QuadraticFactor]:
    """One factor per edge: both ends contain the same observations, so the one with more of them is used."""
    out: dict[tuple[str, str], QuadraticFactor] = {}
    for camera, edges in factors.items():
        for other, factor in edges.items():
            pair = (min(camera, other), max(camera, other))
            if pair not in out or out[pair].count < factor.count:
                out[pair] = factor
    return out


def connected_cameras(names: list[str], edges: Edges) -> set[str]:
    """Cameras connected to the first of ``names`` by edges, directly or through others."""
    found, growing = {names[0]}, True
    while growing:
        more = {c for pair in edges if found & set(pair) for c in pair if c in names}
        growing = not more <= found
        found |= more
    return found


def position_stds(
    poses: Mapping[str, Pose], edges: Edges, world: Similarity, control_information: BlockSum
) -> dict[str, Floats]:
    """Std (3,) of each camera's position in the world, from the joint covariance over all cameras and edges.

    poses: in the network's frame; all connected by ``edges``. world: world from network. control_information:
    (18 n, 18 n) of the rig's control points, in the order of ``poses``; the gauge that it leaves free is fixed by the
    first camera and the first baseline. The stds are scaled by the variance factor (chi2 over its expectation).
    Infinite where the edges do not determine a camera.
    """
    names = list(poses)
    at = {name: i for i, name in enumerate(names)}
    # The last unknown is the logarithm of the target's size, the length unit of all edges with sizes.
    information = np.zeros((6 * len(names) + 1,) * 2)
    chi2 = dof = 0.0
    for (own, other), factor in edges.items():
        if own not in at or other not in at:
            continue
        columns = np.r_[6 * at[own] : 6 * at[own] + 6, 6 * at[other] : 6 * at[other] + 6, -1]
        by_own = linearise_term(poses[own], FactorTerm(factor, poses[other]))[0]
        by_other = linearise_term(poses[other], FactorTerm(factor, poses[own], reverse=True))[0]
        by_size = np.zeros((6, 1))
        if not factor.bearings:
            by_size[3:, 0] = -relative_transform(poses[own], poses[other]).centre
        by_step = np.concatenate(
            [
                by_own @ _world_step_jacobian(poses[own], world),
                by_other @ _world_step_jacobian(poses[other], world),
                by_size,
            ],
            axis=1,
        )
        information[np.ix_(columns, columns)] += by_step.T @ factor.hessian @ by_step
        chi2 += factor.chi2
        dof += factor.count * (1.0 if factor.bearings else 3.0)
    if chi2 > 0.0 and dof > _MIN_OBSERVATIONS:
        information *= dof / chi2
    pose_columns = np.concatenate([CAMERA_PARAMETERS * i + np.arange(6) for i in range(len(names))])
    constraints = gauge_constraints([world.pose(pose) for pose in poses.values()], control_information)[:, pose_columns]
    constraints = np.concatenate([constraints, np.zeros((len(constraints), 1))], axis=1)
    information[:-1, :-1] += control_information.restricted(pose_columns).dense()
    variance = _constrained_variances(information, constraints)
    return {name: np.sqrt(variance[6 * i + 3 : 6 * i + 6]) for name, i in at.items()}


def _world_step_jacobian(pose: Pose, world: Similarity) -> Floats:
    """Jacobian (6, 6) of a camera's step by its rotation and translation in the world."""
    out = np.eye(6)
    out[3:, 3:] = pose.rotation @ world.rotation.T / world.scale
    return out


def _constrained_variances(information: Floats, constraints: Floats) -> Floats:
    """Diagonal of the inverse subject to ``constraints @ step = 0``; infinite where undetermined."""
    tangent = np.eye(len(information)) if not len(constraints) else np.linalg.svd(constraints)[2][len(constraints) :].T
    inside = tangent.T @ information @ tangent
    scale = 1.0 / np.sqrt(np.maximum(inside.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(inside * scale * scale[:, None])
    spread = tangent @ (scale[:, None] * vectors)
    unknown = values < _SINGULAR
    out = (spread[:, ~unknown] ** 2) @ (1.0 / values[~unknown])
    lost = (spread[:, unknown] ** 2).sum(axis=1) > 1e-9 * np.maximum(out, 1e-300)
    return np.where(lost, np.inf, np.where(out > 1e-20 * out.max(initial=0.0), out, 0.0))
