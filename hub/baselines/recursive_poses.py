"""The distributed pose paper's recursive estimator, eqs. (1) to (19) in corrected form: a baseline for comparison.

Convention: ``X_k = R_k (X - t_k)``. The paper prints ``[R t]`` in eqs. (11) and (12); correct is ``R [I | -t]``. Its
``R_l R_k^-1`` in eqs. (1), (2) and (19) is inverted: the sum of ``X_k X_lᵀ`` gives ``R_k R_lᵀ``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.datum.gauge import control_points_of, fit_to_control_points
from hub.bundle.initialisation import Reconstruction, triangulate_and_adjust
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import CameraState
from hub.clocks.clock_graph import ClockGraph
from hub.distributed.factors.initialise import procrustes
from hub.distributed.network.association import MAX_GAP_S, Associator
from hub.distributed.solver import normalised_sizes, shared_observations
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations
from protocols.session.rig import Rig

MIN_OBSERVATIONS = 4
"""Shared observations before an edge is used."""

_UPDATE_INTERVAL = 10
"""Observations between two updates."""
_INITIAL_OBSERVATIONS = 200
"""Shared observations from which an initial pose is computed."""
_MIN_OBSERVATIONS = 12  # of a camera: twice the unknowns of its pose
_BASELINE = 250.0
"""Distance of the first two cameras in the unit of the method's constants (cm, as in the paper's section 4)."""


@dataclass(frozen=True, slots=True)
class RecursivePoseSettings:
    """The paper's constants; it prints no values.

    known_variance, unknown_variance: p1 and p2 of eq. (3). known_weight: q1 of eq. (4), against the edges' unit
    vectors. forget: forgetting factor u of eq. (5), at each update; 1 = no forgetting. bearing_std: of a direction
    [rad]. drift: process noise variance at each update (Q).
    """

    known_variance: float = 1e-6
    unknown_variance: float = 1e4
    known_weight: float = 1e6
    forget: float = 1.0
    bearing_std: float = 0.02
    drift: float = 0.1


def point_in_camera(rows: Floats) -> Floats:
    """Points (n, 3) up to a common scale, from rows (n, 3) of x, y, log size, normalised; eqs. (13), (14)."""
    return np.asarray(np.column_stack([rows[:, :2], np.ones(len(rows))]) * np.exp(-rows[:, 2])[:, None])


def centred_directions(points: Floats, mean: Floats) -> Floats:
    """Unit vectors (n, 3) from the mean (3,) to points (n, 3); eqs. (16), (17)."""
    apart = points - mean
    return np.asarray(apart / np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-12))


def correlation(unit_k: Floats, unit_l: Floats) -> Floats:
    """m_kl (3, 3) of centred unit vectors (n, 3); eqs. (2), (19). It holds ``R_k R_lᵀ``."""
    return np.asarray(unit_k.T @ unit_l)


def direction(mean_k: Floats, mean_l: Floats, k_from_l: Floats) -> Floats:
    """y_kl = R_k (t_l - t_k) (3,) in the unit of the means; eq. (16) solved."""
    return np.asarray(mean_k - k_from_l @ mean_l)


def discounted_sum(matrix: Floats, new_correlation: Floats, forget: float) -> Floats:
    """M_kl after one more observation; eq. (5): forgetting for u > 1 only."""
    return np.asarray(matrix / forget + new_correlation)


def attitude_matrix(known: Floats, edges: list[tuple[Floats, Floats]]) -> Floats:
    """M_kk (3, 3) from the prior ``known`` (3, 3) and (M_ki, R_i) of the neighbours; eqs. (4), (6), prior kept."""
    return np.asarray(known + sum((m @ rotation for m, rotation in edges), np.zeros((3, 3))))


def direction_jacobian(y: Floats, rotation: Floats) -> Floats:
    """H (2, 3) = [I₂ 0] R_y R_k with ``R_y y/‖y‖ = e₃``; eq. (8)."""
    return np.asarray((so3.rotation_between(y, np.array([0.0, 0.0, 1.0])) @ rotation)[:2])


def kalman_position(
    position: Floats,
    covariance: Floats,
    other: Floats,
    other_covariance: Floats,
    h: Floats,
    settings: RecursivePoseSettings,
) -> tuple[Floats, Floats]:
    """t_k (3,) and its covariance after one direction to ``other``; eqs. (7), (9), (10) with process noise and G."""
    covariance = covariance + settings.drift * np.eye(3)
    distance2 = float((other - position) @ (other - position))
    g = settings.bearing_std**2 * distance2 * np.eye(2) + h @ other_covariance @ h.T
    gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + g)
    moved = position + gain @ (h @ (other - position))
    updated = covariance - gain @ h @ covariance
    return moved, 0.5 * (updated + updated.T)


@dataclass(slots=True, eq=False)
class _Edge:
    """Means of one neighbour's shared points, M_kl, and the ``new_correlation`` not yet added to it."""

    points_k: Floats
    points_l: Floats
    matrix: Floats
    new_correlation: Floats
    count: int = 0


