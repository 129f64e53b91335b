"""Position stds that the network tells of itself, against the joint optimum's covariance."""

from __future__ import annotations

import numpy as np
import pytest

from hub.datum.gauge import fix_gauge
from hub.distributed.factors.factor import Summary
from hub.distributed.network.marginals import each_once, joined, position_stds
from protocols.geometry.types import Floats
from protocols.session.rig import Rig, RigCamera
from tests.bench.pose_runs import Network, feed, network
from tests.bench.pose_worlds import Sightings, World, cube, joint_optimum, observe, section_4


def _ran(seed: int, told: float = 1.0, size: float = 0.02) -> tuple[World, Sightings, Network]:
    """told: the noise that the nodes are told, over the true one."""
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, 1500), size=size)
    net = network(world, None, seed)
    wrongly = Sightings(
        sightings.cameras, sightings.seen, told * sightings.sigma, told * sightings.size_sigma, sightings.wrong
    )
    feed(net, wrongly, 20)
    for _ in range(30):
        net.tick()
    return world, sightings, net


def _stds(world: World, net: Network) -> Floats:
    """(3, 3) of the cameras that no reference holds."""
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
    found = position_stds(poses, each_once(_learnt(net)), gauge.similarity, gauge.information)
    return np.array([found[str(k)] for k in range(2, 5)])


def _learnt(net: Network) -> dict[str, dict[str, Summary]]:
    return {
        str(k): {str(o): edge.summary for o, edge in node.neighbours().items() if edge.summary is not None}
        for k, node in net.nodes.items()
    }


@pytest.mark.parametrize(("told", "size"), [(1.0, 0.02), (0.7, 0.02), (1.0, np.inf)])
def test_stds_are_those_of_the_joint_optimum_even_if_the_noise_was_told_wrongly(told: float, size: float) -> None:
    world, sightings, net = _ran(31, told, size)
    covariance = joint_optimum(world, sightings, spread=True).covariance
    assert covariance is not None
    best = np.sqrt(np.diag(covariance)[:-1].reshape(-1, 6)[2:, 3:])
    ratio = _stds(world, net) / best
    assert float(ratio.min()) > 0.85
    assert float(ratio.max()) < 1.25


def test_a_camera_that_no_edge_ties_is_not_joined() -> None:
    _, _, net = _ran(31)
    edges = each_once(_learnt(net))
    assert len(edges) == 10
    assert joined(list("01234"), edges) == set("01234")
    assert joined(list("01234"), {pair: e for pair, e in edges.items() if "3" not in pair}) == set("0124")
