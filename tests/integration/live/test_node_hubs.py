"""Two hub processes host one network of pose nodes over Zenoh: cameras join, move and leave, and one hub is killed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import numpy as np

from protocols.bus.base import Bus, Publisher, Subscription
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.folder import write_rig
from protocols.topics import CALIBRATION, CAMERA_INFO, NODE_STATE, OBSERVATION, STATUS
from tests.bench.pose_worlds import SimulatedRig, cube, observe, section_4
from tests.faults.matrix import measured
from tests.support.node_traffic import CENTRE, Stream, info, name
from tests.support.samples import eventually

_FOCAL = 600.0


def _rig_file(folder: Path, world: SimulatedRig) -> Path:
    """Control points as in the paper's section 4: the first camera's pose, the second one's position; one clock."""
    tables: dict[str, object] = {"metadata": {"units": "cm", "clock": "shared"}}
    for k, pose in enumerate(world.poses):
        matrix = [[_FOCAL, 0.0, CENTRE[0]], [0.0, _FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]]
        table = {"name": name(k), "size": [1280, 960], "fps": 30.0, "matrix": matrix, "distortions": [0.0] * 5}
        if k < 2:
            table["position"] = pose.position.tolist()
        if k == 0:
            table["rotation"] = so3.log(pose.rotation).tolist()
        tables[name(k)] = table
    file = folder / "rig.toml"
    write_rig(file, tables)
    return file


def _hub(folder: Path, hub: str, nodes: list[str], rig: Path, endpoint: str) -> subprocess.Popen[bytes]:
    file = folder / f"{hub}.toml"
    file.write_text(
        f'id = "{hub}"\nrig = "{rig.as_posix()}"\nsolve = false\nnodes = {nodes}\ninterval_s = 0.3\nwindow_s = 2.0\n'
        f'leave_after_s = 1.0\n[bus]\nmode = "client"\nconnect = ["{endpoint}"]\n'.replace("'", '"'),
        encoding="utf-8",
    )
    return subprocess.Popen([sys.executable, "-m", "deploy", "hub", str(file)])


class _Cameras:
    """The agents of all cameras, in this process."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.stream = bus, Stream()
        self.tokens: dict[int, AbstractContextManager[None]] = {}
        self.publishers: dict[str, Publisher] = {}
        self.infos: list[Publisher] = []

    def join(self, camera: int) -> None:
        self.tokens[camera] = self.bus.announce("camera", name(camera), "b0")
        self.tokens[camera].__enter__()
        self.publishers[name(camera)] = self.bus.publisher(OBSERVATION, name(camera))
        self.infos.append(self.bus.publisher(CAMERA_INFO, name(camera)))
        self.infos[-1].put(info(camera))

    def leave(self, camera: int) -> None:
        self.tokens.pop(camera).__exit__(None, None, None)
        self.publishers.pop(name(camera)).close()

    def publish(self, world: SimulatedRig, rng: np.random.Generator, points: int) -> None:
        """Publish observations of that many target positions, several hundred a second."""
        for i, message in enumerate(self.stream.observations(observe(world, rng, cube(rng, points)))):
            if message.camera in self.publishers:
                self.publishers[message.camera].put(message)
            if i % 20 == 19:
                time.sleep(0.03)

    def publish_until(self, world: SimulatedRig, rng: np.random.Generator, condition: Callable[[], bool]) -> bool:
        """Publish, and again where a slow machine's hubs left messages out; whether the condition came to hold."""
        for _ in range(6):
            self.publish(world, rng, 700)
            if eventually(condition, 10.0):
                return True
        return False


