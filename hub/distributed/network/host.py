"""Host of the pose nodes of some cameras: this hub's part of a network distributed over any number of hubs.

Estimator without bus, threads or clocks: ``handle`` for messages, ``on_liveliness`` for agents, ``tick``. Every host
receives every node's state. When a host fails, the others agree without communication which of them takes over each of
its cameras (rendezvous hashing over the same names), and that host resumes from the last published state.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from google.protobuf.message import Message

from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.network.association import MAX_GAP_S
from hub.distributed.network.messages import (
    ControlPoint,
    Notice,
    SharedObservation,
    StateMessage,
    edges_from_wire,
    edges_to_wire,
    name_of,
    number_of,
    state_from_wire,
    state_to_wire,
)
from hub.distributed.network.node import PoseNode
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import rig_camera_from_info
from protocols.session.observations import DEFAULT_LABEL

ROLE = "nodes"
"""Role under which a hub that hosts pose nodes is announced."""
UPDATE_PERIOD_S = 0.1  # s: ten publications a second
_UPDATE_OBSERVATIONS = 40
"""Observations after which the nodes are updated even if no time has passed, for a hub that has a backlog."""
_CHECKPOINT_UPDATES = 5
"""Updates between two messages that include the factors."""
_LISTEN_S = 1.0
"""Time after the start during which cameras that another host may have are not taken over."""
_TIMEOUT_S = 20.0
"""Time without messages after which a host counts as failed even if its liveliness token is present."""
_MIN_UPDATES = 30  # before a node's pose is published
_PIXEL_STD = 1.0  # px, until it is estimated
_MIN_PIXEL_STD = 0.3  # px
_SIZE_STD = 0.05  # relative
_MAX_CLOCK_CHANGE_S = 0.02  # s: a larger change starts the association anew
_LENS_TOLERANCE = 1e-3
"""Relative change of a focal length from which a lens counts as changed."""


@dataclass(slots=True, eq=False)
class _Clock:
    """t_reference = rate * t_camera + offset, for one boot id ("" = any). std: of the map [s]; pixel: noise [px]."""

    boot: str
    rate: float
    offset: float
    std: float
    pixel: float


@dataclass(slots=True, eq=False)
class _Hosted:
    node: PoseNode
    takeover: int
    updates: int = 0
    labels: set[int] = field(default_factory=set)


class NodeHost:
    """This hub's pose nodes.

    hub: its id. pinned: cameras that it always hosts. leave_after_s: time after a camera's agent has disappeared until
    the camera is removed from the network.
    """

    def __init__(self, hub: str, pinned: Iterable[str] = (), *, seed: int = 0, leave_after_s: float = 30.0) -> None:
        self.hub = hub
        self.counters: Counter[str] = Counter()
        self.notices: list[Notice] = []
        self.refused: dict[str, str] = {}
        self._pinned = frozenset(pinned)
        self._seed, self._leave_after = seed, leave_after_s
        self._hosted: dict[str, _Hosted] = {}
        self._lenses: dict[str, Intrinsics] = {}
        self._control_points: dict[str, ControlPoint] = {}
        self._clocks: dict[str, _Clock] = {}
        self._shared = False
        self._states: dict[str, pb.NodeState] = {}
        self._edges: dict[str, pb.NodeState] = {}
        self._last_received: dict[str, float] = {}
        self._alive: dict[str, set[str]] = {}
        self._gone: set[str] = set()
        self._departed: dict[str, float] = {}
        self._boots: dict[str, list[str]] = {}
        self._sequences: Counter[str] = Counter()
        self._last: dict[tuple[str, str], int] = {}
        self._labels: dict[str, int] = {}
        self._latest: dict[str, float] = {}
        self._now = 0.0
        self._began: float | None = None
        self._due = 0.0
        self._rows = 0
        self._out: list[pb.NodeState] = []

    # input

    def handle(self, message: Message) -> None:
        """Process one message from the bus or a log; irrelevant types are ignored."""
        if isinstance(message, pb.Observation):
            self._observation(message)
        elif isinstance(message, pb.NodeState):
            self._state(message)
        elif isinstance(message, pb.CameraInfo):
            self._camera(message)
        elif isinstance(message, pb.RigInfo):
            self._shared = message.clock == "shared"
        elif isinstance(message, pb.Calibration) and message.status == "solved":
            self._calibration(message)

    def use_shared_clock(self) -> None:
        """All cameras are stamped by one clock: no time maps are needed."""
        self._shared = True

    def on_liveliness(self, role: str, agent: str, boot: str, *, alive: bool) -> None:
        """An agent appeared or disappeared (liveliness token)."""
        if role == "camera":
            if alive:
                self._departed.pop(agent, None)
            else:
                self._departed[agent] = self._now
        elif role == ROLE:
            boots = self._alive.setdefault(agent, set())
            (boots.add if alive else boots.discard)(boot)
            (self._gone.discard if boots else self._gone.add)(agent)

    # output

    def tick(self, now: float) -> list[pb.NodeState]:
        """Update every node when due, and return their states. now: any monotonic clock [s]."""
        self._now = now
        if self._began is None:
            self._began = now
        if now >= self._due:
            self._due = now + UPDATE_PERIOD_S
            self._out += self._release()
            self._take_over()
            self._update()
        out, self._out = self._out, []
        return out

    def _update(self) -> None:
        """One update of every hosted node; neighbours here receive the states at once, others with the next tick."""
        self._rows = 0
        out = []
        for camera, hosted in self._hosted.items():
            states = [item for item in self._record(hosted.node.tick(self._now)) if isinstance(item, StateMessage)]
            hosted.updates += 1
            message = state_to_wire(states[-1], self.hub, hosted.takeover)
            if hosted.updates % _CHECKPOINT_UPDATES == 0:
                message.edges.extend(edges_to_wire(hosted.node.factors()))
            self._states[camera] = message
            out.append(message)
        for message in out:
            self._to_neighbours(message)
        self._out += out

    def cameras(self) -> list[str]:
        """Cameras whose nodes run here."""
        return sorted(self._hosted)

    def poses(self) -> dict[str, Pose]:
        """Poses of all cameras that have been in the most common frame long enough, wherever they are hosted."""
        states = {c: state_from_wire(m) for c, m in sorted(self._states.items()) if not m.leaving}
        frames = Counter(state.frame for state in states.values() if state.pose is not None)
        if not frames:
            return {}
        frame = max(frames, key=lambda f: (frames[f], -f))
        return {
            camera: state.pose
            for camera, state in states.items()
            if state.pose is not None and state.frame == frame and state.frame_age >= _MIN_UPDATES
            if camera not in self.refused
        }

    def factors(self) -> dict[str, dict[str, QuadraticFactor]]:
        """The relative-pose factors of every node of the network by name, as far as received."""
        out: dict[str, dict[str, QuadraticFactor]] = {}
        for camera in sorted({*self._edges, *self._hosted}):
            hosted, last_edges = self._hosted.get(camera), self._edges.get(camera)
            if hosted is not None:
                edges = hosted.node.neighbours().items()
                known = {other: edge.factor for other, edge in edges if edge.factor is not None}
            elif last_edges is not None and last_edges.epoch == self._states[camera].epoch:
                known = edges_from_wire(list(last_edges.edges))
            else:
                continue
            out[camera] = {name_of(other): factor for other, factor in known.items()}
        return out

    def clock(self, camera: str) -> tuple[float, float, float]:
        """(rate, offset, std) of the camera's time map as the nodes use it."""
        clock = self._clocks.get(camera)
        return (1.0, 0.0, 0.0) if clock is None or self._shared else (clock.rate, clock.offset, clock.std)

    # observations

    def _observation(self, message: pb.Observation) -> None:
        camera = message.camera
        lens, clock = self._lenses.get(camera), self._clocks.get(camera)
        if lens is None or camera in self.refused:
            return
        if not self._shared and (clock is None or clock.boot not in ("", message.boot_id)):
            self.counters["before_the_clock_is_known"] += 1
            return
        who = (camera, message.boot_id)
        if message.sequence <= self._last.get(who, -1):
            self.counters["repeated"] += 1
            return
        self._last[who] = message.sequence
        boots = self._boots.setdefault(camera, [])
        if message.boot_id not in boots:
            boots.append(message.boot_id)
        best: dict[str, pb.Detection] = {}
        for found in sorted(message.detections, key=lambda found: -found.score):
            best.setdefault(found.label or DEFAULT_LABEL, found)
        if not best:
            return
        rate, offset, std = self.clock(camera)
        self._latest[camera] = message.device_time_ns / NANOSECONDS
        time = rate * self._latest[camera] + offset
        pixels = np.array([[found.u, found.v] for found in best.values()])
        noise = (_PIXEL_STD if clock is None else clock.pixel) / lens.focal
        for (label, found), (x, y) in zip(best.items(), lens.unproject(pixels).tolist(), strict=True):
            if not (np.isfinite(x) and np.isfinite(y)):
                continue
            sequence = self._sequences[camera]
            self._sequences[camera] += 1
            size = found.size / lens.focal
            number = self._labels.setdefault(label, len(self._labels))
            seen = SharedObservation(
                number_of(camera), len(boots), sequence, time, x, y, noise, size, _SIZE_STD if size > 0 else 0.0,
                number, std,
            )  # fmt: skip
            self._distribute(camera, seen)
        self._rows += len(best)
        if self._rows >= _UPDATE_OBSERVATIONS:
            self._update()

    def _distribute(self, camera: str, seen: SharedObservation) -> None:
        for name, hosted in self._hosted.items():
            if name == camera:
                hosted.labels.add(seen.label)
            elif seen.label not in hosted.labels:
                continue
            self._record(hosted.node.handle(seen))

    # other messages

    def _camera(self, message: pb.CameraInfo) -> None:
        camera = rig_camera_from_info(message)
        lens, control_point = camera.intrinsics, ControlPoint.of(camera)
        if lens is None:
            return
        if control_point is not None:
            self._control_points.setdefault(message.camera, control_point)
        known = self._lenses.setdefault(message.camera, lens)
        if same_lens(known, lens):
            if self.refused.pop(message.camera, None) is not None:
                self.counters["lens_back"] += 1
        elif message.camera not in self.refused:
            reason = f"its lens changed (focal length {known.focal:.1f} to {lens.focal:.1f} px)"
            self.refused[message.camera] = f"{reason}: zoom back, or restart the hub"
            self.notices.append(Notice(number_of(message.camera), "lens changed", self.refused[message.camera]))

    def _calibration(self, message: pb.Calibration) -> None:
        for camera in message.cameras:
            # A calibration by pose nodes alone has no noise estimate.
            std = camera.rms_px / np.sqrt(2.0)
            pixel = max(std, _MIN_PIXEL_STD) if std > 0.0 else _PIXEL_STD
            fresh = _Clock(camera.boot_id, camera.clock_rate, camera.time_offset, camera.time_offset_std, pixel)
            last = self._clocks.get(camera.camera)
            self._clocks[camera.camera] = fresh
            # Observations waiting for association were stamped with the old map.
            at = self._latest.get(camera.camera)
            if last is not None and at is not None and _clock_changed(last, fresh, at):
                self.counters["clock_jumps"] += 1
                for hosted in self._hosted.values():
                    hosted.node.clear_associations()

    def _state(self, message: pb.NodeState) -> None:
        if message.host == self.hub:
            return
        camera, mine = message.camera, self._hosted.get(message.camera)
        if mine is not None:
            if (message.takeover, _rendezvous_weight(message.host, camera)) < (
                mine.takeover,
                _rendezvous_weight(self.hub, camera),
            ):
                return  # its host will receive our state and release the camera
            del self._hosted[camera]
            self.counters["handed_over"] += 1
        last = self._states.get(camera)
        if last is not None and (message.takeover, message.sequence) <= (last.takeover, last.sequence):
            if last.host == message.host:
                return
            if (message.takeover, _rendezvous_weight(message.host, camera)) < (
                last.takeover,
                _rendezvous_weight(last.host, camera),
            ):
                return
        self._states[camera] = message
        self._last_received[camera] = self._now
        if message.edges:
            self._edges[camera] = message
        self._to_neighbours(message)

    def _to_neighbours(self, message: pb.NodeState) -> None:
        state = state_from_wire(message)
        for name, hosted in self._hosted.items():
            if name != message.camera and state.camera in hosted.node.neighbours():
                self._record(hosted.node.handle(state))

    def _record(self, out: list[StateMessage | Notice]) -> list[StateMessage | Notice]:
        for item in out:
            if isinstance(item, Notice):
                self.notices.append(item)
                self.counters[item.kind.replace(" ", "_")] += 1
        return out

    # assignment of cameras to hosts

    def _release(self) -> list[pb.NodeState]:
        """Remove cameras that have disappeared or are refused from the network; returns the last message of each."""
        out: list[pb.NodeState] = []
        for camera in list(self._hosted):
            gone = self._now - self._departed.get(camera, self._now) > self._leave_after
            if gone or camera in self.refused:
                hosted = self._hosted.pop(camera)
                out.append(state_to_wire(hosted.node.leave(), self.hub, hosted.takeover))
                self._states[camera] = out[-1]
                self._to_neighbours(out[-1])
        return out

    def _take_over(self) -> None:
        assert self._began is not None
        for camera in self._lenses:
            if camera in self._hosted or camera in self.refused or camera in self._departed:
                continue
            last = self._states.get(camera)
            free = last is None or last.leaving or self._is_dead(last.host, camera)
            if camera in self._pinned:
                free = free or (last is not None and last.host != self.hub)
            elif not free or self._assigned_host(camera) != self.hub:
                continue
            if not free or (last is None and self._now - self._began < _LISTEN_S):
                continue
            self._host(camera, last)

    def _host(self, camera: str, last: pb.NodeState | None) -> None:
        control_point = self._control_points.get(camera)
        node = PoseNode(
            number_of(camera), control_point=control_point, seed=self._seed, gap=0.0 if self._shared else MAX_GAP_S
        )
        takeover = 0
        if last is not None:
            takeover = last.takeover + 1
            if not last.leaving:
                edges = self._edges.get(camera)
                known = {} if edges is None or edges.epoch != last.epoch else edges_from_wire(list(edges.edges))
                node.resume(state_from_wire(last), known)
                for other in self._states.values():
                    if other.camera != camera and number_of(other.camera) in known:
                        node.handle(state_from_wire(other))
                self.counters["taken_over"] += 1
        self._hosted[camera] = _Hosted(node, takeover)

    def _is_dead(self, host: str, camera: str) -> bool:
        if host == self.hub:
            return True  # an earlier run of this hub
        return host in self._gone or self._now - self._last_received.get(camera, self._now) > _TIMEOUT_S

    def _assigned_host(self, camera: str) -> str:
        alive = [hub for hub, boots in self._alive.items() if boots and hub not in self._gone]
        return max({*alive, self.hub}, key=lambda hub: _rendezvous_weight(hub, camera))


def same_lens(a: Intrinsics, b: Intrinsics) -> bool:
    """Whether two lenses are equal within tolerance: focal lengths, centre and distortion."""
    off: Floats = np.abs(a.matrix - b.matrix)
    return bool((off < _LENS_TOLERANCE * a.focal).all()) and (
        a.distortions.shape == b.distortions.shape and bool(np.allclose(a.distortions, b.distortions, atol=1e-3))
    )


def _rendezvous_weight(hub: str, camera: str) -> bytes:
    """Weight of a hub in rendezvous (highest random weight) hashing: the live hub with the largest hosts the camera."""
    return hashlib.blake2b(f"{hub}/{camera}".encode(), digest_size=8).digest()


def _clock_changed(last: _Clock, fresh: _Clock, at: float) -> bool:
    """Whether two maps of a camera differ by more than an interpolated track tolerates, at camera time ``at`` [s]."""
    return (
        last.boot != fresh.boot or abs((fresh.rate - last.rate) * at + fresh.offset - last.offset) > _MAX_CLOCK_CHANGE_S
    )
