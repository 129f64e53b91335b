"""Block Gauss-Newton step of one camera over its factors, with the neighbours' poses held at their published values.

A camera's step (6,) is ``rotation <- exp(step[:3]) @ rotation, position <- position + rotationᵀ step[3:]``. The gauge
stays free (distributed pose paper, step 5): every term depends on relative poses only.

And the marginal position covariances of all cameras, from the factors of all edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hub.bundle.block_matrix import BlockSum
from hub.bundle.covariance import gauge_constraints
from hub.bundle.problem import CAMERA_PARAMETERS
from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.factors.two_view_model import RelativeTransform, small_log
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats

_MIN_OBSERVATIONS = 50.0
"""Observations from which the residuals determine the variance factor."""
_SINGULAR = 1e-12  # relative eigenvalue, below which a direction is not determined


def relative_transform(own: Pose, other: Pose) -> RelativeTransform:
    """``other`` relative to ``own``."""
    return RelativeTransform(other.rotation @ own.rotation.T, own.rotation @ (other.position - own.position))


def pose_from_relative(other: Pose, seen: RelativeTransform) -> Pose:
    """Pose of the camera relative to which ``other`` is ``seen`` (distributed pose paper, step 4)."""
    rotation = seen.rotation.T @ other.rotation
    return Pose(rotation, other.position - rotation.T @ seen.centre)


def retract(pose: Pose, step: Floats) -> Pose:
    """The pose after a step (6,)."""
    return Pose(so3.exp(step[:3]) @ pose.rotation, pose.position + pose.rotation.T @ step[3:])


def local_coordinates(a: Pose, b: Pose) -> Floats:
    """The step (6,) from ``a`` to ``b``."""
    return np.concatenate([small_log(b.rotation @ a.rotation.T), a.rotation @ (b.position - a.position)])


def observer_jacobian(seen: RelativeTransform) -> Floats:
    """Jacobian (6, 6) of the `RelativeTransform`'s step by the step of the observing camera."""
    out = np.zeros((6, 6))
    out[:3, :3] = -seen.rotation
    x, y, z = seen.centre
    # -hat(centre): rotating the camera rotates the neighbour's centre; translating it shifts the centre back.
    out[3, 1], out[3, 2] = z, -y
    out[4, 0], out[4, 2] = -z, x
    out[5, 0], out[5, 1] = y, -x
    out[3, 3] = out[4, 4] = out[5, 5] = -1.0
    return out


def observed_jacobian(seen: RelativeTransform) -> Floats:
    """Jacobian (6, 6) of the `RelativeTransform`'s step by the step of the observed camera."""
    out = np.zeros((6, 6))
    out[:3, :3] = np.eye(3)
    out[3:, 3:] = seen.rotation.T
    return out


@dataclass(frozen=True, slots=True, eq=False)
class FactorTerm:
    """One edge in a camera's step. other: the neighbour's pose; seen_by: the summary is of how ``other`` sees it."""

    factor: QuadraticFactor
    other: Pose
    reverse: bool = False


def linearise_term(pose: Pose, term: FactorTerm) -> tuple[Floats, Floats, Floats]:
    """Jacobian (6, 6) of the factor's residual e by the camera's step, the gradient (6,) by e, and e (6,)."""
    factor = term.factor
    raw = relative_transform(term.other, pose) if term.reverse else relative_transform(pose, term.other)
    seen = factor.rescaled(raw)
    e = factor.anchor.local_coordinates(seen)
    if factor.bearings:
        length = max(float(np.linalg.norm(raw.centre)), 1e-12)
        u = raw.centre / length
        by_step = observed_jacobian(raw) if term.reverse else observer_jacobian(raw)
        across = by_step[3:] - np.outer(u, u @ by_step[3:])  # no information along the baseline
        by_step[3:] = across * (float(np.linalg.norm(seen.centre)) / length)
    else:
        by_step = observed_jacobian(seen) if term.reverse else observer_jacobian(seen)
    return by_step, factor.hessian @ e + factor.gradient, e


