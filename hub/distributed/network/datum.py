"""Datum of the network: the gauge, fixed only at read-out, and control points (distributed pose paper, steps 5 and 7).

Control points are flooded through the network as `Anchor`: the camera's pose in the network and its surveyed pose in
the world. Seven dof (one pose, one distance) fix the gauge; further control points are relative measurements between
two cameras and enter as factors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hub.bundle.datum import control_outliers
from hub.bundle.datum.gauge import fit_to_control_points
from hub.distributed.factors.factor import Edge, QuadraticFactor
from hub.distributed.factors.initialise import resect
from hub.distributed.factors.two_view_model import RelativeTransform
from hub.distributed.network.block_solver import intersect_rays, pose_from_relative
from hub.distributed.network.messages import Anchor, SharedObservation, StateMessage
from protocols.geometry.pose import Pose, Similarity
from protocols.session.rig import Rig, RigCamera

LocalisedNeighbour: TypeAlias = tuple[StateMessage, Edge]
"""A localised neighbour's state, and the edge to it."""

_REORDER_WINDOW = 256
"""Largest reordering of one camera's messages."""
_RECEIVED_MASK = (1 << _REORDER_WINDOW) - 1
MIN_STD = 5e-5
"""Smallest std of a control point [rad, or share of the distance]: a stiffer one only slows convergence."""


def accepted_anchors(anchors: dict[int, Anchor]) -> list[Anchor]:
    """Anchors in the order of their cameras, without rejected ones."""
    return [anchor for _, anchor in sorted(anchors.items()) if not anchor.rejected]


def world_from_network(anchors: list[Anchor]) -> Similarity | None:
    """The weighted similarity that fits the control points; None while they fix no pose or no scale.

    It needs two positions for the scale, and an attitude or a third one.
    """
    positions = [(a, a.control_point.position) for a in anchors if a.control_point.position is not None]
    turns = [(a, a.control_point.rotation) for a in anchors if a.control_point.rotation is not None]
    if len(positions) < 2 or not (turns or len(positions) >= 3):
        return None
    source, target = np.array([a.pose.position for a, _ in positions]), np.array([known for _, known in positions])
    if np.ptp(source, axis=0).max() <= 0.0 or np.ptp(target, axis=0).max() <= 0.0:
        return None
    cameras = [anchor.camera for anchor, _ in positions]
    if len(positions) == 2 and len(turns) == 1 and turns[0][0].camera in cameras:
        # Camera 1's pose and |t2 - t1|, exactly.
        (first, known), base = turns[0], cameras.index(turns[0][0].camera)
        rotation = known.T @ first.pose.rotation
        scale = float(np.linalg.norm(target[1] - target[0]) / np.linalg.norm(source[1] - source[0]))
        return Similarity(scale, rotation, target[base] - scale * rotation @ source[base])
    floor = MIN_STD * float(np.linalg.norm(np.ptp(target, axis=0)))
    return fit_to_control_points(*_surveyed(anchors, MIN_STD, floor))[0]


def find_outliers(anchors: list[Anchor]) -> dict[int, str]:
    """Cameras whose control points are inconsistent with all the others, with a description of each."""
    found = control_outliers.find_outliers(*_surveyed(anchors))
    return {int(name): text for name, text in found.items() if isinstance(name, str)}


def _surveyed(
    anchors: list[Anchor], rotation_std: float = 0.0, position_std: float = 0.0
) -> tuple[Rig, list[str], list[Pose]]:
    """The control points as a rig's, with stds of at least so much, the cameras' names, and their poses."""
    cameras = [
        RigCamera(
            str(a.camera),
            (1, 1),
            position=a.control_point.position,
            rotation=a.control_point.rotation,
            position_std=np.full(3, max(a.control_point.position_std, position_std)),
            rotation_std=np.full(3, max(a.control_point.rotation_std, rotation_std)),
        )
        for a in anchors
    ]
    names = [camera.name for camera in cameras]
    return Rig(dict(zip(names, cameras, strict=True))), names, [anchor.pose for anchor in anchors]


def control_point_factor(own: Anchor, other: Anchor, *, attitude: bool) -> QuadraticFactor | None:
    """Factor of ``other`` relative to ``own`` from two control points: direction, and with ``attitude`` the rotation.

    None without either: a direction needs both positions and ``own``'s attitude, a rotation needs both attitudes.
    """
    a, b = own.control_point, other.control_point
    hessian = np.zeros((6, 6))
    rotation, centre = np.eye(3), np.array([0.0, 0.0, 1.0])
    determined = False
    if attitude and a.rotation is not None and b.rotation is not None:
        rotation = b.rotation @ a.rotation.T
        hessian[:3, :3] = np.eye(3) / (max(a.rotation_std, MIN_STD) ** 2 + max(b.rotation_std, MIN_STD) ** 2)
        determined = True
    if a.position is not None and b.position is not None and a.rotation is not None:
        apart = b.position - a.position
        length = float(np.linalg.norm(apart))
        if length > 0.0:
            centre = a.rotation @ apart / length
            spread = np.hypot(a.position_std, b.position_std) / length
            std2 = max(spread, MIN_STD) ** 2 + max(a.rotation_std, MIN_STD) ** 2
            hessian[3:, 3:] = (np.eye(3) - np.outer(centre, centre)) / std2
            determined = True
    return QuadraticFactor(RelativeTransform(rotation, centre), hessian, np.zeros(6), 0.0, True) if determined else None


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
