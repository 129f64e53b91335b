"""Datum of the network: the gauge, fixed only at read-out, and control points (distributed pose paper, steps 5 and 7).

Control points are flooded through the network as `Anchor`: the camera's pose in the network and its surveyed pose in
the world. Seven dof (one pose, one distance) fix the gauge; further control points are relative measurements between
two cameras and enter as factors.
"""

from __future__ import annotations

import numpy as np

from hub.bundle.datum import control_outliers
from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.factors.two_view_model import RelativeTransform
from hub.distributed.network.messages import Anchor
from protocols.geometry import so3
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig, RigCamera

MIN_STD = 5e-5
"""Smallest std of a control point [rad, or share of the distance]: a stiffer one only slows convergence."""
_MAX_ITERATIONS = 12  # Gauss-Newton steps: a bound


def accepted_anchors(anchors: dict[int, Anchor]) -> list[Anchor]:
    """Anchors in the order of their cameras, without rejected ones."""
    return [anchor for _, anchor in sorted(anchors.items()) if not anchor.rejected]


def world_from_network(anchors: list[Anchor]) -> Similarity | None:
    """The weighted similarity that fits the control points; None while they fix no pose or no scale.

    Initialised from one attitude, or three positions; needs two positions for the scale.
    """
    positions = [
        (a.pose.position, a.control_point.position, a) for a in anchors if a.control_point.position is not None
    ]
    turns = [a for a in anchors if a.control_point.rotation is not None]
    if len(positions) < 2 or not (turns or len(positions) >= 3):
        return None
    source = np.array([p for p, _, _ in positions])
    target = np.array([q for _, q, _ in positions])
    apart_source = np.linalg.norm(source - source[0], axis=1)
    apart_target = np.linalg.norm(target - target[0], axis=1)
    if apart_source.max() <= 0.0 or apart_target.max() <= 0.0:
        return None
    scale = float(apart_target.sum() / apart_source.sum())
    if turns:
        first = turns[0]
        assert first.control_point.rotation is not None
        rotation = first.control_point.rotation.T @ first.pose.rotation
        base = next((i for i, item in enumerate(positions) if item[2].camera == first.camera), 0)
    else:
        rotation, base = _best_rotation(source, target), 0
    now = Similarity(scale, rotation, target[base] - scale * rotation @ source[base])
    minimal = (
        len(positions) == 2 and len(turns) == 1 and turns[0].camera in (positions[0][2].camera, positions[1][2].camera)
    )
    if minimal:  # camera 1's pose and |t2 - t1|, exactly
        return now
    return _gauss_newton(now, positions, turns)


def find_outliers(anchors: list[Anchor]) -> dict[int, str]:
    """Cameras whose control points are inconsistent with all the others, with a description of each."""
    names = [str(anchor.camera) for anchor in anchors]
    cameras = {
        str(a.camera): RigCamera(
            str(a.camera),
            (1, 1),
            position=a.control_point.position,
            rotation=a.control_point.rotation,
            position_std=np.full(3, a.control_point.position_std),
            rotation_std=np.full(3, a.control_point.rotation_std),
        )
        for a in anchors
    }
    found = control_outliers.find_outliers(Rig(cameras), names, [anchor.pose for anchor in anchors])
    return {int(name): text for name, text in found.items() if isinstance(name, str)}


def _best_rotation(source: Floats, target: Floats) -> Floats:
    u, _, vt = np.linalg.svd((target - target.mean(0)).T @ (source - source.mean(0)))
    return np.asarray((u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])) @ vt)


def _gauss_newton(start: Similarity, positions: list[tuple[Floats, Floats, Anchor]], turns: list[Anchor]) -> Similarity:
    now = start
    extent = max(float(np.linalg.norm(np.ptp(np.array([q for _, q, _ in positions]), axis=0))), 1e-12)
    for _ in range(_MAX_ITERATIONS):
        hessian, gradient = np.zeros((7, 7)), np.zeros(7)
        for source, target, anchor in positions:
            std = max(anchor.control_point.position_std, MIN_STD * extent)
            spot = now.scale * now.rotation @ source
            residual = spot + now.shift - target
            by = np.concatenate([-so3.hat(spot), np.eye(3), spot[:, None]], axis=1)
            hessian += by.T @ by / std**2
            gradient += by.T @ residual / std**2
        for anchor in turns:
            assert anchor.control_point.rotation is not None
            std = max(anchor.control_point.rotation_std, MIN_STD)
            # The rotation of world_from_network by this camera's attitude, relative to the fit.
            residual = so3.log(now.rotation @ anchor.pose.rotation.T @ anchor.control_point.rotation)
            hessian[:3, :3] += np.eye(3) / std**2
            gradient[:3] += residual / std**2
        step = -np.linalg.solve(hessian + 1e-12 * np.trace(hessian) * np.eye(7), gradient)
        turn = so3.exp(step[:3])
        size = now.scale * float(np.exp(step[6]))
        now = Similarity(size, turn @ now.rotation, now.shift + step[3:6])
        if float(np.abs(step).max()) < 1e-12:
            break
    return now


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
