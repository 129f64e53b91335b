"""One camera's step in the network: block Gauss-Newton over its edges with its neighbours as they say they stand.

A camera's step (6,) is ``rotation <- exp(step[:3]) @ rotation, position <- position + rotationᵀ step[3:]``. Nothing
fixes the gauge (METHODS C, step 5): every term depends on relative poses only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.distributed.factors.factor import Summary
from hub.distributed.factors.linearise import Relative, small_log
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats


def relative(own: Pose, other: Pose) -> Relative:
    """``other`` as ``own`` sees it."""
    return Relative(other.rotation @ own.rotation.T, own.rotation @ (other.position - own.position))


def placed_by(other: Pose, seen: Relative) -> Pose:
    """The camera that sees ``other`` as ``seen`` (METHODS C, step 4)."""
    rotation = seen.rotation.T @ other.rotation
    return Pose(rotation, other.position - rotation.T @ seen.centre)


def moved(pose: Pose, step: Floats) -> Pose:
    """After a step (6,)."""
    return Pose(so3.exp(step[:3]) @ pose.rotation, pose.position + pose.rotation.T @ step[3:])


def step_between(a: Pose, b: Pose) -> Floats:
    """The step (6,) from ``a`` to ``b``."""
    return np.concatenate([small_log(b.rotation @ a.rotation.T), a.rotation @ (b.position - a.position)])


def jacobian(seen: Relative) -> Floats:
    """Derivative (6, 6) of `Relative`'s step by the step of the camera that sees."""
    out = np.zeros((6, 6))
    out[:3, :3] = -seen.rotation
    x, y, z = seen.centre
    # -hat(centre): a turn of the camera carries the neighbour about; a shift takes it back.
    out[3, 1], out[3, 2] = z, -y
    out[4, 0], out[4, 2] = -z, x
    out[5, 0], out[5, 1] = y, -x
    out[3, 3] = out[4, 4] = out[5, 5] = -1.0
    return out


def seen_jacobian(seen: Relative) -> Floats:
    """Derivative (6, 6) of `Relative`'s step by the step of the camera that is seen."""
    out = np.zeros((6, 6))
    out[:3, :3] = np.eye(3)
    out[3:, 3:] = seen.rotation.T
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One edge in a camera's step. other: the neighbour's pose; seen_by: the summary is of how ``other`` sees it."""

    summary: Summary
    other: Pose
    seen_by: bool = False


def one_term(pose: Pose, term: Term) -> tuple[Floats, Floats, Floats]:
    """Derivative (6, 6) of the edge's step e by the camera's, the pull (6,) on e, and e (6,)."""
    summary = term.summary
    raw = relative(term.other, pose) if term.seen_by else relative(pose, term.other)
    seen = summary.rescaled(raw)
    e = summary.anchor.step_to(seen)
    if summary.bearings:
        length = max(float(np.linalg.norm(raw.centre)), 1e-12)
        u = raw.centre / length
        by_step = seen_jacobian(raw) if term.seen_by else jacobian(raw)
        across = by_step[3:] - np.outer(u, u @ by_step[3:])  # along the baseline nothing is told
        by_step[3:] = across * (float(np.linalg.norm(seen.centre)) / length)
    else:
        by_step = seen_jacobian(seen) if term.seen_by else jacobian(seen)
    return by_step, summary.hessian @ e + summary.gradient, e


def normal_equations(pose: Pose, terms: list[Term]) -> tuple[Floats, Floats]:
    """Information (6, 6) and gradient (6,) of half chi2 by this camera's step: `one_term` over all, stacked."""
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    sized = [term for term in terms if not term.summary.bearings]
    if sized:
        hessian, gradient = _stacked_terms(pose, sized)
    for term in terms:
        if term.summary.bearings:
            by_step, pull, _ = one_term(pose, term)
            hessian = hessian + by_step.T @ term.summary.hessian @ by_step
            gradient = gradient + by_step.T @ pull
    return hessian, gradient


def _stacked_terms(pose: Pose, terms: list[Term]) -> tuple[Floats, Floats]:
    information = np.array([term.summary.hessian for term in terms])
    others = np.array([term.other.rotation for term in terms])
    apart = np.array([term.other.position for term in terms]) - pose.position
    seen_by = np.array([term.seen_by for term in terms])
    # As `relative` has them, of the one that sees.
    rotation = others @ pose.rotation.T
    centre = apart @ pose.rotation.T
    rotation[seen_by] = rotation[seen_by].transpose(0, 2, 1)
    centre[seen_by] = -np.einsum("nij,nj->ni", others[seen_by], apart[seen_by])
    anchor = np.array([term.summary.anchor.rotation for term in terms])
    e = np.empty((len(terms), 6))
    turned = rotation @ anchor.transpose(0, 2, 1)
    for i, turn in enumerate(turned):
        e[i, :3] = small_log(turn)
    e[:, 3:] = centre - np.array([term.summary.anchor.centre for term in terms])
    by_step = np.zeros((len(terms), 6, 6))
    by_step[:, :3, :3] = -rotation
    by_step[:, 3, 1], by_step[:, 3, 2] = centre[:, 2], -centre[:, 1]
    by_step[:, 4, 0], by_step[:, 4, 2] = -centre[:, 2], centre[:, 0]
    by_step[:, 5, 0], by_step[:, 5, 1] = centre[:, 1], -centre[:, 0]
    by_step[:, 3, 3] = by_step[:, 4, 4] = by_step[:, 5, 5] = -1.0
    by_step[seen_by] = 0.0
    by_step[seen_by, 0, 0] = by_step[seen_by, 1, 1] = by_step[seen_by, 2, 2] = 1.0
    by_step[seen_by, 3:, 3:] = rotation[seen_by].transpose(0, 2, 1)
    pull = (information @ e[:, :, None])[:, :, 0] + np.array([term.summary.gradient for term in terms])
    turned_step = by_step.transpose(0, 2, 1)
    hessian = (turned_step @ information @ by_step).sum(axis=0)
    gradient = (turned_step @ pull[:, :, None]).sum(axis=0)[:, 0]
    return hessian, gradient


def ray_meeting(others: list[tuple[Pose, Floats]], rotation: Floats) -> tuple[Floats, float] | None:
    """Where lines to ``others`` meet: position (3,) and the largest sine between two lines; None if parallel.

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