def normal_equations(pose: Pose, terms: list[FactorTerm]) -> tuple[Floats, Floats]:
    """Information (6, 6) and gradient (6,) of half chi2 by this camera's step, summed over all terms."""
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    sized = [term for term in terms if not term.factor.bearings]
    if sized:
        hessian, gradient = _stacked_normal_equations(pose, sized)
    for term in terms:
        if term.factor.bearings:
            by_step, pull, _ = linearise_term(pose, term)
            hessian = hessian + by_step.T @ term.factor.hessian @ by_step
            gradient = gradient + by_step.T @ pull
    return hessian, gradient


def _stacked_normal_equations(pose: Pose, terms: list[FactorTerm]) -> tuple[Floats, Floats]:
    information = np.array([term.factor.hessian for term in terms])
    others = np.array([term.other.rotation for term in terms])
    apart = np.array([term.other.position for term in terms]) - pose.position
    reverse = np.array([term.reverse for term in terms])
    # As in `relative_transform`, of the observing camera.
    rotation = others @ pose.rotation.T
    centre = apart @ pose.rotation.T
    rotation[reverse] = rotation[reverse].transpose(0, 2, 1)
    centre[reverse] = -np.einsum("nij,nj->ni", others[reverse], apart[reverse])
    anchor = np.array([term.factor.anchor.rotation for term in terms])
    e = np.empty((len(terms), 6))
    turned = rotation @ anchor.transpose(0, 2, 1)
    for i, turn in enumerate(turned):
        e[i, :3] = small_log(turn)
    e[:, 3:] = centre - np.array([term.factor.anchor.centre for term in terms])
    by_step = np.zeros((len(terms), 6, 6))
    by_step[:, :3, :3] = -rotation
    by_step[:, 3, 1], by_step[:, 3, 2] = centre[:, 2], -centre[:, 1]
    by_step[:, 4, 0], by_step[:, 4, 2] = -centre[:, 2], centre[:, 0]
    by_step[:, 5, 0], by_step[:, 5, 1] = centre[:, 1], -centre[:, 0]
    by_step[:, 3, 3] = by_step[:, 4, 4] = by_step[:, 5, 5] = -1.0
    by_step[reverse] = 0.0
    by_step[reverse, 0, 0] = by_step[reverse, 1, 1] = by_step[reverse, 2, 2] = 1.0
    by_step[reverse, 3:, 3:] = rotation[reverse].transpose(0, 2, 1)
    pull = (information @ e[:, :, None])[:, :, 0] + np.array([term.factor.gradient for term in terms])
    turned_step = by_step.transpose(0, 2, 1)
    hessian = (turned_step @ information @ by_step).sum(axis=0)
    gradient = (turned_step @ pull[:, :, None]).sum(axis=0)[:, 0]
    return hessian, gradient


def intersect_rays(others: list[tuple[Pose, Floats]], rotation: Floats) -> tuple[Floats, float] | None:
    """Intersection of the rays to ``others``: position (3,) and the largest sine between two rays; None if parallel.

    others: neighbours' poses and the unit directions (3,) to them in the camera's axes.
    """
    normal, right, rays = np.zeros((3, 3)), np.zeros(3), []
    for pose, direction in others:
        ray = rotation.T @ direction
        flat = np.eye(3) - np.outer(ray, ray)
        normal += flat
        right += flat @ pose.position
        rays.append(ray)
    sine = max(float(np.linalg.norm(np.cross(a, b))) for a in rays for b in rays)
    if sine < 0.05:
        return None
    position = np.asarray(np.linalg.solve(normal, right), np.float64)
    ahead = all(float((pose.position - position) @ ray) > 0 for (pose, _), ray in zip(others, rays, strict=True))
    return (position, sine) if ahead else None


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
