"""How a camera finds its first pose in a frame that its neighbours are in (METHODS C, step 4)."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from hub.distributed.factors.factor import Edge
from hub.distributed.factors.initialise import resect
from hub.distributed.network.block_solver import placed_by, ray_meeting
from hub.distributed.network.messages import StateMessage
from protocols.geometry.pose import Pose

Offer: TypeAlias = tuple[StateMessage, Edge]
"""A neighbour that is placed, and the edge to it."""


def placed(camera: int, offers: list[Offer], frame: int) -> Pose | None:
    """Where ``camera`` stands in ``frame`` by the edge that tells most; with bearings only, where its lines meet.

    offers: neighbours in that frame with edges that have begun. None while they don't tell a place.
    """

    def strength(edge: Edge) -> float:
        assert edge.summary is not None
        return float(np.linalg.slogdet(edge.summary.hessian + 1e-9 * np.eye(6))[1])

    state, edge = max(offers, key=lambda offer: strength(offer[1]))
    assert edge.summary is not None
    assert state.pose is not None
    best = edge.from_here(edge.summary.anchor.moved(edge.summary.best_step()))
    if not edge.summary.bearings:
        return placed_by(state.pose, best)
    partner = next((offer for offer in offers if offer[0].camera == frame and offer[0].partner == camera), None)
    if partner is not None:
        assert partner[1].summary is not None
        assert partner[0].pose is not None
        seen = partner[1].from_here(partner[1].summary.anchor)
        return placed_by(partner[0].pose, seen.scaled(1.0 / float(np.linalg.norm(seen.centre))))
    if len(offers) < 2:
        return None
    rotation = best.rotation.T @ state.pose.rotation
    rays = []
    for other, its in offers:
        assert its.summary is not None
        assert other.pose is not None
        centre = its.from_here(its.summary.anchor).centre
        rays.append((other.pose, centre / np.linalg.norm(centre)))
    met = ray_meeting(rays, rotation)
    return None if met is None else Pose(rotation, met[0])


def placed_by_many(offers: list[Offer], rng: np.random.Generator) -> Pose | None:
    """Where a camera stands that shares too little with any one neighbour, by what it shares with all; None if unknown.

    offers: neighbours of one frame, whether or not their edges have begun.
    """
    mine, there, spread = [], [], []
    for state, edge in offers:
        if state.pose is not None:
            own, other, std = edge.points()
            mine.append(own)
            there.append(state.pose.world_from_camera(other))
            spread.append(std)
    if not mine:
        return None
    found = resect(np.concatenate(mine), np.concatenate(there), np.concatenate(spread), rng)
    return None if found is None else Pose(found.rotation, found.centre)
