"""Relaxation of a ring of cameras whose initial poses are distorted by tens of degrees."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.factors.initialise import chi2_gates, robust_sums
from hub.distributed.factors.two_view_model import linearise_observations
from hub.distributed.network.block_solver import relative_transform
from hub.distributed.network.messages import StateMessage
from hub.distributed.network.node import PoseNode
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from tests.bench.pose_runs import Network
from tests.bench.pose_worlds import FOCAL, TARGET, look_at

CAMERAS, OBSERVATIONS = 16, 100


def _ring(rng: np.random.Generator) -> list[Pose]:
    out = []
    for k in range(CAMERAS):
        turn = 2.0 * np.pi * k / CAMERAS
        position = np.array([640.0 * np.cos(turn), 640.0 * np.sin(turn), 300.0]) + rng.uniform(-30, 30, 3)
        out.append(look_at(position, np.array([*(position + rng.uniform(-60, 60, 3))[:2], 60.0])))
    return out


def _edge(rng: np.random.Generator, a: Pose, b: Pose) -> QuadraticFactor:
    points = 0.5 * (a.position + b.position) + rng.uniform(-30.0, 30.0, (OBSERVATIONS, 3))
    points[:, 2] = rng.uniform(20.0, 80.0, OBSERVATIONS)
    seen = []
    for pose in (a, b):
        local = pose.camera_from_world(points)
        spots = local[:, :2] / local[:, 2:] + rng.normal(0.0, 1.0 / FOCAL, (OBSERVATIONS, 2))
        seen += [spots, np.log(TARGET / local[:, 2:]) + rng.normal(0.0, 0.02, (OBSERVATIONS, 1))]
    weights = np.tile([FOCAL, 50.0, FOCAL, 50.0], (OBSERVATIONS, 1))
    truth = relative_transform(_in_targets(a), _in_targets(b))
    hessian, gradient = robust_sums(
        linearise_observations(truth, np.concatenate(seen, axis=1), weights), chi2_gates(weights)
    )
    return QuadraticFactor(truth, hessian, gradient, float(OBSERVATIONS), False)


def _in_targets(pose: Pose) -> Pose:
    return Pose(pose.rotation, pose.position / TARGET)


def _distorted(truth: list[Pose], rng: np.random.Generator, degrees: float) -> list[Pose]:
    """Initial poses with accumulated error, as from a chain of relative poses."""
    axis = rng.standard_normal(3)
    twist = so3.exp(np.radians(degrees) / CAMERAS * axis / np.linalg.norm(axis))
    out = [_in_targets(truth[0])]
    for last, pose in pairwise(truth):
        seen, before = relative_transform(_in_targets(last), _in_targets(pose)), out[-1]
        out.append(
            Pose(seen.rotation @ twist @ before.rotation, before.position + before.rotation.T @ twist.T @ seen.centre)
        )
    return out


def _largest_error(truth: list[Pose], net: Network) -> float:
    """Largest position error [cm] relative to the first camera."""
    apart = []
    for k, pose in enumerate(truth):
        first, found = net.nodes[0].pose, net.nodes[k].pose
        assert first is not None
        assert found is not None
        off: Floats = TARGET * relative_transform(first, found).centre - relative_transform(truth[0], pose).centre
        apart.append(float(np.linalg.norm(off)))
    return max(apart)


def test_a_distorted_ring_relaxes() -> None:
    rng = np.random.default_rng(1)
    truth = _ring(rng)
    edges: dict[int, dict[int, QuadraticFactor]] = {k: {} for k in range(CAMERAS)}
    for k in range(CAMERAS):
        for other in ((k + 1) % CAMERAS, (k + 2) % CAMERAS):
            a, b = min(k, other), max(k, other)
            edges[a][b] = edges[b][a] = _edge(rng, truth[a], truth[b])
    net = Network({k: PoseNode(k) for k in range(CAMERAS)})
    for k, pose in enumerate(_distorted(truth, rng, 40.0)):
        state = StateMessage(k, 0, 0, 1, 0, min(k, CAMERAS - k), pose, frame_age=50, depth=CAMERAS // 2)
        net.nodes[k].resume(state, edges[k])
    for k, known in edges.items():
        for other in known:
            net.send(other, net.nodes[k].state())
    assert _largest_error(truth, net) > 200.0
    for _ in range(400):
        net.tick()
    assert _largest_error(truth, net) < 40.0
    assert not net.notices
