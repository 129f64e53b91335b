"""Poses by the paper's own distributed method, eqs. (1) to (19), on a session whose rows tell sizes."""

from __future__ import annotations

import numpy as np

from hub.baselines.recursive_poses import PaperNode, point_in_camera
from hub.bundle.problem import CameraState
from hub.calibration.clock_graph import ClockGraph
from hub.calibration.initialisation import Scaffold, settle
from hub.calibration.preprocessing import Prepared
from hub.distributed.factors.initialise import procrustes
from hub.distributed.network.association import GAP, Pairing
from hub.distributed.solver import shared_observations, sizes_of
from protocols.core.errors import Refused
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations

_EVERY = 10
"""Observations between two updates."""
_FIRST = 200
"""Shared observations that a first guess is made of."""
_LEAST = 12
_BASELINE = 250.0
"""Distance of the first two cameras in the unit that the method's constants are in (cm, as in its section 4)."""

Pair = tuple[int, int, Floats]


def all_sized(prepared: Prepared, observations: Observations) -> bool:
    """Whether every track of every camera tells sizes."""
    return bool(prepared.cameras) and all(
        sizes_of(prepared, observations, name, label)[1] > 0.0
        for name, camera in prepared.cameras.items()
        for label in camera.tracks
    )


def place_by_paper(
    prepared: Prepared, observations: Observations, graph: ClockGraph
) -> tuple[Scaffold, dict[str, str]]:
    """Poses of the cameras of ``graph`` and the triangulated path, nothing adjusted; and the refused, with reasons.

    The first camera's pose and the second one's position are the gauge. First guesses come from eqs. (16) to (19)
    over the first shared observations, from camera to camera. Raises Refused where fewer than two can be placed.
    """
    names = [name for name in prepared.order if name in graph.clocks]
    pairs = _pairs(prepared, observations, graph, names)
    starts = _first_guesses(len(names), pairs)
    refused = {name: "shares too little with any placed camera" for i, name in enumerate(names) if i not in starts}
    if len(starts) < 2:
        raise Refused("no two cameras share enough observations", prepared.refused | refused)
    poses = _run(starts, pairs)
    placed = {}
    for i, pose in poses.items():
        clock = graph.clocks[names[i]]
        placed[names[i]] = CameraState(
            prepared.cameras[names[i]].intrinsics, pose, clock.rate, clock.offset, clock.centre
        )
    first, second = list(placed)[:2]
    return settle(prepared.cameras, placed, prepared.rows, prepared.labels, (first, second), None), refused


def _pairs(prepared: Prepared, observations: Observations, graph: ClockGraph, names: list[str]) -> list[Pair]:
    """(camera, neighbour, row (10,)) in the log's order, as every camera by itself brings them together."""
    pairings = [Pairing(0.0 if prepared.shared_clock else GAP) for _ in names]
    out: list[Pair] = []
    for seen in shared_observations(prepared, observations, graph, names):
        for camera, pairing in enumerate(pairings):
            if camera == seen.camera:
                out += [(camera, other, np.array(row)) for other, row in pairing.own(seen)]
            else:
                met = pairing.other(seen)
                if met is not None:
                    out.append((camera, seen.camera, np.array(met[1])))
    return out


def _first_guesses(cameras: int, pairs: list[Pair]) -> dict[int, Pose]:
    """Poses chained from the first camera, in the unit in which the first two placed are `_BASELINE` apart."""
    shared: dict[tuple[int, int], list[Floats]] = {}
    for k, other, row in pairs:
        rows = shared.setdefault((k, other), [])
        if len(rows) < _FIRST:
            rows.append(row)
    poses = {0: Pose.identity()}
    while True:
        ways = [
            (len(rows), -other, k, other)
            for (k, other), rows in shared.items()
            if k in poses and other not in poses and len(rows) >= _LEAST
        ]
        if not ways:
            break
        _, _, k, other = max(ways)
        table = np.array(shared[k, other])
        seen = procrustes(point_in_camera(table[:, 0:3]), point_in_camera(table[:, 3:6]))
        poses[other] = Pose(seen.rotation @ poses[k].rotation, poses[k].position + poses[k].rotation.T @ seen.centre)
    placed = sorted(poses)
    if len(placed) < 2:
        return poses
    unit = _BASELINE / max(float(np.linalg.norm(poses[placed[1]].position)), 1e-12)
    return {i: Pose(poses[i].rotation, unit * poses[i].position) for i in placed}


def _run(starts: dict[int, Pose], pairs: list[Pair]) -> dict[int, Pose]:
    """The paper's estimate after all shared observations."""
    known = sorted(starts)[:2]
    nodes = {k: PaperNode(pose, position_known=k in known, attitude_known=k == known[0]) for k, pose in starts.items()}
    fresh: dict[int, set[int]] = {}
    for count, (k, other, row) in enumerate(pairs, 1):
        if k not in nodes or other not in nodes:
            continue
        nodes[k].observe(other, row[0:3], row[3:6])
        fresh.setdefault(k, set()).add(other)
        if count % _EVERY == 0:
            state = {i: (node.pose, node.covariance) for i, node in nodes.items()}
            for i, others in fresh.items():
                nodes[i].update(state, sorted(others))
            fresh.clear()
    return {k: node.pose for k, node in nodes.items()}
