"""The distributed pose paper's recursive estimator, eqs. (1) to (19), on a session whose observations have sizes."""

from __future__ import annotations

import numpy as np

from hub.baselines.recursive_poses import RecursivePoseNode, point_in_camera
from hub.bundle.datum.gauge import control_points_of, fit_to_control_points
from hub.bundle.initialisation import Reconstruction, triangulate_and_adjust
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import CameraState
from hub.clocks.clock_graph import ClockGraph
from hub.distributed.factors.initialise import procrustes
from hub.distributed.network.association import MAX_GAP_S, Associator
from hub.distributed.solver import normalised_sizes, shared_observations
from protocols.core.errors import Refused
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_UPDATE_INTERVAL = 10
"""Observations between two updates."""
_INITIAL_OBSERVATIONS = 200
"""Shared observations from which an initial pose is computed."""
_MIN_OBSERVATIONS = 12  # of a camera: twice the unknowns of its pose
_BASELINE = 250.0
"""Distance of the first two cameras in the unit of the method's constants (cm, as in the paper's section 4)."""

SharedPair = tuple[int, int, Floats]


def all_tracks_have_sizes(prepared: PreparedSession, observations: Observations) -> bool:
    """Whether every track of every camera has sizes."""
    return bool(prepared.cameras) and all(
        normalised_sizes(prepared, observations, name, label)[1] > 0.0
        for name, camera in prepared.cameras.items()
        for label in camera.tracks
    )


def reconstruct_by_paper(
    rig: Rig, prepared: PreparedSession, observations: Observations, graph: ClockGraph
) -> tuple[Reconstruction, dict[str, str]]:
    """Poses of the cameras of ``graph`` and the triangulated path, unadjusted; and the refused cameras with reasons.

    Positions and attitudes of the rig are known, as in the paper's section 4, where they determine the scale; else the
    first camera's pose and the second one's position are the gauge. Initial poses are chained from camera to camera
    by eqs. (16) to (19) over the first shared observations. Raises Refused where fewer than two cameras can be placed.
    """
    names = [name for name in prepared.camera_order if name in graph.clocks]
    pairs = _pairs(prepared, observations, graph, names)
    initial = _initial_poses(len(names), pairs)
    refused = {
        name: "shares too few observations with any placed camera" for i, name in enumerate(names) if i not in initial
    }
    if len(initial) < 2:
        raise Refused("no two cameras share enough observations", prepared.refused | refused)
    known_positions, known_attitudes = sorted(initial)[:2], sorted(initial)[:1]
    placed_names = [names[i] for i in sorted(initial)]
    control = control_points_of(rig, placed_names)
    if control.extent > 0.0 and control.rotations:
        initial = _in_the_rigs_world(rig, placed_names, initial)
        known_positions = [sorted(initial)[i] for i, _ in control.positions]
        known_attitudes = [sorted(initial)[i] for i, _ in control.rotations]
    poses = _run(initial, pairs, known_positions, known_attitudes)
    placed = {}
    for i, pose in poses.items():
        clock = graph.clocks[names[i]]
        placed[names[i]] = CameraState(
            prepared.cameras[names[i]].intrinsics, pose, clock.rate, clock.offset, clock.centre
        )
    first, second = list(placed)[:2]
    return triangulate_and_adjust(
        prepared.cameras, placed, prepared.rows, prepared.labels, (first, second), None
    ), refused


def _pairs(
    prepared: PreparedSession, observations: Observations, graph: ClockGraph, names: list[str]
) -> list[SharedPair]:
    """(camera, neighbour, row (10,)) in the log's order, as each camera associates them by itself."""
    associators = [Associator(0.0 if prepared.shared_clock else MAX_GAP_S) for _ in names]
    out: list[SharedPair] = []
    for seen in shared_observations(prepared, observations, graph, names):
        for camera, associator in enumerate(associators):
            if camera == seen.camera:
                out += [(camera, other, np.array(row)) for other, row in associator.add_own(seen)]
            else:
                pair = associator.add_neighbour(seen)
                if pair is not None:
                    out.append((camera, seen.camera, np.array(pair[1])))
    return out


def _initial_poses(cameras: int, pairs: list[SharedPair]) -> dict[int, Pose]:
    """Poses chained from the first camera, scaled so that the first two placed cameras are `_BASELINE` apart."""
    shared: dict[tuple[int, int], list[Floats]] = {}
    for k, other, row in pairs:
        rows = shared.setdefault((k, other), [])
        if len(rows) < _INITIAL_OBSERVATIONS:
            rows.append(row)
    poses = {0: Pose.identity()}
    while True:
        candidates = [
            (len(rows), -other, k, other)
            for (k, other), rows in shared.items()
            if k in poses and other not in poses and len(rows) >= _MIN_OBSERVATIONS
        ]
        if not candidates:
            break
        _, _, k, other = max(candidates)
        table = np.array(shared[k, other])
        seen = procrustes(point_in_camera(table[:, 0:3]), point_in_camera(table[:, 3:6]))
        poses[other] = Pose(seen.rotation @ poses[k].rotation, poses[k].position + poses[k].rotation.T @ seen.centre)
    placed = sorted(poses)
    if len(placed) < 2:
        return poses
    unit = _BASELINE / max(float(np.linalg.norm(poses[placed[1]].position)), 1e-12)
    return {i: Pose(poses[i].rotation, unit * poses[i].position) for i in placed}


def _in_the_rigs_world(rig: Rig, names: list[str], initial: dict[int, Pose]) -> dict[int, Pose]:
    """The initial poses moved into the rig's world, known parts at their given values, in the constants' unit."""
    found, _ = fit_to_control_points(rig, names, [initial[i] for i in sorted(initial)])
    out = {}
    for i, name in zip(sorted(initial), names, strict=True):
        pose, camera = found.pose(initial[i]), rig.cameras[name]
        rotation = pose.rotation if camera.rotation is None else camera.rotation
        position = pose.position if camera.position is None else camera.position
        out[i] = Pose(rotation, position / found.scale)
    return out


def _run(
    initial: dict[int, Pose], pairs: list[SharedPair], known_positions: list[int], known_attitudes: list[int]
) -> dict[int, Pose]:
    """The recursive estimate after all shared observations."""
    nodes = {
        k: RecursivePoseNode(pose, position_known=k in known_positions, attitude_known=k in known_attitudes)
        for k, pose in initial.items()
    }
    pending: dict[int, set[int]] = {}
    for count, (k, other, row) in enumerate(pairs, 1):
        if k not in nodes or other not in nodes:
            continue
        nodes[k].observe(other, row[0:3], row[3:6])
        pending.setdefault(k, set()).add(other)
        if count % _UPDATE_INTERVAL == 0:
            state = {i: (node.pose, node.covariance) for i, node in nodes.items()}
            for i, others in pending.items():
                nodes[i].update(state, sorted(others))
            pending.clear()
    return {k: node.pose for k, node in nodes.items()}
