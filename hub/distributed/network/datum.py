"""Where the network stands in the world: the gauge, fixed at read-out only (METHODS C, steps 5 and 7).

References are flooded as `Anchor`: where the network has the camera, and where the world has it. Seven dof (one pose,
one distance) are the gauge; what a second reference says beyond that is a measurement between the two cameras, and
enters as an edge like any other.
"""

from __future__ import annotations

import numpy as np

from hub.datum import control_outliers
from hub.distributed.factors.factor import Summary
from hub.distributed.factors.linearise import Relative
from hub.distributed.network.messages import Anchor
from protocols.geometry import so3
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig, RigCamera

LEAST_STD = 5e-5
"""Least std of a reference [rad, or share of the distance]: a stiffer one would only slow the network down."""
_STEPS = 12


def usable(anchors: dict[int, Anchor]) -> list[Anchor]:
    """Anchors by camera, without those set aside."""
    return [anchor for _, anchor in sorted(anchors.items()) if not anchor.aside]


def world_from_network(anchors: list[Anchor]) -> Similarity | None:
    """The similarity that fits the references best, weighted; None while they fix no pose or no scale.

    Begins from one attitude, or three positions; needs two positions for the scale.
    """
    positions = [(a.pose.position, a.reference.position, a) for a in anchors if a.reference.position is not None]
    turns = [a for a in anchors if a.reference.rotation is not None]
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
        assert first.reference.rotation is not None
        rotation = first.reference.rotation.T @ first.pose.rotation
        base = next((i for i, item in enumerate(positions) if item[2].camera == first.camera), 0)
    else:
        rotation, base = _turn(source, target), 0
    now = Similarity(scale, rotation, target[base] - scale * rotation @ source[base])
    minimal = (
        len(positions) == 2 and len(turns) == 1 and turns[0].camera in (positions[0][2].camera, positions[1][2].camera)
    )
    if minimal:  # camera 1's pose and |t2 - t1|, exactly
        return now
    return _refined(now, positions, turns)


def contradicted(anchors: list[Anchor]) -> dict[int, str]:
    """Cameras whose reference all the others agree against, and how, in words."""
    names = [str(anchor.camera) for anchor in anchors]
    cameras = {
        str(a.camera): RigCamera(
            str(a.camera),
            (1, 1),
            position=a.reference.position,
            rotation=a.reference.rotation,
            position_std=np.full(3, a.reference.position_std),
            rotation_std=np.full(3, a.reference.rotation_std),
        )
        for a in anchors
    }
    found = control_outliers.contradicted(Rig(cameras), names, [anchor.pose for anchor in anchors])
    return {int(name): told for name, told in found.items() if isinstance(name, str)}


def _turn(source: Floats, target: Floats) -> Floats:
    u, _, vt = np.linalg.svd((target - target.mean(0)).T @ (source - source.mean(0)))
    return np.asarray((u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])) @ vt)


def _refined(start: Similarity, positions: list[tuple[Floats, Floats, Anchor]], turns: list[Anchor]) -> Similarity:
    now = start
    extent = max(float(np.linalg.norm(np.ptp(np.array([q for _, q, _ in positions]), axis=0))), 1e-12)
    for _ in range(_STEPS):
        hessian, gradient = np.zeros((7, 7)), np.zeros(7)
        for source, target, anchor in positions:
            std = max(anchor.reference.position_std, LEAST_STD * extent)
            spot = now.scale * now.rotation @ source
            residual = spot + now.shift - target
            by = np.concatenate([-so3.hat(spot), np.eye(3), spot[:, None]], axis=1)
            hessian += by.T @ by / std**2
            gradient += by.T @ residual / std**2
        for anchor in turns:
            assert anchor.reference.rotation is not None
            std = max(anchor.reference.rotation_std, LEAST_STD)
            # world_from_network as this camera's attitude has it, against the fit.
            residual = so3.log(now.rotation @ anchor.pose.rotation.T @ anchor.reference.rotation)
            hessian[:3, :3] += np.eye(3) / std**2
            gradient[:3] += residual / std**2
        step = -np.linalg.solve(hessian + 1e-12 * np.trace(hessian) * np.eye(7), gradient)
        turn = so3.exp(step[:3])
        size = now.scale * float(np.exp(step[6]))
        now = Similarity(size, turn @ now.rotation, now.shift + step[3:6])
        if float(np.abs(step).max()) < 1e-12:
            break
    return now


def reference_edge(own: Anchor, other: Anchor, *, attitude: bool) -> Summary | None:
    """What two references say of where ``own`` sees ``other``: the direction, and with ``attitude`` the turn too.

    None if they say neither: a direction needs both positions and ``own``'s attitude, a turn needs both attitudes.
    """
    a, b = own.reference, other.reference
    hessian = np.zeros((6, 6))
    rotation, centre = np.eye(3), np.array([0.0, 0.0, 1.0])
    told = False
    if attitude and a.rotation is not None and b.rotation is not None:
        rotation = b.rotation @ a.rotation.T
        hessian[:3, :3] = np.eye(3) / (max(a.rotation_std, LEAST_STD) ** 2 + max(b.rotation_std, LEAST_STD) ** 2)
        told = True
    if a.position is not None and b.position is not None and a.rotation is not None:
        apart = b.position - a.position
        length = float(np.linalg.norm(apart))
        if length > 0.0:
            centre = a.rotation @ apart / length
            spread = np.hypot(a.position_std, b.position_std) / length
            std2 = max(spread, LEAST_STD) ** 2 + max(a.rotation_std, LEAST_STD) ** 2
            hessian[3:, 3:] = (np.eye(3) - np.outer(centre, centre)) / std2
            told = True
    return Summary(Relative(rotation, centre), hessian, np.zeros(6), 0.0, True) if told else None
