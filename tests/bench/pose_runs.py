"""Runs pose nodes on simulated sightings with deterministic message traffic, with or without losses."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from hub.distributed.network.messages import ControlPoint, Notice, SharedObservation, StateMessage
from hub.distributed.network.node import PoseNode
from protocols.geometry.pose import Pose
from tests.bench.pose_worlds import Sightings, SimulatedRig


@dataclass(frozen=True, slots=True)
class Traffic:
    """Disturbances of messages between cameras. lost, duplicated: shares. delay: at most, in events.

    repeat: how many earlier observations each message carries again.
    """

    lost: float = 0.0
    duplicated: float = 0.0
    delay: int = 0
    repeat: int = 0


@dataclass(slots=True, eq=False)
class Network:
    """Pose nodes and the messages in transit between them.

    record: if a list, every delivered observation is appended. arrived: points received by one camera from another.
    """

    nodes: dict[int, PoseNode]
    traffic: Traffic = field(default_factory=Traffic)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    notices: list[tuple[int, Notice]] = field(default_factory=list)
    now: int = 0
    points: int = 0
    record: list[tuple[int, SharedObservation]] | None = None
    arrived: set[int] = field(default_factory=set)
    _queue: list[tuple[int, int, int, object]] = field(default_factory=list)
    _count: int = 0
    _sequences: dict[int, int] = field(default_factory=dict)
    _last: dict[tuple[int, int], deque[SharedObservation]] = field(default_factory=dict)

    def send(self, to: int, message: SharedObservation | StateMessage | tuple[SharedObservation, ...]) -> None:
        """Send a message between cameras: it may be lost, duplicated or delayed."""
        t = self.traffic
        if t.lost == 0.0 and t.duplicated == 0.0 and t.delay == 0:
            self._deliver(to, message)
            return
        if self.rng.random() < t.lost:
            return
        for _ in range(2 if self.rng.random() < t.duplicated else 1):
            self._count += 1
            heapq.heappush(self._queue, (self.now + int(self.rng.integers(0, t.delay + 1)), self._count, to, message))

    def _deliver(self, to: int, message: object) -> None:
        node = self.nodes.get(to)
        if isinstance(message, tuple):
            for item in message:
                self._deliver(to, item)
        elif node is not None:
            if isinstance(message, SharedObservation) and message.camera != to:
                self.arrived.add(int(message.time))
            if self.record is not None and isinstance(message, SharedObservation):
                self.record.append((to, message))
            self._note(node.handle(message))  # type: ignore[arg-type]

    def _note(self, out: list[object]) -> None:
        self.notices += [(self.points, item) for item in out if isinstance(item, Notice)]

    def observe(self, cameras: tuple[int, int], seen: np.ndarray, sigma: float, size_sigma: float) -> None:
        """One point observed by two cameras: delivered to both, and sent to each other."""
        self.points += 1
        self._pass_time()
        made = []
        for camera, row in zip(cameras, seen, strict=True):
            sequence = self._sequences.get(camera, 0)
            self._sequences[camera] = sequence + 1
            sized = bool(np.isfinite(size_sigma))
            made.append(
                SharedObservation(
                    camera,
                    0,
                    sequence,
                    float(self.points),
                    float(row[0]),
                    float(row[1]),
                    sigma,
                    float(np.exp(row[2])) if sized else 0.0,
                    size_sigma if sized else 0.0,
                    self.points,
                )
            )
        for camera, message in zip(cameras, made, strict=True):
            self._deliver(camera, message)
        self._share(cameras[0], cameras[1], made[0])
        self._share(cameras[1], cameras[0], made[1])

    def _pass_time(self) -> None:
        """Advance by one event and deliver due messages."""
        self.now += 1
        while self._queue and self._queue[0][0] <= self.now:
            _, _, to, message = heapq.heappop(self._queue)
            self._deliver(to, message)

    def _share(self, sender: int, to: int, seen: SharedObservation) -> None:
        """With message loss each message repeats the previous ones: 24 B each, and duplicates are dropped anyway."""
        if self.traffic.repeat == 0:
            self.send(to, seen)
            return
        last = self._last.setdefault((sender, to), deque(maxlen=self.traffic.repeat + 1))
        last.append(seen)
        self.send(to, tuple(last))

    def tick(self) -> None:
        """One update of every node, then their states are sent."""
        self._pass_time()
        states = []
        for node in self.nodes.values():
            out = node.tick(float(self.now))
            self._note(list(out))
            states += [item for item in out if isinstance(item, StateMessage)]
        for state in states:
            for neighbour in self.nodes[state.camera].neighbours():
                self.send(neighbour, state)

    def world_poses(self) -> list[Pose | None]:
        """Poses in the world by camera; None where unknown."""
        return [node.world_pose() for node in self.nodes.values()]


def section_4_control_points(world: SimulatedRig) -> dict[int, ControlPoint]:
    """Camera 1's pose and camera 2's position."""
    first, second = world.poses[:2]
    return {0: ControlPoint(first.position, first.rotation), 1: ControlPoint(second.position)}


def network(world: SimulatedRig, traffic: Traffic | None = None, seed: int = 0) -> Network:
    """New nodes for every camera of the rig."""
    references = section_4_control_points(world)
    nodes = {k: PoseNode(k, control_point=references.get(k), seed=seed) for k in range(len(world.poses))}
    return Network(nodes, traffic or Traffic(), np.random.default_rng([seed, 77]))


def feed(net: Network, sightings: Sightings, every: int, begin: int = 0, end: int | None = None) -> None:
    """Sightings one by one, and an update of every node after each ``every``."""
    for i in range(begin, len(sightings.cameras) if end is None else end):
        a, b = (int(c) for c in sightings.cameras[i])
        net.observe((a, b), sightings.seen[i], sightings.sigma, sightings.size_sigma)
        if (i + 1) % every == 0:
            net.tick()
