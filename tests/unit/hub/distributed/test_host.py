"""Hosts of pose nodes: assignment, takeover from the last published state, cameras that zoom or leave."""

from __future__ import annotations

import numpy as np

from hub.distributed.network.host import ROLE, NodeHost
from hub.distributed.network.messages import edges_from_wire, name_of, number_of
from hub.distributed.solver import node_calibration
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from tests.bench.pose_worlds import SimulatedRig, cube, observe, section_4
from tests.support.node_traffic import Stream, info, known_rig, name
from tests.support.samples import node_state


class _Site:
    """Hosts that exchange messages in simulated time."""

    def __init__(self, world: SimulatedRig, *hosts: NodeHost) -> None:
        self.world, self.hosts = world, {host.hub: host for host in hosts}
        self.stream, self.now = Stream(), 0.0
        self.states: list[pb.NodeState] = []
        for host in hosts:
            host.use_shared_clock()
            for other in self.hosts:
                host.on_liveliness(ROLE, other, "b", alive=True)
            for camera in range(len(world.poses)):
                host.handle(info(camera))

    def run(self, rng: np.random.Generator, points: int) -> None:
        for i, message in enumerate(self.stream.observations(observe(self.world, rng, cube(rng, points)))):
            for host in self.hosts.values():
                host.handle(message)
            if i % 30 == 29:
                self.tick()

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            self.now += 0.11
            self.states = [state for host in list(self.hosts.values()) for state in host.tick(self.now)]
            for state in self.states:
                for host in self.hosts.values():
                    host.handle(pb.NodeState.FromString(state.SerializeToString()))

    def kill(self, hub: str) -> None:
        del self.hosts[hub]
        for host in self.hosts.values():
            host.on_liveliness(ROLE, hub, "b", alive=False)

    def errors(self, hub: str) -> list[float]:
        found = node_calibration(known_rig(self.world), self.hosts[hub])
        return [
            float(np.linalg.norm(found.cameras[name(k)].pose.position - pose.position))
            for k, pose in enumerate(self.world.poses)
            if name(k) in found.cameras
        ]


def _converged(seed: int, points: int = 1200) -> tuple[_Site, np.random.Generator]:
    rng = np.random.default_rng(seed)
    site = _Site(section_4(rng), NodeHost("a", ["cam0", "cam1"]), NodeHost("b", ["cam2", "cam3", "cam4"]))
    site.tick(15)
    site.run(rng, points)
    site.tick(30)
    return site, rng


def test_two_hosts_share_one_network_and_one_takes_over_when_the_other_fails() -> None:
    site, rng = _converged(20)
    assert site.hosts["a"].cameras() == ["cam0", "cam1"]
    assert site.hosts["b"].cameras() == ["cam2", "cam3", "cam4"]
    before = site.errors("a")
    assert len(before) == 5
    assert max(before) < 3.0
    assert before == site.errors("b")
    stds = node_calibration(known_rig(site.world), site.hosts["a"]).cameras
    for camera, off in zip(("cam2", "cam3", "cam4"), before[2:], strict=True):
        assert 0.0 < off < 4.0 * float(np.linalg.norm(stds[camera].position_std)) < 6.0
    taken = site.hosts["a"].counters["taken_over"]
    site.kill("b")
    site.tick(1)
    assert site.hosts["a"].cameras() == ["cam0", "cam1", "cam2", "cam3", "cam4"]
    assert site.hosts["a"].counters["taken_over"] == taken + 3
    site.tick(40)
    # Resumed from the last published state: without a further observation the poses are as accurate as before.
    assert max(site.errors("a")) < 1.5 * max(before) + 0.1
    poses = list(site.world.poses)
    poses[3] = Pose(so3.exp(np.array([0.0, 0.035, 0.0])) @ poses[3].rotation, poses[3].position + [3.0, 4.0, 0.0])
    site.world = SimulatedRig(poses)
    site.run(rng, 1000)
    assert [name_of(n.camera) for n in site.hosts["a"].notices if n.kind == "bumped"] == ["cam3"]
    assert max(site.errors("a")) < 3.0


