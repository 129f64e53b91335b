"""A whole network of pose nodes: joint optimum, message loss, moved cameras, cameras that join and leave."""

from __future__ import annotations

import numpy as np
import pytest

from hub.distributed.network.association import Associator
from hub.distributed.network.messages import ControlPoint, Notice, SharedObservation, StateMessage
from hub.distributed.network.node import PoseNode
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from tests.bench.pose_runs import Network, Traffic, feed, network
from tests.bench.pose_worlds import SimulatedRig, cube, errors, joint_optimum, observe, section_4


def _converged(seed: int, points: int = 1500, **kind: float) -> tuple[SimulatedRig, Network, float]:
    rng = np.random.default_rng(seed)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, points), **kind)
    net = network(world, None, seed)
    feed(net, sightings, 15)
    for _ in range(40):
        net.tick()
    return world, net, errors(world, joint_optimum(world, sightings.without(sightings.wrong)).poses)[0]


@pytest.mark.parametrize("kind", [{}, {"size": np.inf}, {"outliers": 0.1}])
def test_the_nodes_are_nearly_as_accurate_as_the_joint_optimum(kind: dict[str, float]) -> None:
    world, net, best = _converged(3, 1500, **kind)
    assert errors(world, net.world_poses())[0] < 1.25 * best
    assert all(notice.kind == "joined" for _, notice in net.notices)


def test_lost_duplicated_and_late_messages_only_slow_convergence() -> None:
    rng = np.random.default_rng(4)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, 1500))
    net = network(world, Traffic(0.2, 0.2, 50, 3), 4)
    feed(net, sightings, 15)
    for _ in range(60):
        net.tick()
    assert errors(world, net.world_poses())[0] < 1.3 * errors(world, joint_optimum(world, sightings).poses)[0]
    assert sum(node.refused["duplicate"] for node in net.nodes.values()) > 100


def test_runs_are_reproducible() -> None:
    poses = [_converged(5, 400)[1].world_poses() for _ in range(2)]
    for a, b in zip(*poses, strict=True):
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a.position, b.position)


def test_a_moved_camera_is_detected_and_recovers_without_disturbing_the_others() -> None:
    world, net, _ = _converged(6, 2500)
    poses = list(world.poses)
    poses[3] = Pose(so3.exp(np.array([0.0, 0.035, 0.0])) @ poses[3].rotation, poses[3].position + [3.0, 4.0, 0.0])
    rng = np.random.default_rng(60)
    moved = SimulatedRig(poses)
    feed(net, observe(moved, rng, cube(rng, 1000)), 15)
    notices = [notice for _, notice in net.notices if notice.kind == "bumped"]
    assert [notice.camera for notice in notices] == [3]
    assert net.nodes[3].epoch == 1
    found = net.world_poses()
    for k in range(2, 5):
        pose = found[k]
        assert pose is not None
        assert np.linalg.norm(pose.position - poses[k].position) < 1.5


def test_the_control_point_of_a_moved_camera_is_rejected_and_reported() -> None:
    world, net, _ = _converged(7, 2500)
    poses = list(world.poses)
    poses[1] = Pose(so3.exp(np.array([0.03, 0.0, 0.0])) @ poses[1].rotation, poses[1].position + [0.0, 5.0, 0.0])
    rng = np.random.default_rng(70)
    feed(net, observe(SimulatedRig(poses), rng, cube(rng, 300)), 15)
    assert {notice.kind for _, notice in net.notices if notice.camera == 1} == {
        "joined",
        "bumped",
        "reference set aside",
    }


def test_a_camera_joins_late_and_another_leaves() -> None:
    rng = np.random.default_rng(8)
    world = section_4(rng)
    sightings = observe(world, rng, cube(rng, 2500))
    net = network(world, None, 8)
    late = net.nodes.pop(4)
    feed(net, sightings, 15, 0, 1000)
    gone = net.nodes.pop(2)
    for node in net.nodes.values():
        node.handle(gone.leave())
        assert 2 not in node.neighbours()
    net.nodes[4] = late
    feed(net, sightings, 15, 1000, 2500)
    pose = late.world_pose()
    assert pose is not None
    assert np.linalg.norm(pose.position - world.poses[4].position) < 3.0


def test_invalid_and_old_messages_are_counted_and_dropped() -> None:
    node = PoseNode(0)
    good = SharedObservation(1, 0, 5, 0.0, 0.1, 0.1, 0.002)
    for bad in (float("nan"), float("inf")):
        assert node.handle(SharedObservation(1, 0, 6, 0.0, bad, 0.1, 0.002)) == []
    node.handle(good)
    node.handle(good)
    node.handle(SharedObservation(1, 0, 5 - 1000, 0.0, 0.1, 0.1, 0.002))
    state = StateMessage(1, 0, 0, 3, 0, 1, Pose.identity())
    node.handle(state)
    node.handle(state)
    node.handle(StateMessage(1, 0, 0, 4, 0, 1, Pose(2.0 * np.eye(3), np.zeros(3))))
    assert node.refused == {"invalid": 3, "duplicate": 1, "too late": 1, "old state": 1}


def _seen(camera: int, time: float, x: float, label: int = 0, time_std: float = 0.0) -> SharedObservation:
    return SharedObservation(camera, 0, int(1000 * time), time, x, 0.0, 1e-3, 0.1, 0.02, label, time_std)


def test_a_moving_target_is_interpolated_between_own_observations() -> None:
    associator = Associator()
    pairs = []
    for i in range(8):
        associator.add_own(_seen(0, 0.033 * i, np.sin(3 * 0.033 * i)))
    one = associator.add_neighbour(_seen(1, 0.1, 0.5))
    assert one is not None
    assert one[0] == pytest.approx(np.sin(0.3), abs=2e-5)
    known = one[6]
    loose = associator.add_neighbour(_seen(1, 0.1, 0.5, time_std=0.01))
    assert loose is not None
    assert loose[6] < 0.1 * known  # an uncertain clock makes a fast target uncertain
    assert associator.add_neighbour(_seen(1, 5.0, 0.5)) is None
    pairs += associator.add_own(_seen(0, 5.0, 0.7))
    assert [camera for camera, _ in pairs] == [1]
    assert associator.add_neighbour(_seen(1, 2.5, 0.5)) is None  # no interpolation across a gap


def test_notices_have_details() -> None:
    _, net, _ = _converged(9, 300)
    assert all(isinstance(notice, Notice) and notice.detail for _, notice in net.notices)


def test_a_control_point_that_is_wrong_from_the_start_is_rejected() -> None:
    rng = np.random.default_rng(11)
    world = section_4(rng)
    references = {k: ControlPoint(pose.position, pose.rotation, 0.3, 0.003) for k, pose in enumerate(world.poses)}
    references[3] = ControlPoint(world.poses[3].position + [0.0, 12.0, 0.0], world.poses[3].rotation, 0.3, 0.003)
    nodes = {k: PoseNode(k, control_point=references[k], seed=11) for k in range(5)}
    net = Network(nodes, Traffic(), np.random.default_rng(0))
    feed(net, observe(world, rng, cube(rng, 1500)), 15)
    for _ in range(40):
        net.tick()
    notices = [(notice.camera, notice.detail) for _, notice in net.notices if notice.kind == "reference set aside"]
    assert [camera for camera, _ in notices] == [3]
    assert "11." in notices[0][1] or "12" in notices[0][1]
    for pose, there in zip(net.world_poses(), world.poses, strict=True):
        assert pose is not None
        assert np.linalg.norm(pose.position - there.position) < 1.0
