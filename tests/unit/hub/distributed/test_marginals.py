"""The network's position stds against the joint optimum's covariance."""

from __future__ import annotations

import numpy as np
import pytest

from hub.bundle.datum.gauge import fix_gauge
from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.network.block_solver import connected_cameras, merge_duplicate_factors, position_stds
from protocols.geometry.types import Floats
from protocols.session.rig import Rig, RigCamera
from tests.bench.pose_runs import Network, feed, network
from tests.bench.pose_worlds import Sightings, SimulatedRig, cube, joint_optimum, observe, section_4


def _ran(seed: int, noise_scale: float = 1.0, size: float = 0.02) -> tuple[SimulatedRig, Sightings, Network]:
    """noise_scale: noise std given to the nodes, over the true one."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, 1500), size=size)
    net = network(world, None, seed)
    scaled = Sightings(
        sightings.cameras,
        sightings.seen,
        noise_scale * sightings.sigma,
        noise_scale * sightings.size_sigma,
        sightings.wrong,
    )
    feed(net, scaled, 20)
    for _ in range(30):
        net.tick()
    return world, sightings, net


def _stds(world: SimulatedRig, net: Network) -> Floats:
    """(3, 3) of the cameras without control points."""
    cameras = {
        str(k): RigCamera(
            str(k),
            (1, 1),
            position=pose.position if k < 2 else None,
            rotation=pose.rotation if k == 0 else None,
            position_std=np.full(3, 1e-6),
            rotation_std=np.full(3, 1e-7),
        )
        for k, pose in enumerate(world.poses)
    }
    poses = {str(k): node.pose for k, node in net.nodes.items() if node.pose is not None}
    gauge = fix_gauge(Rig(cameras), list(poses), list(poses.values()))
    found = position_stds(poses, merge_duplicate_factors(_factors(net)), gauge.similarity, gauge.information)
    return np.array([found[str(k)] for k in range(2, 5)])


def _factors(net: Network) -> dict[str, dict[str, QuadraticFactor]]:
    return {
        str(k): {str(o): edge.factor for o, edge in node.neighbours().items() if edge.factor is not None}
        for k, node in net.nodes.items()
    }


@pytest.mark.parametrize(("noise_scale", "size"), [(1.0, 0.02), (0.7, 0.02), (1.0, np.inf)])
def test_stds_match_the_joint_optimum_even_with_a_wrong_noise_level(noise_scale: float, size: float) -> None:
    world, sightings, net = _ran(31, noise_scale, size)
    covariance = joint_optimum(world, sightings, spread=True).covariance
    assert covariance is not None
    best = np.sqrt(np.diag(covariance)[:-1].reshape(-1, 6)[2:, 3:])
    ratio = _stds(world, net) / best
    assert float(ratio.min()) > 0.85
    assert float(ratio.max()) < 1.25


def test_a_camera_without_edges_is_not_connected() -> None:
    _, _, net = _ran(31)
    edges = merge_duplicate_factors(_factors(net))
    assert len(edges) == 10
    assert connected_cameras(list("01234"), edges) == set("01234")
    assert connected_cameras(list("01234"), {pair: e for pair, e in edges.items() if "3" not in pair}) == set("0124")
