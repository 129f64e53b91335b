"""Datum of the network: the gauge, fixed only at read-out, and control points (distributed pose paper, steps 5 and 7).

Control points are flooded through the network as `Anchor`: the camera's pose in the network and its surveyed pose in
the world. Seven dof (one pose, one distance) fix the gauge; further control points are relative measurements between
two cameras and enter as factors.
"""

from __future__ import annotations

import numpy as np

from hub.bundle.datum import control_outliers
from hub.bundle.datum.gauge import fit_to_control_points
from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.factors.two_view_model import RelativeTransform
from hub.distributed.network.messages import Anchor
from protocols.geometry.pose import Pose, Similarity
from protocols.session.rig import Rig, RigCamera

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