class _HubOutputs:
    """The latest messages of the hubs."""

    def __init__(self, bus: Bus) -> None:
        self._calibrations: Subscription = bus.subscribe(CALIBRATION)
        self._states: Subscription = bus.subscribe(NODE_STATE)
        self._status: Subscription = bus.subscribe(STATUS)
        self.calibration: dict[str, pb.Calibration] = {}
        self.hosts: dict[str, str] = {}
        self.states: dict[str, pb.NodeState] = {}

    def read(self) -> None:
        for received in self._calibrations.drain():
            assert isinstance(received.message, pb.Calibration)
            self.calibration[received.agent] = received.message
        for received in self._states.drain():
            assert isinstance(received.message, pb.NodeState)
            self.hosts[received.message.camera] = received.message.host
            self.states[received.message.camera] = received.message

    def failure_report(self) -> str:
        """Diagnostics for a failed assertion: hosts, states, and the hubs' counters."""
        self.read()
        last = {
            r.agent: dict(r.message.counters) for r in self._status.drain() if isinstance(r.message, pb.AgentStatus)
        }
        nodes = {c: (s.host, s.frame, s.settled, s.epoch, s.takeover) for c, s in sorted(self.states.items())}
        return f"{nodes} {last}"

    def errors(self, hub: str, world: SimulatedRig) -> dict[str, float]:
        """Position errors [cm] by camera in a hub's last calibration."""
        self.read()
        out = {}
        for camera in self.calibration[hub].cameras if hub in self.calibration else ():
            pose = Pose.from_rodrigues(np.array(camera.rotation), np.array(camera.translation))
            truth = world.poses[int(camera.camera[3:])]
            out[camera.camera] = float(np.linalg.norm(pose.position - truth.position))
        return out

    def within(self, hub: str, world: SimulatedRig, cameras: int, most: float) -> bool:
        found = self.errors(hub, world)
        return len(found) == cameras and max(found.values()) < most


def test_two_hubs_share_a_network_and_one_is_killed(tmp_path: Path) -> None:
    rng = np.random.default_rng(30)
    world = section_4(rng)
    endpoint = free_endpoint()
    rig = _rig_file(tmp_path, world)
    with (
        ExitStack() as stack,
        Router(endpoint),
        open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus,
    ):
        hubs = {
            hub: _hub(tmp_path, hub, nodes, rig, endpoint)
            for hub, nodes in (("a", ["cam0", "cam1"]), ("b", ["cam2", "cam3", "cam4"]))
        }
        for process in hubs.values():
            stack.callback(process.wait)
            stack.callback(process.kill)
        outputs, cameras = _HubOutputs(bus), _Cameras(bus)
        for camera in range(4):
            cameras.join(camera)
        wanted = {"cam0": "a", "cam1": "a", "cam2": "b", "cam3": "b"}
        assert eventually(lambda: outputs.read() or outputs.hosts == wanted, 20.0), outputs.hosts  # type: ignore[func-returns-value]
        assert cameras.publish_until(world, rng, lambda: outputs.within("a", world, 4, 4.0)), (
            f"{outputs.errors('a', world)} {outputs.failure_report()}"
        )

        cameras.join(4)  # late
        assert cameras.publish_until(world, rng, lambda: outputs.within("a", world, 5, 4.0)), (
            f"{outputs.errors('a', world)} {outputs.failure_report()}"
        )
        assert eventually(lambda: outputs.within("b", world, 5, 4.0), 20.0), (
            f"{outputs.errors('b', world)} {outputs.failure_report()} {outputs.calibration.get('b')}"
        )

        hubs["b"].send_signal(signal.SIGKILL)
        began = time.monotonic()
        assert eventually(lambda: outputs.read() or set(outputs.hosts.values()) == {"a"}, 20.0), outputs.hosts  # type: ignore[func-returns-value]
        took = time.monotonic() - began
        measured("hub of two killed -9: all its nodes run at the other", "≤ 5 s", f"{took:.2f} s", took <= 5.0)
        time.sleep(1.0)
        assert eventually(lambda: outputs.within("a", world, 5, 4.0), 10.0), "without observations: by the last states"

        poses = list(world.poses)
        poses[3] = Pose(so3.exp(np.array([0.0, 0.035, 0.0])) @ poses[3].rotation, poses[3].position + [3.0, 4.0, 0.0])
        moved = SimulatedRig(poses)
        assert cameras.publish_until(moved, rng, lambda: outputs.within("a", moved, 5, 3.0)), outputs.errors("a", moved)

        cameras.leave(4)
        assert cameras.publish_until(moved, rng, lambda: outputs.within("a", moved, 4, 3.0)), outputs.errors("a", moved)