def test_a_camera_that_zooms_is_refused_until_it_zooms_back() -> None:
    site, rng = _converged(21, 400)
    for host in site.hosts.values():
        host.handle(info(4, focal=650.0))
    site.tick(3)
    assert "lens changed" in site.hosts["b"].refused["cam4"]
    assert len(site.errors("a")) == 4
    assert site.hosts["b"].cameras() == ["cam2", "cam3"]
    for host in site.hosts.values():
        host.handle(info(4))
    site.run(rng, 800)
    site.tick(40)
    assert max(site.errors("a")) < 4.0
    assert len(site.errors("a")) == 5


def test_a_camera_that_has_disappeared_is_removed_after_a_timeout() -> None:
    site, _ = _converged(22, 300)
    for host in site.hosts.values():
        host.on_liveliness("camera", "cam2", "b0", alive=False)
    site.tick(100)
    assert site.hosts["b"].cameras() == ["cam2", "cam3", "cam4"]
    site.tick(200)
    assert site.hosts["b"].cameras() == ["cam3", "cam4"]
    assert number_of("cam2") not in [k for h in site.hosts["a"]._hosted.values() for k in h.node.neighbours()]


def test_hosts_agree_on_the_assignment_of_cameras() -> None:
    rng = np.random.default_rng(23)
    site = _Site(section_4(rng), *(NodeHost(hub) for hub in ("a", "b", "c")))
    site.tick(20)
    hosted = [camera for host in site.hosts.values() for camera in host.cameras()]
    assert sorted(hosted) == [name(k) for k in range(5)]


def test_names_sort_as_their_numbers_do() -> None:
    names = ["cam0", "cam10", "cam2", "roof", "a"]
    assert [name_of(number_of(text)) for text in names] == names
    assert sorted(names) == sorted(names, key=number_of)


def test_a_factor_survives_serialisation() -> None:
    (summary,) = edges_from_wire(list(node_state().edges)).values()
    np.testing.assert_array_equal(summary.hessian, summary.hessian.T)
    np.testing.assert_allclose(so3.log(summary.anchor.rotation), [0.1, 0.2, 0.3])
    assert summary.hessian[0, 1] == 2.0
    assert summary.hessian[5, 5] == 21.0


def test_control_points_are_exchanged_between_hosts_and_an_outlier_is_rejected() -> None:
    rng = np.random.default_rng(31)
    world = section_4(rng)
    site = _Site(world)
    hosts = [NodeHost("a", ["cam0", "cam1"]), NodeHost("b", ["cam2", "cam3", "cam4"])]
    wrong = world.poses[3].position + [0.0, 12.0, 0.0]
    for host in hosts:
        host.use_shared_clock()
        for other in hosts:
            host.on_liveliness(ROLE, other.hub, "b", alive=True)
        for k, pose in enumerate(world.poses):
            message = info(k)
            message.position.extend((wrong if k == 3 else pose.position).tolist())
            message.position_std.extend([0.3] * 3)
            message.rotation.extend(so3.log(pose.rotation).tolist())
            message.rotation_std.extend([0.003] * 3)
            host.handle(message)
    site.hosts = {host.hub: host for host in hosts}
    site.tick(12)
    site.run(rng, 1500)
    site.tick(100)
    notices = {host.hub: [n.camera for n in host.notices if n.kind == "reference set aside"] for host in hosts}
    assert notices == {"a": [], "b": [number_of("cam3")]}
    states = {state.camera: state for state in site.states}
    assert {anchor.camera for anchor in states["cam0"].anchors} == {name(k) for k in range(5)}
    assert [anchor.camera for anchor in states["cam0"].anchors if anchor.aside] == ["cam3"]
