"""How well the network knows where each camera stands: stds from what all edges have learnt."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hub.bundle.covariance import held_rows
from hub.bundle.problem import CAMERA_PARAMETERS
from hub.distributed.factors.factor import Summary
from hub.distributed.network.block_solver import Term, one_term, relative
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats

_LEAST_OBSERVATIONS = 50.0
"""Observations from which what they left over tells the noise."""
_SINGULAR = 1e-12

Edges = Mapping[tuple[str, str], Summary]
"""By pair, the camera with the lower number (and name) first, as `hub.distributed.factors.factor` writes it."""


def each_once(learnt: Mapping[str, Mapping[str, Summary]]) -> dict[tuple[str, str], Summary]:
    """Both ends of an edge have learnt from the same observations: the end that counts more speaks for it."""
    out: dict[tuple[str, str], Summary] = {}
    for camera, edges in learnt.items():
        for other, summary in edges.items():
            pair = (min(camera, other), max(camera, other))
            if pair not in out or out[pair].count < summary.count:
                out[pair] = summary
    return out


def joined(names: list[str], edges: Edges) -> set[str]:
    """Cameras that edges tie to the first of ``names``, directly or through others."""
    found, grown = {names[0]}, True
    while grown:
        more = {c for pair in edges if found & set(pair) for c in pair if c in names}
        grown = not more <= found
        found |= more
    return found


def position_stds(poses: Mapping[str, Pose], edges: Edges, world: Similarity, references: Floats) -> dict[str, Floats]:
    """Std (3,) of each camera's position in the world, all cameras and edges solved for together.

    poses: in the network's frame; all tied by ``edges``. world: world from network. references: (18 n, 18 n) what the
    rig tells, in the order of ``poses``; the gauge that it leaves open is held by the first camera and the first
    baseline. Where the observations leave over more or less than they should, the stds grow or shrink with it.
    Infinite where the edges don't fix a camera.
    """
    names = list(poses)
    at = {name: i for i, name in enumerate(names)}
    # The last unknown is the logarithm of the target's size, the unit of all edges with sizes.
    information = np.zeros((6 * len(names) + 1,) * 2)
    chi2 = dof = 0.0
    for (own, other), summary in edges.items():
        if own not in at or other not in at:
            continue
        columns = np.r_[6 * at[own] : 6 * at[own] + 6, 6 * at[other] : 6 * at[other] + 6, -1]
        by_own = one_term(poses[own], Term(summary, poses[other]))[0]
        by_other = one_term(poses[other], Term(summary, poses[own], seen_by=True))[0]
        by_size = np.zeros((6, 1))
        if not summary.bearings:
            by_size[3:, 0] = -relative(poses[own], poses[other]).centre
        by_step = np.concatenate(
            [by_own @ _step_of(poses[own], world), by_other @ _step_of(poses[other], world), by_size], axis=1
        )
        information[np.ix_(columns, columns)] += by_step.T @ summary.hessian @ by_step
        chi2 += summary.chi2
        dof += summary.count * (1.0 if summary.bearings else 3.0)
    if chi2 > 0.0 and dof > _LEAST_OBSERVATIONS:
        information *= dof / chi2
    wide = np.concatenate([CAMERA_PARAMETERS * i + np.arange(6) for i in range(len(names))])
    held = held_rows([world.pose(pose) for pose in poses.values()], references)[:, wide]
    held = np.concatenate([held, np.zeros((len(held), 1))], axis=1)
    information[:-1, :-1] += references[np.ix_(wide, wide)]
    variance = _variances(information, held)
    return {name: np.sqrt(variance[6 * i + 3 : 6 * i + 6]) for name, i in at.items()}


def _step_of(pose: Pose, world: Similarity) -> Floats:
    """Derivative (6, 6) of a camera's step by its turn and its shift in the world."""
    out = np.eye(6)
    out[3:, 3:] = pose.rotation @ world.rotation.T / world.scale
    return out


def _variances(information: Floats, held: Floats) -> Floats:
    """Diagonal of the inverse where ``held @ step`` is 0; infinite where nothing is known."""
    tangent = np.eye(len(information)) if not len(held) else np.linalg.svd(held)[2][len(held) :].T
    inside = tangent.T @ information @ tangent
    scale = 1.0 / np.sqrt(np.maximum(inside.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(inside * scale * scale[:, None])
    spread = tangent @ (scale[:, None] * vectors)
    unknown = values < _SINGULAR
    out = (spread[:, ~unknown] ** 2) @ (1.0 / values[~unknown])
    lost = (spread[:, unknown] ** 2).sum(axis=1) > 1e-9 * np.maximum(out, 1e-300)
    return np.where(lost, np.inf, np.where(out > 1e-20 * out.max(initial=0.0), out, 0.0))
