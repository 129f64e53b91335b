"""Localisation of a camera in its neighbours' frame: its initial pose (distributed pose paper, step 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hub.distributed.factors.factor import Edge
from hub.distributed.factors.initialise import resect
from hub.distributed.network.block_solver import intersect_rays, pose_from_relative
from hub.distributed.network.messages import SharedObservation, StateMessage
from protocols.geometry.pose import Pose

LocalisedNeighbour: TypeAlias = tuple[StateMessage, Edge]
"""A localised neighbour's state, and the edge to it."""

_REORDER_WINDOW = 256
"""Largest reordering of one camera's messages."""
_RECEIVED_MASK = (1 << _REORDER_WINDOW) - 1


def localise(camera: int, neighbours: list[LocalisedNeighbour], frame: int) -> Pose | None:
    """Pose of ``camera`` in ``frame`` by the most informative edge; with bearings only, by intersection of rays.

    neighbours: those in that frame with initialised edges. None while they do not determine a position.
    """

    def log_information(edge: Edge) -> float:
        assert edge.factor is not None
        return float(np.linalg.slogdet(edge.factor.hessian + 1e-9 * np.eye(6))[1])

    state, edge = max(neighbours, key=lambda neighbour: log_information(neighbour[1]))
    assert edge.factor is not None
    assert state.pose is not None
    best = edge.neighbour_from_own(edge.factor.anchor.retract(edge.factor.newton_step()))
    if not edge.factor.bearings:
        return pose_from_relative(state.pose, best)
    partner = next(
        (neighbour for neighbour in neighbours if neighbour[0].camera == frame and neighbour[0].partner == camera), None
    )
    if partner is not None:
        assert partner[1].factor is not None
        assert partner[0].pose is not None
        seen = partner[1].neighbour_from_own(partner[1].factor.anchor)
        return pose_from_relative(partner[0].pose, seen.scaled(1.0 / float(np.linalg.norm(seen.centre))))
    if len(neighbours) < 2:
        return None
    rotation = best.rotation.T @ state.pose.rotation
    rays = []
    for other, its in neighbours:
        assert its.factor is not None
        assert other.pose is not None
        centre = its.neighbour_from_own(its.factor.anchor).centre
        rays.append((other.pose, centre / np.linalg.norm(centre)))
    intersection = intersect_rays(rays, rotation)
    return None if intersection is None else Pose(rotation, intersection[0])


def localise_by_resection(neighbours: list[LocalisedNeighbour], rng: np.random.Generator) -> Pose | None:
    """Pose by resection from the observations shared with all neighbours; None if it is not determined.

    For a camera that shares too few with any single one. neighbours: those of one frame, with edges initialised or not.
    """
    mine, there, spread = [], [], []
    for state, edge in neighbours:
        if state.pose is not None:
            own, other, std = edge.points()
            mine.append(own)
            there.append(state.pose.world_from_camera(other))
            spread.append(std)
    if not mine:
        return None
    found = resect(np.concatenate(mine), np.concatenate(there), np.concatenate(spread), rng)
    return None if found is None else Pose(found.rotation, found.centre)


@dataclass(slots=True, eq=False)
class Neighbour:
    """Data of one neighbour. state: the last received. highest_sequence, received_mask: observations received."""

    edge: Edge
    boot: int = -1
    highest_sequence: int = -1
    received_mask: int = 0
    state: StateMessage | None = None
    state_age: int = 0
    """Own updates since the last state was received."""

    def rejection_reason(self, seen: SharedObservation) -> str:
        """Why an observation is rejected: a duplicate, or too late (distributed pose paper, step 1); "" if accepted."""
        if seen.boot != self.boot:
            if seen.boot < self.boot:
                return "earlier boot"
            self.boot, self.highest_sequence, self.received_mask = seen.boot, -1, 0
        ahead = seen.sequence - self.highest_sequence
        if ahead > 0:
            self.received_mask = ((self.received_mask << ahead) | 1) & _RECEIVED_MASK if ahead < _REORDER_WINDOW else 1
            self.highest_sequence = seen.sequence
            return ""
        if -ahead >= _REORDER_WINDOW:
            return "too late"
        bit = 1 << -ahead
        if self.received_mask & bit:
            return "duplicate"
        self.received_mask |= bit
        return ""