class RecursivePoseNode:
    """Recursive estimator of one camera. start: initial pose; position_known, attitude_known: exactly known parts."""

    def __init__(
        self,
        start: Pose,
        *,
        position_known: bool = False,
        attitude_known: bool = False,
        settings: RecursivePoseSettings | None = None,
    ) -> None:
        self.settings = settings or RecursivePoseSettings()
        self.rotation, self.position = start.rotation, start.position
        variance = self.settings.known_variance if position_known else self.settings.unknown_variance
        self.covariance = variance * np.eye(3)  # eq. (3)
        self.position_known = position_known
        self.known = self.settings.known_weight * start.rotation if attitude_known else np.zeros((3, 3))  # eq. (4)
        self._edges: dict[int, _Edge] = {}

    @property
    def pose(self) -> Pose:
        """The estimate."""
        return Pose(self.rotation, self.position)

    def observe(self, neighbour: int, seen_k: Floats, seen_l: Floats) -> None:
        """One shared point, rows (3,) in this camera and the neighbour: eqs. (13) to (19) and (5)."""
        edge = self._edges.get(neighbour)
        if edge is None:
            edge = self._edges[neighbour] = _Edge(np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
        point_k, point_l = point_in_camera(seen_k[None])[0], point_in_camera(seen_l[None])[0]
        edge.count += 1
        edge.points_k = edge.points_k + (point_k - edge.points_k) / edge.count
        edge.points_l = edge.points_l + (point_l - edge.points_l) / edge.count
        if edge.count < MIN_OBSERVATIONS:
            return
        new_correlation = correlation(
            centred_directions(point_k[None], edge.points_k), centred_directions(point_l[None], edge.points_l)
        )
        edge.new_correlation = (
            edge.new_correlation + new_correlation
        )  # eq. (2): the sum over the observations between two updates

    def update(self, poses: dict[int, tuple[Pose, Floats]], latest: list[int]) -> None:
        """Sections 3.3.1 and 3.3.2: attitude by all edges, position by the ``latest`` ones.

        poses: (pose, position's covariance (3, 3)) of the neighbours.
        """
        ready = {k: edge for k, edge in self._edges.items() if edge.count > 2 * MIN_OBSERVATIONS and k in poses}
        if not ready:
            return
        for edge in ready.values():
            if edge.new_correlation.any():
                edge.matrix = discounted_sum(edge.matrix, edge.new_correlation, self.settings.forget)
                edge.new_correlation = np.zeros((3, 3))
        matrix = attitude_matrix(self.known, [(edge.matrix, poses[k][0].rotation) for k, edge in ready.items()])
        self.rotation = so3.nearest(matrix)  # maximises the trace of eqs. (1), (18)
        for k in latest:
            if k not in ready or self.position_known:
                continue
            edge = ready[k]
            # By the attitudes, which rest on all edges: this edge's own rotation has its errors at every update alike.
            y = direction(edge.points_k, edge.points_l, self.rotation @ poses[k][0].rotation.T)
            if float(np.linalg.norm(y)) < 1e-9:
                continue
            h = direction_jacobian(y, self.rotation)
            self.position, self.covariance = kalman_position(
                self.position, self.covariance, poses[k][0].position, poses[k][1], h, self.settings
            )


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
    initial = _initial_poses(pairs)
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
                row = associator.add_neighbour(seen)
                if row is not None:
                    out.append((camera, seen.camera, np.array(row)))
    return out


def _initial_poses(pairs: list[SharedPair]) -> dict[int, Pose]:
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
